"""Servos and engine: a step answered by hand, independent of the sample time."""

import numpy as np
import pytest

from fleet.physics.simulate import TAU, lagged


def stepped(n: int, at: int) -> np.ndarray:
    """Commands that jump from nought to one at a row, (n, 4)."""
    return np.repeat((np.arange(n) >= at).astype(float)[:, None], 4, axis=1)


def test_a_step_is_answered_by_hand():
    dt, tau = 0.04, np.array([0.05, 0.1, 0.02, 0.25])
    got = lagged(stepped(12, 3), dt, tau)
    assert (got[:3] == 0.0).all()
    t = dt * np.arange(9)[:, None]
    start, end = 1 - np.exp(-t / tau), 1 - np.exp(-(t + dt) / tau)
    assert np.allclose(got[3:], (start + end) / 2, atol=1e-12)


def test_before_the_first_row_nothing_else_was_commanded():
    commands = np.tile([0.3, -0.2, 0.1, 0.7], (50, 1))
    assert np.allclose(lagged(commands, 0.04, TAU), commands)


def test_it_is_linear_causal_and_bounded():
    rng = np.random.default_rng(0)
    a, b = rng.uniform(-1, 1, (2, 80, 4))
    assert np.allclose(lagged(2 * a - b, 0.04, TAU), 2 * lagged(a, 0.04, TAU) - lagged(b, 0.04, TAU))
    later = a.copy()
    later[40:] = b[40:]
    assert np.array_equal(lagged(later, 0.04, TAU)[:40], lagged(a, 0.04, TAU)[:40])
    assert np.abs(lagged(a, 0.04, TAU)).max() <= np.abs(a).max()


@pytest.mark.parametrize("dt", [0.005, 0.02, 0.1])
def test_the_same_lag_at_every_sample_time(dt):
    n = round(0.5 / dt)
    ends = lagged(stepped(2 * n, n), dt, TAU)[-1]
    before, after = 1 - np.exp(-(0.5 - dt) / TAU), 1 - np.exp(-0.5 / TAU)
    assert np.allclose(ends, (before + after) / 2)
