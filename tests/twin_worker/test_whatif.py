"""What if: the answer is the twin's own under other circumstances, and neither twin nor bus is the worse for it."""

import copy
import time

import msgpack
import msgspec
import numpy as np
import pytest

from fleet.bus.codec import encode
from fleet.contract import MAX_ITEMS, Prediction, WhatIf, WhatIfStart
from fleet.frames import to_geodetic
from tests.support.flights import item
from twin_worker.twin.state.state import Twin
from twin_worker.twin.steps.predict_step import predict
from twin_worker.whatif import answer_query

NAN, INF = float("nan"), float("inf")
FAST_S = 0.05  # the best of three answers takes no longer [s]
SPEED_ITEM = 178  # MAV_CMD: DO_CHANGE_SPEED


def asked(twin: Twin, **what) -> Prediction:
    return answer_query(copy.deepcopy(twin), WhatIf(**what))


def usual(twin: Twin) -> Prediction:
    (made,) = predict(copy.deepcopy(twin), twin.telemetry.history.newest)
    assert isinstance(made, Prediction)
    return made


def speeds(made: Prediction) -> np.ndarray:
    """Speed between look-aheads [m/s]."""
    way = np.linalg.norm(np.diff(made.path.numpy().astype(float), axis=0), axis=1)
    return way / np.diff(made.ahead.numpy())


def apart(one: Prediction, other: Prediction) -> np.ndarray:
    assert one.origin == other.origin
    return np.linalg.norm(one.path.numpy() - other.path.numpy(), axis=1)


# --- answers ---------------------------------------------------------------------------------------------------------


def test_nothing_otherwise_is_the_prediction_itself(winged):
    made, plain = asked(winged), usual(winged)
    assert apart(made, plain).max() == 0.0 and made.method == plain.method
    assert made.sentence.startswith("what if nothing were changed")
    assert made.controller is not None and made.controller.received["NAVL1_PERIOD"] > 0


def test_the_same_mission_and_the_same_parameters_change_nothing(winged):
    same = asked(
        winged, items=winged.onboard.mission.items, seq=usual(winged).seq, params={"WP_RADIUS": _received(winged)}
    )
    assert apart(same, usual(winged)).max() < 0.5


def _received(twin: Twin) -> float:
    return twin.received_params["WP_RADIUS"]


def test_it_flies_as_fast_as_asked(winged):
    slow, fast = (asked(winged, speed=V) for V in (17.0, 26.0))
    wind = float(np.hypot(*winged.environment.wind.wind[:2]))
    assert 17.0 - wind - 4.0 < np.median(speeds(slow)[20:]) < 17.0 + wind + 4.0
    assert np.median(speeds(fast)[20:]) > np.median(speeds(slow)[20:]) + 4.0
    assert "it flew at 17 m/s" in slow.sentence and slow.controller.overridden == {"AIRSPEED_CRUISE": 17.0}


def test_it_flies_to_the_item_asked_for(winged):
    there = next(i for i in winged.onboard.mission.items[1:] if i.command == 16 and i.seq != usual(winged).seq)
    made = asked(winged, seq=there.seq)
    places = to_geodetic(made.ned_origin(), made.path.numpy())
    assert made.seq == there.seq
    assert np.hypot(places[:, 0] - there.lat_e7, (places[:, 1] - there.lon_e7) * 0.68).min() < 150.0 / 0.0111


def test_another_mission_is_flown(winged):
    end = to_geodetic(winged.telemetry.origin, usual(winged).path.numpy()[0] + [2500.0, 0.0, 0.0])
    away = msgspec.structs.replace(item(1), lat_e7=int(end[0]), lon_e7=int(end[1]))
    made = asked(winged, items=(winged.onboard.mission.items[0], away))
    assert made.path.numpy()[-1, 0] > made.path.numpy()[0, 0] + 700.0  # it turns north and stays on that course
    assert "a mission of 2 items" in made.sentence and made.seq == 1


def test_it_starts_where_it_is_asked_to(winged):
    lat, lon, alt = to_geodetic(winged.telemetry.origin, np.array([300.0, -200.0, -150.0])).tolist()
    made = asked(winged, start=WhatIfStart(lat_e7=lat, lon_e7=lon, alt_mm=alt, heading=1.0, speed=25.0))
    assert np.allclose(made.path.numpy()[0], [300.0, -200.0, -150.0], atol=0.6)
    assert np.allclose(speeds(made)[0], 25.0, atol=float(np.hypot(*winged.environment.wind.wind[:2])) + 2.0)
    step = made.path.numpy()[1] - made.path.numpy()[0] - winged.environment.wind.wind
    assert np.arctan2(step[1], step[0]) == pytest.approx(1.0, abs=0.35)


def test_a_start_on_another_continent_has_a_frame_of_its_own(winged):
    made = asked(winged, start=WhatIfStart(lat_e7=-334_000_000, lon_e7=1_505_000_000, alt_mm=600_000))
    assert made.origin == (-334_000_000, 1_505_000_000, 600_000)
    assert np.abs(made.path.numpy()[0]).max() < 1.0 and np.isfinite(made.path.numpy()).all()
    assert 10.0 < np.median(speeds(made)) < 35.0


def test_another_wind_carries_it(winged):
    calm, blown = asked(winged, wind=(0.0, 0.0)), asked(winged, wind=(6.0, 0.0))
    gained = blown.path.numpy()[3, 0] - calm.path.numpy()[3, 0]
    assert gained == pytest.approx(18.0, abs=6.0)


