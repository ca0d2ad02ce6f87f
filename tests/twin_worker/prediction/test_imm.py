"""Without a route: straight on when it flew straight, round when it flew round, and never anything wild."""

import numpy as np
import pytest

from twin_worker.evaluation.baselines import filterpy_path
from twin_worker.prediction.constant_turn import STEP, constant_turn_prediction, imm, imm_with_variance
from twin_worker.telemetry.track import STEP as TRACK_STEP
from twin_worker.telemetry.track import Track

AHEAD = np.arange(0.0, 61.0)
N = 24


def straight(n: int = N, v=(18.0, 9.0, 0.0)) -> tuple[np.ndarray, np.ndarray]:
    t = STEP * np.arange(n)[:, None]
    return np.array([100.0, 50.0, -120.0]) + t * np.array(v), np.tile(v, (n, 1))


def circle(rate: float, at: np.ndarray, V: float = 20.0) -> tuple[np.ndarray, np.ndarray]:
    p = V / rate * np.column_stack([np.sin(rate * at), 1 - np.cos(rate * at), 0 * at])
    return p - [0, 0, 120.0], V * np.column_stack([np.cos(rate * at), np.sin(rate * at), 0 * at])


def test_straight_flight_goes_straight_on():
    p, v = straight()
    path = imm(p, v, AHEAD)
    want = p[-1] + AHEAD[:, None] * v[-1]
    along = v[-1, :2] / np.linalg.norm(v[-1, :2])
    cross = (path - want)[:, :2] @ [-along[1], along[0]]
    assert np.allclose(path[0], p[-1], atol=0.5)
    assert np.abs(cross).max() < 1.0  # turns to either side weigh the same
    assert np.linalg.norm((path - want)[:6], axis=1).max() < 5.0
    assert (np.diff(path[:30, :2] @ along) > 0).all()


@pytest.mark.parametrize("rate", [0.3, -0.3])
def test_a_circle_goes_on_round(rate):
    past = STEP * np.arange(-N + 1, 1)
    p, v = circle(rate, past)
    path = imm(p, v, AHEAD)
    want, _ = circle(rate, AHEAD)
    line = p[-1] + AHEAD[:, None] * v[-1]
    off, off_line = (np.linalg.norm(x - want, axis=1) for x in (path, line))
    assert off[3] < 0.3 * off_line[3] and off[5] < 0.5 * off_line[5]
    assert np.sign(path[5, 1]) == np.sign(rate)


def test_the_variance_grows_to_that_of_a_random_turn():
    """Independent simulation: models drawn by the transition probabilities, each flown exactly."""
    p, v = straight()
    path, variance = imm_with_variance(p, v, AHEAD)
    assert np.allclose(path, imm(p, v, AHEAD)) and (np.diff(variance) > 0).all()
    rng = np.random.default_rng(7)
    transition = np.array([[0.97, 0.015, 0.015], [0.06, 0.93, 0.01], [0.06, 0.01, 0.93]])
    model, at, velocity = np.zeros(4000, int), np.zeros(4000, complex), np.full(4000, complex(*v[-1, :2]))
    for _ in range(60):  # to 30 s
        model = (rng.random(4000)[:, None] > transition.cumsum(axis=1)[model]).sum(axis=1)
        rate = np.array([1e-9, 0.3, -0.3])[model]
        at += velocity * (np.exp(1j * rate * STEP) - 1) / (1j * rate)
        velocity *= np.exp(1j * rate * STEP)
    assert np.sqrt(variance[30]) == pytest.approx(np.sqrt(np.var(at.real) + np.var(at.imag)), rel=0.15)


@pytest.mark.parametrize("seed", range(4))
def test_the_filter_is_that_of_filterpy(seed):
    rng = np.random.default_rng(seed)
    v = np.array([18.0, 9.0, 0.0]) + np.cumsum(rng.standard_normal((N, 3)), axis=0)
    p = STEP * np.cumsum(v, axis=0) + 0.5 * rng.standard_normal((N, 3))
    found = imm(p, v, STEP * np.arange(60))[:, :2]
    assert np.allclose(found, filterpy_path(p, v, 59), rtol=1e-6, atol=1e-5)


def test_left_mirrors_right():
    past = STEP * np.arange(-N + 1, 1)
    left, right = (imm(*circle(rate, past), AHEAD) for rate in (-0.2, 0.2))
    assert np.allclose(left * [1, -1, 1], right, atol=1e-6)


def test_a_climb_goes_on_for_a_while_and_is_bounded():
    path = imm(*straight(v=(20.0, 0.0, -2.0)), AHEAD)
    assert path[2, 2] - path[0, 2] == pytest.approx(-4.0, abs=1.0)
    assert -13.0 < path[-1, 2] - path[0, 2] < -8.0
    assert abs(imm(*straight(v=(20.0, 0.0, 90.0)), AHEAD)[-1, 2]) < 1300


def test_later_times_than_the_usual_and_few_rows():
    p, v = straight(4)
    path = imm(p, v, AHEAD + 25.0)
    assert path.shape == (61, 3) and np.isfinite(path).all()
    assert np.allclose(path[:5], imm(p, v, np.arange(0.0, 90.0))[25:30])


def test_a_step_in_position_gives_numbers():
    p, v = straight()
    p[12:] += 1e5
    assert np.isfinite(imm(p, v, AHEAD)).all()


@pytest.mark.parametrize("seed", range(8))
def test_a_leap_that_no_aircraft_flies_begins_the_track_anew(seed):
    """As where the clock jumps: rows of two times on one grid, positions and velocities far beyond any flight."""
    rng = np.random.default_rng(seed)
    n, at = 121, int(rng.integers(10, 90))
    t = TRACK_STEP * np.arange(n)
    clean = np.outer(t, [18.0, 9.0, 0.0]) + np.array([100.0, 50.0, -120.0])
    p, v = clean.copy(), np.tile([18.0, 9.0, 0.0], (n, 1))
    leap = 10.0 ** rng.uniform(10.0, 13.0) * rng.standard_normal(3)
    p[: at + 1] += leap
    if seed % 2:
        v[at] += leap
    path = constant_turn_prediction(Track(t, p, v, np.full((n, 3), np.nan), np.ones(n, bool), ""), AHEAD)
    assert path is not None
    assert np.linalg.norm(path[5] - (clean[-1] + 5.0 * np.array([18.0, 9.0, 0.0]))) < 5.0
    v[-1] = np.nan
    assert constant_turn_prediction(Track(t, p, v, np.full((n, 3), np.nan), np.ones(n, bool), ""), AHEAD) is None
