"""The loop of one aircraft on a pretend flight: what it learns, says, forgets, and never publishes."""

import copy

import msgspec
import numpy as np
import pytest

from fleet.autopilots import laws
from fleet.bus.codec import encode
from fleet.contract import (
    Mission,
    Model,
    Outcome,
    Status,
    TwinState,
)
from tests.support import flights as f
from tests.support.flights import ROUTE, drive, predictions, published, shifted, status
from twin_worker.evaluation.replay import run_offline
from twin_worker.twin.state import state
from twin_worker.twin.step import Twin, advance, fleet_row
from twin_worker.twin.steps.route_lines import SIMPLE_METHODS

FLOWN_S = 100.0


# --- the whole flight ------------------------------------------------------------------------------------------------


def test_it_is_verified_within_the_flight_and_at_what_horizon(flown):
    verdicts = [r.verdict for r in flown[1] if isinstance(r, Model)]
    good = [v for v in verdicts if v.outcome.is_accepted]
    assert good and good[-1].horizon_s >= 4.0
    assert all(np.mean(list(v.fit.values())) > max(0.0, np.mean(list(v.fit_persistence.values()))) for v in good)
    assert all(v.sentence.startswith("uav-1: ") for v in verdicts)


def test_everything_it_publishes_is_encodable_and_finite(flown):
    assert len(published(flown[1])) == len(flown[1]) > 80


def test_before_a_model_it_flies_the_route_by_lags_and_says_why(flown):
    early = [p for p in predictions(flown[1]) if p.t < f.T0 + 25.0]
    guessed, greyed = ([p for p in early if p.method == method] for method in ("imm", "greybox"))
    assert len(guessed) + len(greyed) == len(early) and len(greyed) > 10
    assert all(p.t < f.T0 + 8.0 and "5 s are needed" in p.sentence for p in guessed)
    assert all(p.state is TwinState.PREDICTING and "L1" in p.law and p.seq >= 1 for p in greyed)
    assert all("30 s are needed" in p.sentence for p in early)


def test_in_auto_it_predicts_on_the_route(flown):
    late = [p for p in predictions(flown[1]) if p.t > f.T0 + FLOWN_S - 15.0]
    on_route = [p for p in late if p.method in ROUTE]
    assert len(on_route) >= 0.8 * len(late) > 5
    assert all(p.state is TwinState.PREDICTING and p.seq >= 1 and "L1" in p.law for p in on_route)
    assert all(0 <= p.horizon_s <= 180 for p in late)
    assert any(p.horizon_s > 3 for p in on_route)


def test_the_prediction_comes_true_for_a_few_seconds(flown):
    twin, results = flown
    assert twin.telemetry.origin is not None
    from fleet.frames import to_ned

    t, position = twin.telemetry.history.rows("position")
    where = to_ned(twin.telemetry.origin, *position.T)
    miss = []
    for p in predictions(results):
        if p.method in ROUTE and p.t + 8.0 < t[-1]:
            flew = [np.interp(p.t + 8.0, t, c) for c in where.T]
            miss.append(np.linalg.norm(p.path.numpy()[8] - flew))
    assert len(miss) > 5 and np.median(miss) < 40.0  # of some 190 m


def test_an_offline_run_makes_one_twin_for_each_aircraft(monkeypatch):
    """Once one was made, and its airframe's TOML parsed, for every message."""
    loads = []
    load = state.load
    monkeypatch.setattr(state, "load", lambda which: loads.append(which) or load(which))
    said = [Status(uav=uav, t=f.T0 + k, mode="AUTO") for k in range(50) for uav in (1, 2)]
    assert list(run_offline(said, twins := {})) == []
    assert sorted(twins) == [1, 2] and len(loads) == 2


def test_one_flight_gives_one_answer(heard, flown):
    again = list(run_offline(heard[:600], {}))
    assert [encode(r) for r in again] == [encode(r) for r in flown[1][: len(again)]]


def test_the_row_of_the_fleet_table(twin):
    row = fleet_row(twin, twin.telemetry.history.newest + 0.5, worker="ff", epoch=3)
    assert (row.uav, row.state, row.worker, row.epoch) == (1, twin.prediction.state, "ff", 3)
    assert row.sample_age_s == pytest.approx(0.5)
    assert row.prediction_age_s is not None and row.prediction_age_s >= 0.5
    assert row.horizon_s == twin.prediction.latest.horizon_s > 0.0  # as in the message of the same prediction
    empty = fleet_row(Twin.of(9), 5.0)
    assert (empty.sample_age_s, empty.prediction_age_s, empty.t10_s) == (None, None, None)