def test_another_parameter_is_flown_with_and_said(winged):
    made = asked(winged, params={"NAVL1_PERIOD": 30.0})
    assert apart(made, usual(winged))[5:].max() > 3.0
    assert made.controller.overridden == {"NAVL1_PERIOD": 30.0}
    assert f"instead of {winged.received_params['NAVL1_PERIOD']:g}" in made.sentence


def test_outside_auto_a_mission_is_flown_as_if_in_auto(winged):
    winged.onboard.status = msgspec.structs.replace(winged.onboard.status, mode="LOITER")
    winged.onboard.plan_changed_t = winged.telemetry.history.newest
    made = asked(winged, items=winged.onboard.mission.items, seq=3)
    assert made.method != "imm" and "its mode were AUTO" in made.sentence


def test_who_was_never_told_a_mission_can_be_asked_about_one(winged):
    items, winged.onboard.mission = winged.onboard.mission.items, None
    winged.telemetry.history.replace_rows("leg", np.empty(0), np.empty((0, 1)))
    made = asked(winged, items=items, seq=3)
    assert made.method != "imm" and made.seq == 3


def test_a_multirotor_answers_too(hovered):
    plain = usual(hovered)
    assert plain.method == "copter" and apart(asked(hovered), plain).max() == 0.0
    slow = asked(hovered, speed=1.0)
    assert speeds(slow)[10:].max() < 1.1 < 0.5 * speeds(plain)[10:].max() and "WP_SPD" in slow.controller.overridden
    lat, lon, alt = to_geodetic(hovered.telemetry.origin, np.array([50.0, 50.0, -40.0])).tolist()
    there = asked(hovered, start=WhatIfStart(lat_e7=lat, lon_e7=lon, alt_mm=alt, speed=0.0))
    assert np.allclose(there.path.numpy()[0], [50.0, 50.0, -40.0], atol=0.6) and speeds(there)[0] < 2.0
    assert asked(hovered, seq=1).seq == 1


def test_every_answer_is_quick(winged, hovered):
    start = WhatIfStart(lat_e7=470_000_000, lon_e7=80_000_000, alt_mm=700_000, heading=2.0, speed=20.0)
    long = tuple(item(k, north=100.0 * (k % 7), east=30.0 * k) for k in range(MAX_ITEMS))
    for twin in (winged, hovered):
        for what in ({}, {"start": start, "wind": (3.0, 3.0)}, {"items": long, "seq": 900}):
            took = []
            for _ in range(3):
                begun = time.process_time()
                asked(twin, **what)
                took.append(time.process_time() - begun)
            assert min(took) < FAST_S, what


# --- neither aircraft nor twin change --------------------------------------------------------------------------------


def may_change(twin) -> tuple:
    """What an answer sets on its copy of the twin."""
    onboard, prediction = twin.onboard, twin.prediction
    timers = prediction.predict_timer.last, prediction.controller_timer.last
    return onboard.plan_changed_t, onboard.status, onboard.mission, timers, prediction.override, prediction.latest


def test_a_question_leaves_the_twin_as_it_was(holder, twin):
    before, kept = encode(usual(twin)), len(twin.confidence.tracker.open_start_times)
    state = may_change(twin)
    asking = WhatIf(speed=18.0, wind=(9.0, 0.0), start=WhatIfStart(lat_e7=1, lon_e7=2, alt_mm=3), seq=3)
    found = holder.bus.get_one(Prediction, 1, msgspec.msgpack.encode(asking))
    assert found is not None and found[1].epoch == 9
    assert state == may_change(twin)
    assert len(twin.confidence.tracker.open_start_times) == kept and encode(usual(twin)) == before


def test_nothing_of_a_question_is_published(holder):
    heard: list[Prediction] = []
    holder.bus.subscribe(Prediction, lambda message, _: heard.append(message))
    assert holder.bus.get_one(Prediction, 1, msgspec.msgpack.encode(WhatIf(speed=18.0))) is not None
    assert heard == []


def test_a_foreign_tool_asks_in_plain_msgpack(holder):
    (made, _) = holder.bus.get_one(Prediction, 1, msgpack.packb({"speed": 18, "wind": [2, 0.5]}))
    assert "it flew at 18 m/s, the wind blew 2 m/s north and 0.5 east" in made.sentence


def test_a_question_about_nobody_is_not_answered(holder):
    assert holder.bus.get_one(Prediction, 3, msgspec.msgpack.encode(WhatIf())) is None


def test_the_reply_is_on_the_grid_asked_for(holder):
    (reply,) = holder.bus._query_handlers[Prediction]
    ((made, _),) = reply(1, {"horizon": "10", "step": "0.5"}, msgspec.msgpack.encode(WhatIf(speed=18.0)))
    assert np.array_equal(made.ahead.numpy(), np.arange(0, 10.25, 0.5))


def test_a_defect_is_one_sentence_and_the_next_question_is_answered(holder, monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("a defect")

    with (
        monkeypatch.context() as m,
        pytest.raises(ValueError, match=r"uav-1: found an internal error \(a defect\).*report"),
    ):
        m.setattr("twin_worker.service.queries.answer_query", broken)
        holder.bus.get_one(Prediction, 1, msgspec.msgpack.encode(WhatIf()))
    assert holder.bus.get_one(Prediction, 1, msgspec.msgpack.encode(WhatIf())) is not None
