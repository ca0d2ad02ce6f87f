"""The compiled loops of a prediction give what numpy gives, to the last bit."""

import numpy as np
import pytest

from fleet.autopilots import laws
from fleet.contract import Mission
from fleet.frames import Origin, _radii, to_ned
from twin_worker.confidence import adaptive_conformal
from twin_worker.confidence.prediction_log import CAPACITY, KNOT_OF, PredictionLog, accumulate_length
from twin_worker.estimation.airspeed_setpoint import _median
from twin_worker.numerics.interpolation import interpolate_rows
from twin_worker.numerics.prediction_errors import AHEAD, track_frame
from twin_worker.prediction.multirotor.rollout import item_in_force, items_in_force
from twin_worker.twin.state.flight_phase import speed_extremes


@pytest.mark.parametrize("beyond", [None, np.nan])
@pytest.mark.parametrize("n", [1, 2, 7, 150])
def test_straight_lines_are_those_of_numpy(n: int, beyond: float | None) -> None:
    rng = np.random.default_rng(n)
    t, x = np.cumsum(rng.uniform(0.01, 2.0, n)), 1e3 * rng.standard_normal((n, 3))
    x[n // 2, 1] = np.nan
    at = np.concatenate([rng.uniform(-5.0, t[-1] + 5.0, 60), t])
    rng.shuffle(at)
    wanted = np.column_stack([np.interp(at, t, column, right=beyond) for column in x.T])
    assert np.array_equal(interpolate_rows(at, t, x, beyond), wanted, equal_nan=True)


def test_a_track_frame_is_the_slope_of_second_order() -> None:
    path = np.cumsum(20.0 * np.random.default_rng(1).standard_normal((4, len(AHEAD), 3)), axis=1)
    path[0, :5] = path[0, 0]  # it stands
    slope = np.gradient(path[..., :2], AHEAD, axis=-2)
    length = np.linalg.norm(slope, axis=-1)
    found = track_frame(path)
    assert np.allclose(found[length > 1e-6], (slope / np.maximum(length, 1e-9)[..., None])[length > 1e-6], atol=1e-12)
    assert (found[length <= 1e-6] == [1.0, 0.0]).all() and (length <= 1e-6).sum() == 4
    assert np.array_equal(track_frame(path[2, :40]), track_frame(path[:, :40])[2])


def test_places_are_those_of_numpy() -> None:
    rng, origin = np.random.default_rng(2), Origin(470_000_000, -1_790_000_000, 500_000)
    place = rng.integers([-900_000_000, -1_800_000_000, -1_000_000], [900_000_000, 1_800_000_000, 9_000_000], (5000, 3))
    m, n = _radii(origin)
    turn = (place[:, 1].astype(float) - origin.lon_e7 + 1.8e9) % 3.6e9 - 1.8e9
    north, east = np.radians((place[:, 0].astype(float) - origin.lat_e7) * 1e-7) * m, np.radians(turn * 1e-7) * n
    found = to_ned(origin, *place.T)
    assert np.array_equal(found, np.column_stack([north, east, (origin.alt_mm - place[:, 2].astype(float)) * 1e-3]))
    assert (turn < 0).any() and (turn > 1.7e9).any(), "both ways round the date line"
    assert np.array_equal(found[7], to_ned(origin, *place[7])) and to_ned(origin, *place[:0].T).shape == (0, 3)


@pytest.mark.parametrize("n", [1, 2, 30])
def test_how_it_moves_is_what_numpy_sees(n: int) -> None:
    v = 9.0 * np.random.default_rng(n).standard_normal((n, 3))
    level = np.hypot(*v[:, :2].T)
    wanted = level.min(), level.max(), np.abs(v[:, 2]).max(), np.linalg.norm(v, axis=1).max()
    assert speed_extremes(v) == wanted


@pytest.mark.parametrize("seq", [None, -1, 0, 5])
@pytest.mark.parametrize("ages", [[], [1.0], [14.9, 15.0], [15.1], [30.0, 20.0], [3.0, -2.0], [-1.0]])
def test_the_item_in_force_now_is_that_of_any_time(ages: list[float], seq: int | None) -> None:
    leg = 1e9 - np.array(ages), np.arange(1.0, len(ages) + 1)[:, None]
    mission = None if seq is None else Mission(uav=1, t=1e9, seq=seq)
    want = items_in_force(np.array([1e9]), leg, mission)
    assert np.array_equal([item_in_force(1e9, leg, mission)], want, equal_nan=True)


def book(rng: np.random.Generator) -> PredictionLog:
    """A ledger in the middle of things."""
    made, n = PredictionLog(), len(AHEAD)
    made.group[:] = rng.choice(["a", "b", ""], CAPACITY)
    made.score[:] = np.where(rng.random((CAPACITY, n)) < 0.2, np.nan, rng.uniform(0.0, 2.0, (CAPACITY, n)))
    made.horizon_pending, made.exceeded = rng.random(CAPACITY) < 0.8, rng.random(CAPACITY) < 0.3
    made.followed, made.horizon = np.round(rng.uniform(0, 9, (2, CAPACITY)))
    return made


@pytest.mark.parametrize("seed", range(5))
def test_levels_learn_what_numpy_would_have_learnt(seed: int) -> None:
    rng = np.random.default_rng(seed)
    found, tube, horizon = (
        adaptive_conformal.AdaptiveLevels(),
        np.full(len(adaptive_conformal.KNOTS), adaptive_conformal.NOMINAL_COVERAGE),
        adaptive_conformal.NOMINAL_COVERAGE,
    )
    ends = np.zeros(2)
    for _ in range(30):
        made, n = book(rng), int(rng.integers(0, 60))
        r, j = rng.integers(CAPACITY, size=n), rng.integers(len(AHEAD), size=n)
        mine, claimed = made.group == "a", made.horizon_pending.copy()
        knot, score = KNOT_OF[j], made.score[r, j]
        new = mine[r] & (knot >= 0) & np.isfinite(score)
        step = (
            adaptive_conformal._TUBE_STEP
            * adaptive_conformal._WEIGHT[knot[new]]
            * ((score[new] > 1.0) - (1.0 - adaptive_conformal.NOMINAL_COVERAGE))
        )
        np.add.at(tube, knot[new], step)
        np.clip(tube, adaptive_conformal._MIN_LEVEL, adaptive_conformal._MAX_LEVEL, out=tube)
        held = mine & claimed & (made.followed >= made.horizon)
        failed = mine & claimed & made.exceeded & ~held
        moved = failed.sum() * adaptive_conformal.NOMINAL_COVERAGE - held.sum() * (
            1.0 - adaptive_conformal.NOMINAL_COVERAGE
        )
        horizon = float(
            np.clip(
                horizon + adaptive_conformal._HORIZON_STEP * moved,
                adaptive_conformal.NOMINAL_COVERAGE,
                adaptive_conformal._MAX_LEVEL,
            )
        )
        found.update(made, r, j, mine)
        assert np.array_equal(found.tube, tube) and found.horizon == horizon
        assert np.array_equal(made.horizon_pending, claimed & ~(held | failed))
        ends += held.sum(), failed.sum()
    assert len(set(tube.tolist())) > 5 and ends.all(), "or nothing was learnt"


@pytest.mark.parametrize("n", [1, 2, 40])
def test_the_odometer_runs_as_numpy_lets_it(n: int) -> None:
    rng = np.random.default_rng(n)
    at, points, begin, out = np.cumsum(rng.random(n)), 1e3 * rng.random((n, 3)), rng.random(3), np.empty((n, 2))
    accumulate_length(at, points, begin, 123.4, out)
    strides = np.linalg.norm(np.diff(np.vstack([begin, points]), axis=0), axis=1)
    assert np.array_equal(out, np.column_stack([at, 123.4 + np.cumsum(strides)]))


@pytest.mark.parametrize("law", laws.LAWS)
def test_what_a_law_has_read_need_not_be_read_again(law: str) -> None:
    rng, table = np.random.default_rng(3), laws.LAWS[law].table
    for _ in range(50):
        few = rng.choice(len(table), len(table) // 2, replace=False)
        values = {table[k].name: float(rng.uniform(0.5, 1.5) * (table[k].default or 1.0)) for k in few}
        values[table[few[0]].name] = float(rng.choice([np.nan, np.inf, -1e9]))
        par, height = laws.parameters(law, values, 300.0)[0], float(rng.uniform(0, 3000))
        assert not np.array_equal(par, laws.parameters(law, values, height)[0], equal_nan=True)
        found = laws.vector(law, laws.read(law, values)[0], height)
        assert np.array_equal(found, laws.parameters(law, values, height)[0], equal_nan=True)


@pytest.mark.parametrize("n", [1, 2, 3, 10, 31])
def test_the_middle_is_numpy_s_median(n: int) -> None:
    x = np.random.default_rng(n).standard_normal(n)
    assert _median(x) == np.median(x)
    x[n // 2] = np.nan
    assert np.isnan(_median(x))
