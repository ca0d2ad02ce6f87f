"""Events: whatever ends a prediction, or is coasted through, is told once, with its time and its sentence."""

import msgspec
import numpy as np
import pytest

from fleet.contract import EVENT_TEXTS, Event, Mission, Prediction, Sample, Status
from fleet.frames import to_geodetic
from tests.support import flights as f
from tests.support import hover
from tests.support.flights import HERE, T0, drive, item, predictions, status
from twin_worker.evaluation.replay import run_offline
from twin_worker.twin.step import Twin, advance


def told(results) -> list[Event]:
    """The events in order, each once."""
    found: list[tuple[Event, float]] = []
    for made in predictions(results):
        assert (made.event is None) == (made.event_text == "")
        if made.event is not None and (made.event, made.event_t) not in found:
            assert made.event_text.startswith(EVENT_TEXTS[made.event])
            found.append((made.event, made.event_t))
    return [event for event, _ in found]


def test_every_event_has_its_sentence():
    assert set(EVENT_TEXTS) == set(Event)
    assert len(set(EVENT_TEXTS.values())) == len(EVENT_TEXTS)
    assert all((30 < len(said) < 110 and ":" in said) or "origin" in said for said in EVENT_TEXTS.values())


def test_an_undisturbed_flight_tells_only_its_mission(flown):
    assert told(flown[1]) == [Event.MISSION]
    assert "(14 items)" in predictions(flown[1])[-1].event_text


def test_mode_mission_and_parameters_void_it_at_once(twin):
    now = twin.telemetry.history.newest
    (made,) = predictions(drive(twin, [status(twin, mode="LOITER")]))
    assert (made.event, made.event_t) == (Event.MODE, now) and "LOITER, previously AUTO" in made.event_text
    other = Mission(uav=1, t=now + 0.1, items=(item(0), item(1, north=900.0)), complete=True)
    (made,) = predictions(drive(twin, [other]))
    assert made.event is Event.MISSION and "(2 items, previously 14)" in made.event_text
    more = msgspec.structs.replace(
        twin.onboard.params, t=now + 0.2, values=twin.onboard.params.values | {"NAVL1_PERIOD": 31.0}
    )
    (made,) = predictions(drive(twin, [more]))
    assert made.event is Event.PARAMETERS and "NAVL1_PERIOD is 31, it was" in made.event_text
    assert not twin.confidence.tracker.open_start_times or all(
        one.t >= now - 1.0 for one in twin.confidence.tracker.open_start_times
    )


def test_a_parameter_that_no_law_reads_changes_nothing(twin):
    since = twin.onboard.plan_changed_t
    more = twin.onboard.params.values | {"STAT_RUNTIME": 5.0, "NAVL1_PERIOD": float("nan")}
    drive(
        twin, [msgspec.structs.replace(twin.onboard.params, values=twin.onboard.params.values | {"STAT_RUNTIME": 4.0})]
    )
    drive(twin, [msgspec.structs.replace(twin.onboard.params, values=more)])
    assert twin.onboard.plan_changed_t == since and twin.prediction.latest_event.event is Event.MISSION


def test_a_jump_of_the_clock_is_told_with_the_first_prediction_after_it(twin, heard):
    end = twin.telemetry.history.newest
    drive(twin, [status(twin, clock_jumps=1)])
    later = f.shifted(heard, end + 500.0 - T0, 6.0)
    assert told(r for m in later for r in advance(twin, (m,), m.t))[-1] is Event.CLOCK


def without_positions(heard, start: float, stop: float) -> list:
    out = []
    for m in heard:
        cut = isinstance(m, Sample) and start < m.t - T0 < stop
        out.append(msgspec.structs.replace(m, position=None) if cut else m)
    return out


def test_positions_that_stop_are_coasted_through(heard, sighted):
    results = list(run_offline(without_positions(heard[:900], 30.0, 38.0), {}))
    assert told(results) == [Event.MISSION, Event.POSITION_LOST, Event.POSITION_RESTORED]
    coasting = [p for p in predictions(results) if p.coast_s]
    assert 3 <= len(coasting) <= 6 and all("positions stopped" in p.sentence for p in coasting)
    assert coasting[-1].t == pytest.approx(T0 + 38.0, abs=1.5)
    starts = np.array([p.path.numpy()[0] for p in coasting])
    assert (np.linalg.norm(np.diff(starts, axis=0), axis=1) > 10.0).all()  # it flies on


def test_positions_that_stop_for_good_are_coasted_up_to_the_horizon(heard, sighted):
    results = list(run_offline(without_positions(heard[:1400], 30.0, 1e9), {}))
    assert told(results) == [Event.MISSION, Event.POSITION_LOST, Event.COASTING_EXPIRED]
    last = predictions(results)[-1]
    assert last.horizon_s == 0.0 and "positions stopped" in last.sentence
    assert last.event_t == pytest.approx(T0 + 30.0 + sighted, abs=1.5)


