"""The first step recovers a known system from data recorded under feedback, noise and holes."""

import numpy as np
import pytest

from twin_worker.identification.linear.subspace import FUTURE, PAST, subspace

POLES = np.array([0.97, 0.85, 0.9 + 0.12j, 0.9 - 0.12j])
FEEDBACK = np.array([[0.15, 0.0, 0.1, 0.0], [0.0, 0.2, 0.0, 0.1]])


def system(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A and B with the poles above, in a basis without zeros."""
    rng = np.random.default_rng(seed)
    blocks = np.zeros((4, 4))
    blocks[0, 0], blocks[1, 1] = POLES[:2].real
    blocks[2:, 2:] = [[0.9, 0.12], [-0.12, 0.9]]
    turn = np.eye(4) + 0.3 * rng.standard_normal((4, 4))
    return turn @ blocks @ np.linalg.inv(turn), 0.3 * rng.standard_normal((4, 2))


def closed_loop(n: int, noise: float, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """x' = A x + B u + K e, y = x + e, with a controller u = r - F y that would bias an open-loop method."""
    A, B = system()
    rng = np.random.default_rng(seed)
    x, y, u = np.zeros(4), np.zeros((n, 4)), np.zeros((n, 2))
    for k in range(n):
        e = noise * rng.standard_normal(4)
        y[k] = x + e
        u[k] = rng.standard_normal(2) - FEEDBACK @ y[k]
        x = A @ x + B @ u[k] + 0.4 * e
    return y, u


def miss(A: np.ndarray) -> float:
    """Largest distance from a true pole to the nearest one found."""
    found = np.linalg.eigvals(A)
    return max(np.abs(found - pole).min() for pole in POLES)


@pytest.mark.parametrize(("noise", "most"), [(0.02, 0.01), (0.3, 0.03)])
def test_poles_of_a_known_closed_loop(noise, most):
    y, u = closed_loop(6000, noise)
    A, B = subspace(y, u, np.ones(len(y), bool))
    truth = system()
    assert miss(A) < most
    assert np.abs(A - truth[0]).max() < 5 * most
    assert np.abs(B - truth[1]).max() < 5 * most


def test_what_was_not_measured_has_no_say():
    y, u = closed_loop(6000, 0.05)
    ok = np.ones(len(y), bool)
    ok[1000:1400] = ok[3000::500] = False
    clean = subspace(y, u, ok)
    y[~ok], u[~ok] = 1e6, -1e6
    spoilt = subspace(y, u, ok)
    assert np.allclose(clean[0], spoilt[0]) and np.allclose(clean[1], spoilt[1])
    assert miss(spoilt[0]) < 0.02


def test_too_few_unbroken_rows_say_so():
    y, u = closed_loop(300, 0.05)
    need = 3 * PAST * 6
    assert FUTURE <= PAST
    with pytest.raises(ValueError, match=rf"needs {need}; wait"):
        subspace(y[: need + PAST - 1], u[: need + PAST - 1], np.ones(need + PAST - 1, bool))
    subspace(y[: need + PAST], u[: need + PAST], np.ones(need + PAST, bool))
    holes = np.ones(300, bool)
    holes[::PAST] = False  # never PAST + 1 rows in a row
    with pytest.raises(ValueError, match="found 0 unbroken rows"):
        subspace(y, u, holes)
