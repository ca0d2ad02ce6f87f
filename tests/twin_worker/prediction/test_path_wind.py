"""Predictions in the shared wind field: flown in it where it is surer, unchanged where it is not."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from fleet.contract import Array, WindField
from fleet.physics import point_mass as H
from tests.support.examples import EXAMPLES
from tests.twin_worker.identification.test_hybrid import AHEAD, known
from tests.twin_worker.prediction.test_predict import HERE, situation
from twin_worker.estimation.wind_field import PathWind, SharedWind
from twin_worker.prediction.closed_loop import InitialCondition, synchronise_controller
from twin_worker.prediction.fixed_wing import ensemble
from twin_worker.prediction.fixed_wing.path_wind import FIELD_SPAN_S, drift_draws, with_drift, with_mean_wind
from twin_worker.prediction.fixed_wing.point_mass_rollout import fly_point_mass, in_field_wind, start_in_field
from twin_worker.prediction.replay_window import PredictionContext

SPAN = np.arange(0.0, 61.0)


def with_field(now: PredictionContext, north: float, variance: float = 0.01) -> PredictionContext:
    """Add a field of a uniform wind to the north, sure to a variance."""
    message = msgspec.structs.replace(
        EXAMPLES[WindField],
        t=float(now.window.t[-1]),
        origin=(HERE.lat_e7, HERE.lon_e7, HERE.alt_mm),
        wind=(north, 0.0),
        sigma=0.1,
        drift_sigma=0.1,
        profile=Array.of([[north, 0.0], [0.0, 0.0]]),
        nodes=Array.of([[0.0, 0.0, -100.0]]),
        values=Array.of([[0.0, 0.0]]),
        covariance=Array.of(variance * np.eye(3)),
        drifts=Array.of(np.tile([0.0, 0.0, 0.01], (3, 1))),
    )
    return replace(now, shared_wind=SharedWind(message), uav=99)


def start_of(now: PredictionContext) -> InitialCondition:
    start = synchronise_controller(now)
    assert isinstance(start, InitialCondition)
    return start


def test_a_surer_field_moves_the_path_and_an_unsure_or_old_one_changes_nothing() -> None:
    now = situation()
    start = start_of(now)
    own = fly_point_mass(now, start, known(), AHEAD).path
    tailwind = fly_point_mass(with_field(now, 4.0), start, known(), AHEAD).path
    headwind = fly_point_mass(with_field(now, -4.0), start, known(), AHEAD).path
    unsure = fly_point_mass(with_field(now, 4.0, variance=400.0), start, known(), AHEAD).path
    assert own is not None and tailwind is not None and headwind is not None and unsure is not None
    seconds = float(AHEAD[-1] - AHEAD[0])
    assert np.linalg.norm(tailwind[-1] - headwind[-1]) == pytest.approx(8.0 * seconds, rel=0.35)
    np.testing.assert_allclose(tailwind[0], own[0])
    np.testing.assert_array_equal(unsure, own)
    old = with_field(now, 4.0)
    assert old.shared_wind is not None
    message = msgspec.structs.replace(old.shared_wind.message, t=old.shared_wind.message.t - 100.0)
    same = fly_point_mass(replace(old, shared_wind=SharedWind(message)), start, known(), AHEAD).path
    np.testing.assert_array_equal(same, own)


def test_a_shared_start_gives_the_same_path_also_over_a_shorter_span() -> None:
    now = with_field(situation(), 4.0)
    start = start_of(now)
    span = float(AHEAD[-1])
    path = fly_point_mass(now, start, known(), AHEAD).path
    at_once = fly_point_mass(now, start, known(), AHEAD, start_in_field(now, start, known(), span)).path
    longer = fly_point_mass(now, start, known(), AHEAD, start_in_field(now, start, known(), span + 60.0)).path
    np.testing.assert_array_equal(at_once, path)
    np.testing.assert_allclose(longer, path, atol=1e-9)


def test_the_ensemble_spreads_less_in_a_sure_field() -> None:
    now = situation()
    start = start_of(now)
    alone = ensemble.ensemble_std(now, start, known(), SPAN, np.random.default_rng(0))
    shared = ensemble.ensemble_std(with_field(now, 1.0), start, known(), SPAN, np.random.default_rng(0))
    unsure = ensemble.ensemble_std(with_field(now, 1.0, 400.0), start, known(), SPAN, np.random.default_rng(0))
    assert alone is not None and shared is not None and unsure is not None
    assert shared[60, 0] < 0.8 * alone[60, 0]
    np.testing.assert_array_equal(unsure, alone)


def test_the_start_keeps_its_ground_velocity_in_another_wind() -> None:
    now = situation()
    start = start_of(now)
    moved = in_field_wind(start, start_in_field(with_field(now, 3.0), start, known(), FIELD_SPAN_S))
    assert moved is not start and moved.state[2][0] == pytest.approx(3.0, abs=0.1)
    level = with_mean_wind(start, PathWind(np.array([0.0, 60.0]), np.tile([3.0, 0.0], (2, 1)), np.eye(2)))
    (before, _, air), (after, _, new_air) = start.state, level.state
    heading = np.array([np.cos(before[11]), np.sin(before[11])])
    ground, new_ground = before[3] + heading @ air[:2], after[3] + heading @ new_air[:2]
    assert new_ground == pytest.approx(ground, abs=0.1)
    Va, new_Va = np.linalg.norm(before[3:6]) + air[3], np.linalg.norm(after[3:6]) + new_air[3]
    assert new_Va == pytest.approx(Va)
    assert in_field_wind(start, start_in_field(now, start, known(), FIELD_SPAN_S)) is start


def test_the_draws_make_the_drift_follow_given_values() -> None:
    air = np.zeros(H.N_AIR)
    air[[H.DRIFT, H.DRIFT_S, H.REST_N]] = 0.6, 60.0, 1.0
    wind = PathWind(np.array([0.0, 5.0, 10.0]), np.array([[1.0, 0.0], [2.0, -1.0], [0.5, 3.0]]), np.eye(3))
    moved = with_drift(air, wind.mean[0])
    assert moved[H.DRIFT_N] + moved[H.REST_N] == pytest.approx(air[H.DRIFT_N] + air[H.REST_N])
    value, decay = wind.mean[0].copy(), np.exp(-1.0 / 60.0)
    found = [value]
    for z in drift_draws(wind, wind.mean, air, 11)[1:]:
        value = value * decay + 0.6 * np.sqrt(1.0 - np.exp(-2.0 / 60.0)) * z
        found.append(value)
    expected = np.column_stack([np.interp(np.arange(11.0), wind.t, column) for column in wind.mean.T])
    np.testing.assert_allclose(found, expected, atol=1e-9)