def northward(sample: Sample, by_e7: int) -> Sample:
    if sample.position is None:
        return sample
    place = sample.position.x.numpy() + np.array([by_e7, 0, 0])
    return msgspec.structs.replace(sample, position=f.rows(sample.position.t.numpy(), place))


def test_an_aircraft_that_flies_far_takes_its_frame_along(twin, heard):
    far = to_geodetic(twin.telemetry.origin, np.array([200e3, 0.0, -100.0]))
    moved = f.shifted(heard, twin.telemetry.history.newest - T0 + 1.0, 12.0)
    moved = [northward(m, int(far[0]) - twin.telemetry.origin[0]) for m in moved if isinstance(m, Sample)]
    results = drive(twin, moved)
    assert told(results)[-1] is Event.ORIGIN
    last = predictions(results)[-1]
    assert last.origin[0] == pytest.approx(far[0], abs=300_000) and np.abs(last.path.numpy()).max() < 5_000.0
    assert all(t > last.event_t - 1.0 for t in twin.confidence.tracker.open_start_times)


# --- ground ----------------------------------------------------------------------------------------------------------


UP_AND_DOWN = (item(0), item(1, 22), item(2), item(3, 21))


def laid_down(speed: np.ndarray, height: np.ndarray, landing_s: float = np.inf) -> list[Sample]:
    """Ten rows a second due north with these speeds [m/s] and heights [m]; from `landing_s` on item 3 is in force."""
    t = T0 + 0.1 * np.arange(len(speed))
    p = np.column_stack([np.cumsum(speed * 0.1), 0 * speed, -height])
    v = np.column_stack([speed, 0 * speed, -np.gradient(height, 0.1)])
    seq = np.where(t - T0 < landing_s, 2.0, 3.0)[:, None]
    flat = {"position": (t, to_geodetic(HERE, p)), "velocity": (t, v), "leg": (t, seq)}
    return f.messages(flat, uav=5, every=0.5)


def story(vehicle: str, samples: list[Sample], armed: tuple[float, float]) -> list[Prediction]:
    """What is predicted of an aircraft in AUTO that is armed between two times since T0."""
    twin, results = Twin.of(5), []
    known = Status(uav=5, t=T0, mode="AUTO", autopilot="ardupilot", vehicle=vehicle)
    results += advance(twin, [known, Mission(uav=5, t=T0, items=UP_AND_DOWN, seq=2, complete=True)])
    for message in samples:
        is_armed = armed[0] <= message.t - T0 < armed[1]
        results += advance(twin, [msgspec.structs.replace(known, t=message.t, armed=is_armed), message])
    return predictions(results)


def test_a_wing_takes_off_lands_and_stands():
    seconds = np.arange(0, 90, 0.1)
    speed = np.interp(seconds, [10, 16, 60, 70], [0.0, 20.0, 20.0, 0.0])
    height = np.interp(seconds, [14, 24, 50, 64], [0.0, 60.0, 60.0, 0.0])
    made = story("fixed_wing", laid_down(speed, height, 48.0), (5.0, 85.0))
    assert told(made) == [Event.MISSION, Event.TAKE_OFF, Event.LANDING, Event.TOUCH_DOWN]
    down = [p for p in made if p.event is Event.TOUCH_DOWN]
    assert 70.0 < down[0].event_t - T0 < 75.0
    assert all(p.sentence == EVENT_TEXTS[Event.TOUCH_DOWN] and p.seq == -1 for p in down)
    assert all(np.ptp(p.path.numpy(), axis=0).max() == 0.0 for p in down)


def test_rotors_take_off_and_land_again():
    seconds = np.arange(0, 60, 0.1)
    height = np.interp(seconds, [10, 20, 30, 45], [0.0, 20.0, 20.0, 0.0])
    samples = laid_down(0 * seconds, height)
    made = story("multirotor", samples, (5.0, 50.0))
    assert told(made) == [Event.MISSION, Event.TAKE_OFF, Event.TOUCH_DOWN]
    assert made[-1].sentence == EVENT_TEXTS[Event.TOUCH_DOWN]
    twice = story("multirotor", samples + later(samples, 60.0), (5.0, 1e9))
    assert told(twice) == [Event.MISSION, *[Event.TAKE_OFF, Event.TOUCH_DOWN] * 2]


def later(samples: list[Sample], by: float) -> list[Sample]:
    return [m for m in f.shifted(samples, by, by) if isinstance(m, Sample)]


def test_hovering_is_not_standing():
    made = predictions(run_offline(hover.fly(3).messages[:500], {}))
    assert Event.TOUCH_DOWN not in told(made) and Event.TAKE_OFF not in told(made)[1:]
