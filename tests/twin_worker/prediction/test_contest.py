"""Which way of flying ahead is used; the speed the autopilot says it aims at; the law learnt from flight."""

import numpy as np
import pytest

from fleet.mission import N_COLUMNS, SEQ, VA_C
from tests.support import flights as f
from tests.support.flights import T0
from twin_worker.estimation.airspeed_setpoint import apply_setpoint, reported_setpoint
from twin_worker.prediction.method_selection import SCORE_AHEAD, MethodSelector


def follow(contest: MethodSelector, off: dict[str, float], n: int, t0: float = 0.0) -> None:
    """Let methods predict a flight due north at 20 m/s, each wrong by so many metres a second; then fly it."""
    ahead = np.arange(0.0, 61.0)
    for k in range(n):
        at = t0 + 5.0 * k
        paths = {m: np.column_stack([20.0 * at + (20.0 + e) * ahead, 0 * ahead, 0 * ahead]) for m, e in off.items()}
        if contest.is_due(at):
            contest.add(at, 20.0, ahead, paths)
    t = t0 + np.arange(0.0, 5.0 * n + 61.0)
    contest.score(t, np.column_stack([20.0 * t, 0 * t, 0 * t]))


def test_the_prior_of_the_calibration_flights_decides_before_any_score():
    contest = MethodSelector()
    assert contest.best(("hybrid", "dynamics", "both")) == "both" and contest.best(("dynamics", "hybrid")) == "hybrid"
    assert contest.best(("greybox", "constant_turn", "constant_velocity", "route_wind", "route_speed")) == "greybox"
    assert contest.describe("both") == ""


def test_the_one_that_strays_least_is_used_once_enough_is_flown():
    contest = MethodSelector()
    follow(contest, {"hybrid": 1.0, "dynamics": 0.2, "both": 0.6}, 4)
    assert contest.best(("hybrid", "dynamics", "both")) == "dynamics"
    assert contest.mean_error["hybrid"] == pytest.approx(0.05, rel=0.1)  # 1 of 20 m/s
    assert contest.describe("dynamics") == (
        "predicted with coupled model: mean error of past predictions 1.0 % of path length; "
        "other methods: mean of coupled and point-mass model 3.0 %, point-mass model 5.0 %"
    )


def test_a_model_that_fails_at_once_loses_within_seconds_to_the_simple_way():
    """The first look-aheads count as soon as they are flown; waiting for a minute used to keep the worse method."""
    contest, ahead = MethodSelector(), np.arange(0.0, 61.0)
    t = np.arange(0.0, 16.0)
    for at in (0.0, 5.0):
        paths = {m: np.column_stack([20 * at + (20 + e) * ahead, 0 * ahead, 0 * ahead]) for m, e in OFF.items()}
        contest.add(at, 20.0, ahead, paths)
    contest.score(t, np.column_stack([20.0 * t, 0 * t, 0 * t]))
    assert contest.best(tuple(OFF)) == "constant_turn" and len(contest.pending) == 2
    n = dict(contest.n_scored)
    contest.score(t, np.column_stack([20.0 * t, 0 * t, 0 * t]))
    assert contest.n_scored == n  # nothing counts twice


OFF = {"dynamics": 12.0, "constant_turn": 0.1}


def test_what_an_event_made_meaningless_and_what_fell_into_a_hole_is_not_scored():
    contest = MethodSelector()
    contest.add(0.0, 20.0, SCORE_AHEAD, {"hybrid": np.zeros((len(SCORE_AHEAD), 3))})
    contest.clear()
    follow(contest, {}, 1)
    assert not contest.mean_error
    contest.add(0.0, 20.0, SCORE_AHEAD, {"hybrid": np.zeros((len(SCORE_AHEAD), 3))})
    contest.score(np.array([0.0, 1.0, 70.0]), np.zeros((3, 3)))
    assert not contest.mean_error and not contest.pending


def legs(*speeds: float) -> np.ndarray:
    out = np.zeros((len(speeds), N_COLUMNS))
    out[:, VA_C], out[:, SEQ] = speeds, np.arange(1, len(speeds) + 1)
    return out


def test_the_speed_aimed_at_counts_up_to_the_next_command():
    told = apply_setpoint(legs(0.0, 0.0, 0.0, 26.0, 0.0), 2.0, 23.0, 20.7)
    assert told[:, VA_C].tolist() == [20.7, 20.7, 20.7, 26.0, 0.0]
    for nothing_new in (23.2, np.nan):
        assert apply_setpoint(legs(0.0, 0.0), 1.0, 23.0, nothing_new)[:, VA_C].tolist() == [0.0, 0.0]
    assert apply_setpoint(legs(0.0), 9.0, 23.0, 20.0)[0, VA_C] == 0.0  # an item the route has not


def test_what_is_aimed_at_is_flown_plus_missing():
    laid = f.turn(10.0, Va=20.0)
    t, x = laid["command"]
    x[:, 4] = 2.5
    history = f.remembered(f.messages(laid | {"command": (t, x)}))
    assert reported_setpoint(history, T0 + 9.5) == pytest.approx(22.5, abs=0.01)
    del laid["air"]
    assert np.isnan(reported_setpoint(f.remembered(f.messages(laid)), T0 + 9.5))
