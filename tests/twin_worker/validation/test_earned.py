"""What free runs have earned: kappa and hold of runs that are perfect, noise, too large, lost."""

import numpy as np
import pytest

from fleet.window import STATES
from twin_worker.validation.forecast_shrinkage import KNOTS_S, Shrinkage

DT, N, RUNS = 0.25, 161, 60  # 40 s
MEAN = np.linspace(-2.0, 2.0, 9)
PSI = STATES.index("psi")
AHEAD = DT * np.arange(N)


def noise(seed: int) -> np.ndarray:
    """States about their mean, every row anew, (runs, n, 9)."""
    return MEAN + np.random.default_rng(seed).standard_normal((RUNS, N, 9))


def taught(lesson, times: int = 20) -> Shrinkage:  # type: ignore[no-untyped-def]
    """Lessons of runs and what was flown, (runs, flown) by number."""
    earned = Shrinkage()
    for k in range(times):
        earned.update(*lesson(k), MEAN, DT)
    return earned


def test_before_any_lesson_a_run_is_believed():
    run = noise(0)
    assert np.array_equal(Shrinkage().weights(), np.broadcast_to([1.0, 0.0], (len(KNOTS_S), 9, 2)))
    assert np.allclose(Shrinkage().forecast(run, run[:, 0], MEAN, AHEAD), run, rtol=0, atol=1e-12)


def test_perfect_runs_are_believed_fully():
    earned = taught(lambda k: (noise(k), noise(k)))
    assert np.allclose(earned.weights(), [1.0, 0.0], atol=1e-9)


def test_of_runs_that_are_noise_nothing_is_believed_and_the_mean_is_told():
    earned = taught(lambda k: (noise(k), noise(1000 + k)))
    shares = earned.weights()
    assert (shares[0] == [1.0, 0.0]).all()  # the start itself is known
    but_psi = np.delete(shares[1:], PSI, axis=1)  # whose noise at the start both runs and flight are told from
    assert (but_psi < 0.2).all() and (but_psi.mean(axis=(0, 1)) < 0.1).all()
    run = noise(5)
    told = earned.forecast(run, run[:, 0], MEAN, AHEAD)
    assert np.abs(told - MEAN)[:, 2:, :PSI].mean() < 0.15 * np.abs(run - MEAN).mean()


def test_runs_twice_too_large_are_halved():
    def lesson(k: int) -> tuple[np.ndarray, np.ndarray]:
        flown = noise(k)
        run = MEAN + 2.0 * (flown - MEAN)
        run[..., PSI] = flown[:, :1, PSI] + 2.0 * (flown[..., PSI] - flown[:, :1, PSI])  # heading: from where it began
        return run, flown

    assert np.allclose(taught(lesson).weights()[1:, :, 0], 0.5, atol=0.08)


def test_what_stays_where_it_was_is_held():
    """The run knows nothing; the last value does, but of psi, whose mean it is."""
    shares = taught(lambda k: (noise(k), np.repeat(noise(k + 50)[:, :1], N, axis=1))).weights()
    but_psi = np.delete(shares[1:], PSI, axis=1)
    assert (but_psi[..., 0] < 0.15).all() and (but_psi[..., 1] > 0.8).all()
    assert np.allclose(shares[1:, PSI, 1], 0.0)


def test_shares_stay_within_bounds_however_wrong_the_runs():
    for factor in (-3.0, 0.01, 100.0):
        shares = taught(lambda k, factor=factor: (MEAN + (noise(k) - MEAN) / factor, noise(k))).weights()
        assert (shares >= 0.0).all() and (shares.sum(axis=-1) <= 1.0 + 1e-12).all()
        assert factor > 0 or (shares[1:, :PSI, 0] < 0.1).all()  # the wrong way round is worth nothing


def test_the_newest_lessons_count_most_and_a_lighter_one_counts_less():
    changed = taught(lambda k: (noise(k), noise(1000 + k) if k < 20 else noise(k)), 40)
    assert (changed.weights()[1:, :, 0] > 0.85).all()
    kappa = []
    for weight in (0.1, 1.0):
        earned = Shrinkage()
        earned.update(noise(1), noise(2), MEAN, DT, weight)
        kappa.append(earned.weights()[1, :PSI, 0])
    assert (kappa[0] > kappa[1] + 0.2).all()


def test_a_look_ahead_nobody_flew_is_worth_what_the_one_before_is():
    earned = Shrinkage()
    for k in range(20):
        earned.update(noise(k)[:, :21], noise(1000 + k)[:, :21], MEAN, DT)  # 5 s
    shares = earned.weights()
    flown = np.flatnonzero(KNOTS_S <= 5.0)[-1]
    assert 0.75 * KNOTS_S[flown + 1] > 5.0  # or it was flown in part
    assert np.allclose(shares[flown + 1 :], shares[flown])


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_runs_that_are_lost_fall_back_to_the_mean_and_teach_nothing(value):
    earned, run = Shrinkage(), noise(3)
    run[0, 10:], run[1] = value, value
    y0 = noise(4)[:, 0]
    told = earned.forecast(run, y0, MEAN, AHEAD)
    usual = np.where(np.arange(9) == PSI, y0[:, None], MEAN)  # psi: the heading it had
    assert np.array_equal(told[0, 10:], np.broadcast_to(usual[0], (N - 10, 9)))
    assert np.array_equal(told[1], np.broadcast_to(usual[1], (N, 9))) and np.isfinite(told).all()
    assert np.allclose(told[2:], run[2:])
    lost, flown, gone = noise(7), noise(7), np.arange(RUNS) % 2 == 0
    lost[gone, 5:] = value
    earned.update(lost, flown, MEAN, DT)
    flown[~gone, 30:] = np.nan  # what was not measured
    earned.update(lost, flown, MEAN, DT)
    assert np.allclose(earned.weights(), [1.0, 0.0], atol=1e-9)
    before = earned.weights()
    earned.update(np.full_like(lost, value), flown, MEAN, DT)
    assert np.allclose(earned.weights(), before, atol=1e-9)


def test_between_knots_trust_is_laid_straight_and_a_copy_learns_apart():
    earned = taught(lambda k: (noise(k), noise(1000 + k)), 3)
    apart, shares = earned.copy(), earned.weights()
    apart.update(noise(1), noise(1), MEAN, DT)
    assert np.array_equal(earned.weights(), shares) and not np.array_equal(apart.weights(), shares)
    ahead = np.array([0.0, KNOTS_S[1], (KNOTS_S[1] + KNOTS_S[2]) / 2, KNOTS_S[2], 2 * KNOTS_S[-1]])
    ones = earned.forecast(MEAN + np.ones((len(ahead), 9)), MEAN, MEAN, ahead) - MEAN
    kappa = shares[..., 0]
    assert np.allclose(ones, [kappa[0], kappa[1], (kappa[1] + kappa[2]) / 2, kappa[2], kappa[-1]])