# --- starved ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["servo", "velocity", "attitude"])
def test_starved_names_what_is_missing(kind):
    twin = Twin.of(4)
    lone = f.messages({k: v for k, v in f.turn(12.0).items() if k != kind}, uav=4)
    results = drive(twin, lone)
    assert not [r for r in results if isinstance(r, Model)]
    assert (
        twin.identification.verdict.outcome is Outcome.INSUFFICIENT_DATA and twin.prediction.state is TwinState.WAITING
    )
    assert (
        f"no {kind} rows yet" in twin.identification.verdict.sentence
        and twin.identification.verdict.sentence.startswith("uav-4: ")
    )


def test_nothing_is_said_before_a_position():
    twin = Twin.of(4)
    assert drive(twin, f.messages({k: v for k, v in f.turn(8.0).items() if k != "position"}, uav=4)) == []
    assert twin.telemetry.origin is None


def test_standing_on_the_ground_is_not_flown():
    twin = Twin.of(4)
    drive(twin, f.messages(f.turn(45.0, Va=0.1, rate=0.0, bank=0.0), uav=4))
    assert twin.models.active_model is None and twin.identification.verdict.outcome is Outcome.INSUFFICIENT_DATA


# --- events ----------------------------------------------------------------------------------------------------------


def test_another_mode_invalidates_at_once(twin, heard):
    now = twin.telemetry.history.newest
    assert twin.confidence.tracker.open_start_times
    results = drive(twin, [status(twin, mode="FBWA")])
    (said,) = predictions(results)
    assert said.method == "imm" and "FBWA follows no mission" in said.sentence and said.seq == -1
    assert twin.onboard.plan_changed_t == now and twin.prediction.state is twin.models.state
    assert all(
        t >= now - 1.0 for t in twin.confidence.tracker.open_start_times
    )  # what was predicted in AUTO is not scored
    (back,) = predictions(drive(twin, [status(twin, mode="AUTO")]))
    assert back.method in ROUTE and back.seq >= 1  # from the present state on


def test_an_empty_mission_and_a_new_one(twin):
    t = twin.telemetry.history.newest
    (gone,) = predictions(drive(twin, [Mission(uav=1, t=t)]))
    assert gone.method == "imm" and "no mission on board" in gone.sentence
    assert twin.onboard.plan_changed_t == t


def test_the_same_mission_and_parameters_again_change_nothing(twin):
    since, waiting = twin.onboard.plan_changed_t, len(twin.confidence.tracker.open_start_times)
    drive(twin, [msgspec.structs.replace(twin.onboard.mission, seq=5), twin.onboard.params])
    assert (twin.onboard.plan_changed_t, len(twin.confidence.tracker.open_start_times)) == (since, waiting)
    more = twin.onboard.params.values | {"NAVL1_PERIOD": 31.0}
    drive(twin, [msgspec.structs.replace(twin.onboard.params, values=more, t=twin.telemetry.history.newest)])
    assert twin.onboard.plan_changed_t == twin.telemetry.history.newest


def test_a_jump_of_the_clock_forgets_and_learns_anew(twin, heard):
    end = twin.telemetry.history.newest
    drive(twin, [status(twin, clock_jumps=1)])
    assert twin.telemetry.history.newest == -np.inf and not twin.confidence.tracker.open_start_times
    for by in (500.0, -500.0):  # fleet time itself may go either way
        anew = copy.deepcopy(twin)
        later = shifted(heard, end + by - f.T0, 40.0)
        results = [r for m in later for r in advance(anew, (m,), m.t)]
        assert predictions(results)[0].t < end + by + 5.0
        assert [r for r in results if isinstance(r, Model)], f"no model after a jump of {by} s"


# --- who it is -------------------------------------------------------------------------------------------------------


def test_what_has_no_wings_is_not_given_any(heard):
    twin = Twin.of(1)
    results = drive(
        twin, [msgspec.structs.replace(m, vehicle="multirotor") if isinstance(m, Status) else m for m in heard]
    )
    assert all(r.derivatives is None for r in results if isinstance(r, Model)) and twin.models.active_model is None
    methods = [p.method for p in predictions(results)]
    assert methods[0] == "copter" and set(methods) <= {
        "copter",
        *SIMPLE_METHODS,
    }  # it flies like wings
    assert "kinematic twin" in next(p.sentence for p in predictions(results) if p.method == "copter")


def test_an_autopilot_that_does_not_say_what_it_is_is_told_by_the_banks_it_asked_for(heard):
    twin = Twin.of(1)
    told = [msgspec.structs.replace(m, autopilot="generic") if isinstance(m, Status) else m for m in heard]
    last = predictions(drive(twin, told))[-1]
    assert (
        twin.environment.autopilot.law == "arduplane"
        and last.method in ROUTE
        and last.law == laws.LAWS["arduplane"].description
    )
    assert "autopilot generic: control law arduplane: L1 + TECS matches the commanded banks" in last.sentence
