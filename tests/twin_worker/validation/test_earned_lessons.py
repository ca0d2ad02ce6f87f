"""What free runs have earned: believed until they miss, tempered by lively flight rather than by quiet."""

import numpy as np

from twin_worker.validation.forecast_shrinkage import KNOTS_S, Shrinkage

DT = 0.1
N = 401  # rows of a run: 40 s and the start
M = np.zeros(9)


def flown(size: float, seed: int) -> np.ndarray:
    """Give three stretches of slow motion about zero, (3, n, 9)."""
    rng = np.random.default_rng(seed)
    phase, t = rng.uniform(0, 2 * np.pi, (3, 1, 9)), DT * np.arange(N)[:, None]
    return size * np.sin(2 * np.pi * t / 11.0 + phase)


def noise(size: float, seed: int) -> np.ndarray:
    return size * np.random.default_rng(seed).normal(size=(3, N, 9))


def test_without_lessons_a_run_is_believed():
    run = flown(1.0, 0)
    assert np.allclose(Shrinkage().forecast(run, run[:, 0], M, DT * np.arange(N)), run)


def test_runs_that_miss_fall_back_to_the_mean():
    earned = Shrinkage()
    for k in range(5):
        earned.update(noise(3.0, k), flown(1.0, k), M, DT)
    assert earned.weights()[1:, :8, 0].max() < 0.2
    run, y0 = noise(3.0, 9), flown(1.0, 9)[:, 0]
    tempered = earned.forecast(run, y0, M, KNOTS_S[-1:])
    assert np.abs(tempered[:, -1, :8]).max() < np.abs(run[:, -1, :8]).max() / 3


def test_a_lesson_of_quiet_flight_takes_little_from_what_lively_flight_has_shown():
    earned = Shrinkage()
    for k in range(3):
        y = flown(1.0, k)
        earned.update(y, y, M, DT)
    earned.update(noise(0.1, 7), flown(0.02, 7), M, DT)
    assert earned.weights()[1:, :, 0].min() > 0.9


def test_what_is_learnt_apart_stays_apart():
    earned = Shrinkage()
    apart = earned.copy()
    apart.update(noise(3.0, 1), flown(1.0, 1), M, DT)
    assert (earned.H == 0).all() and (earned.mean_square == 0).all() and apart.mean_square.any()
