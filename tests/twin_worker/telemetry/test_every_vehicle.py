"""Every vehicle has a twin of some kind: with little or slow telemetry, on rotors, on wings, or of no known kind."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from fleet.autopilots import greybox
from fleet.contract import Event, Message, Model, Outcome, Sample, Status, TwinState
from fleet.frames import to_ned
from fleet.telemetry.recording.recordings import replay_messages
from tests.support import flights as f
from tests.support.flights import T0, drive, predictions, published
from twin_worker.evaluation.replay import run_offline
from twin_worker.prediction.kinematic import wind_and_airspeed
from twin_worker.telemetry.track import hovering_mask, lift_channels, resample_track
from twin_worker.twin.step import Twin
from twin_worker.twin.steps.route_lines import SIMPLE_METHODS

# --- positions alone -------------------------------------------------------------------------------------------------


def thinned(laid: f.Laid, hz: dict[str, float]) -> f.Laid:
    """Keep some kinds of row only, at a lower rate."""
    return {name: tuple(x[:: round(f.HZ[name] / rate)] for x in laid[name]) for name, rate in hz.items()}


@pytest.mark.parametrize("hz", [{"position": 1.0}, {"position": 1.0, "velocity": 1.0}, {"position": 2.0, "air": 2.0}])
def test_positions_alone_are_enough_for_a_guess(hz):
    twin = Twin.of(4)
    flown = f.turn(30.0, rate=0.0, Va=20.0, psi=0.5)
    made = predictions(drive(twin, f.messages(thinned(flown, hz), uav=4)))
    assert made and made[0].t < T0 + 8.0 and {p.method for p in made} == {"imm"}
    assert all(p.state is TwinState.WAITING for p in made)
    last = made[-1]
    step = np.diff(last.path.numpy()[:6, :2], axis=0)
    assert np.allclose(np.hypot(*step.T), 20.0, atol=1.5)
    assert "turn rate only" in last.sentence and "no attitude" in last.sentence and "servo" in last.sentence
    assert ("differentiated" in last.sentence) == ("velocity" not in hz)


def test_a_track_without_velocity_is_the_slope_of_its_positions():
    laid = thinned(f.turn(20.0, rate=0.1), {"position": 1.0})
    history = f.remembered(f.messages(laid))
    got = resample_track(history, f.HERE, until=history.newest, seconds=15.0)
    assert got is not None and got.ok.all() and np.isnan(got.euler).all()
    psi = 2.0 + 0.1 * (got.t - T0)
    want = 20.0 * np.column_stack([np.cos(psi), np.sin(psi)])
    assert np.abs(got.v[20:-20, :2] - want[20:-20]).max() < 0.3
    assert np.abs(got.v[:, :2] - want).max() < 3.0


def test_slow_rows_are_named_with_what_is_needed():
    twin = Twin.of(4)
    hz = {"attitude": 25 / 80, "servo": 20 / 70, "velocity": 2.0, "position": 2.0, "air": 2.0}
    made = predictions(drive(twin, f.messages(thinned(f.turn(40.0), hz), uav=4)))
    assert made and "attitude at 0.3 Hz, identification needs 0.4 Hz" in made[-1].sentence
    assert (
        "servo at 0.3 Hz" in twin.identification.verdict.sentence
        and twin.identification.verdict.outcome is Outcome.INSUFFICIENT_DATA
    )


def test_a_hole_in_the_positions_is_coasted_through_from_its_edge():
    twin = Twin.of(4)
    laid = f.without(thinned(f.turn(30.0), {"position": 5.0, "air": 5.0}), "position", 20.0, 40.0)
    made = predictions(drive(twin, f.messages(laid, uav=4)))
    beyond = [p for p in made if p.t > T0 + 20.5]
    assert made and all(p.coast_s > 3.0 and "positions stopped" in p.sentence for p in beyond)
    assert made[-1].event is Event.COASTING_EXPIRED


@pytest.mark.parametrize("vehicle", ["unknown", "rover"])
def test_an_unknown_vehicle_is_guessed_and_said(heard, vehicle):
    twin = Twin.of(1)
    told = [msgspec.structs.replace(m, vehicle=vehicle) if isinstance(m, Status) else m for m in heard[:300]]
    made = predictions(drive(twin, told))
    assert {p.method for p in made} == {"imm"}
    assert f"vehicle {vehicle}: no controller model available" in made[-1].sentence


# --- wings without a model -------------------------------------------------------------------------------------------


def stripped(heard, *kinds: str) -> list[Message]:
    """The flight as it would be heard without some kinds of row."""
    return [msgspec.structs.replace(m, **dict.fromkeys(kinds)) if isinstance(m, Sample) else m for m in heard]


@pytest.mark.parametrize("kinds", [("servo",), ("servo", "air"), ("servo", "air", "attitude", "command")])
def test_a_route_is_flown_without_a_model(heard, kinds):
    twins: dict[int, Twin] = {}
    results = list(run_offline(stripped(heard, *kinds), twins))
    published(results)
    assert not [r for r in results if isinstance(r, Model)]
    made = [p for p in predictions(results) if p.t > T0 + 20.0]
    assert made[0].method == "greybox" and {p.method for p in made} <= {"greybox", *SIMPLE_METHODS}
    assert {p.law for p in made if p.method == "greybox"} == {greybox.LAW}
    assert all(p.state is TwinState.PREDICTING and p.seq >= 1 for p in made)
    reason = [p.sentence for p in made if p.method == "greybox"][-1]
    assert "no servo" in reason or "no attitude, servo" in reason
    t, x = twins[1].telemetry.history.rows("position")
    where = to_ned(made[0].ned_origin(), *x.T)
    miss = [
        np.linalg.norm(p.path.numpy()[8] - [np.interp(p.t + 8.0, t, c) for c in where.T])
        for p in made
        if p.t + 8.0 < t[-1]
    ]
    assert len(miss) > 20 and np.median(miss) < 40.0  # of some 190 m, as with a model
    assert twins[1].models.kinematic.n_starts >= 3


def test_wind_without_an_airspeed_sensor_shows_in_a_turn():
    laid = thinned(f.turn(60.0, rate=0.2, wind=(5.0, -3.0)), {"position": 5.0, "velocity": 5.0})
    history = f.remembered(f.messages(laid))
    got = resample_track(history, f.HERE, until=history.newest, seconds=60.0)
    assert got is not None
    w, V = wind_and_airspeed(got, None)
    assert np.allclose(w, [5.0, -3.0], atol=1.0) and pytest.approx(20.0, abs=1.0) == V
    straight = f.remembered(f.messages(f.turn(30.0, rate=0.0, wind=(5.0, -3.0))))
    seen = resample_track(straight, f.HERE, until=straight.newest, seconds=30.0)
    assert seen is not None and np.hypot(*wind_and_airspeed(seen, None)[0]) < 1.0  # nothing to see it by


def test_one_compiled_form_serves_all(heard):
    list(run_offline(stripped(heard, "servo")[:200], {}))
    assert len(greybox.follow.signatures) == 1


# --- quadplanes ------------------------------------------------------------------------------------------------------

LIFT = {"SERVO5_FUNCTION": 33.0, "SERVO6_FUNCTION": 34.0, "SERVO1_FUNCTION": 4.0}


def test_lift_motors_and_modes_tell_when_it_hangs():
    assert [column for column, _ in lift_channels(LIFT)] == [4, 5]
    t = T0 + np.arange(0.0, 30.0, 0.5)
    pulses = np.full((len(t), 8), 1000.0)
    pulses[:, 0] = 1700.0  # an aileron is no lift motor
    pulses[(t > T0 + 10.0) & (t < T0 + 20.0), 5] = 1500.0
    history = f.remembered([f.sample(servo=(t, pulses))])
    at = T0 + np.array([5.0, 15.0, 25.0])
    assert hovering_mask(at, history, LIFT, ()).tolist() == [False, True, False]
    assert hovering_mask(at, history, {}, ()).tolist() == [False] * 3
    modes = ((T0, "FBWA"), (T0 + 22.0, "QLOITER"))
    assert hovering_mask(at, history, LIFT, modes).tolist() == [False, True, True]


def test_a_recorded_quadplane_hangs_flies_and_lands(recordings: Path):
    heard = list(replay_messages(recordings / "sitl" / "s09_quadplane_nominal.tlog.xz"))
    start, twins = heard[0].t, {}
    results = list(run_offline(heard, twins))
    made = predictions(results)

    def methods(since: float, until: float) -> set[str]:
        return {p.method for p in made if since < p.t - start < until}

    assert methods(40.0, 50.0) == {"copter"} and methods(180.0, 255.0) == {"copter"}
    assert methods(70.0, 93.5) == {"greybox"} and methods(100.0, 170.0) & {"dynamics", "hybrid", "both"}
    assert methods(264.0, 300.0) <= {"imm"}
    assert any("hovering on rotors" in p.sentence for p in made)
    models = [r for r in results if isinstance(r, Model)]
    assert models and all(m.window_t0 - start > 55.0 for m in models)  # never a row of the hover
    t, x = twins[9].telemetry.history.rows("position")
    landing = [p for p in made if 190.0 < p.t - start < 200.0]
    where = to_ned(landing[0].ned_origin(), *x.T)
    ends = [np.linalg.norm(p.path.numpy()[20] - [np.interp(p.t + 20.0, t, c) for c in where.T]) for p in landing]
    assert np.median(ends) < 6.0  # of 30 to 50 m
