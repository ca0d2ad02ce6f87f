"""Second-order lag between an angle and its command, identified from the free run over the segment.

y'' = wn^2 (c + b - y) - 2 zeta wn y'
"""

import numba as nb
import numpy as np

STEP = 0.1  # interval of the rows [s]
_INNER = 4
_USUAL = np.array([3.0, 0.9, 0.0])  # wn [rad/s], zeta [-], b [rad]
_SPREAD = np.array([2.0, 0.4, 0.03])  # of the prior
_LOW, _HIGH = np.array([0.5, 0.3, -0.2]), np.array([12.0, 2.5, 0.2])
_NOISE = 0.02  # standard deviation of the residual [rad]
_TOGETHER = 10  # correlated rows that count as one
_FAR = 3.0  # Huber limit, in standard deviations [-]
_STEPS = 8
_PACE = (1e-3, 1e-3, 1e-4)  # steps of the numerical derivatives


@nb.njit(cache=True, error_model="numpy", nogil=True)
def follow(command: np.ndarray, y: np.ndarray, lag: np.ndarray, out: np.ndarray) -> None:
    """Simulate the lag over commands, (n,) [rad], into `out`, (n,); after a nan command it restarts from `y`."""
    wn, zeta, bias = lag[0], lag[1], lag[2]
    h = STEP / _INNER
    at, rate, lost = y[0], 0.0, True
    for k in range(len(command)):
        if lost:
            at, rate = y[k], 0.0
        out[k] = at
        lost = not np.isfinite(command[k])
        if lost:
            continue
        for _ in range(_INNER):
            rate += h * (wn * wn * (command[k] + bias - at) - 2.0 * zeta * wn * rate)
            at += h * rate


def identify(command: np.ndarray, y: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
    """Estimate wn, zeta, b that minimise the free-run error, (3,).

    Args:
        command: (n,) [rad], nan where missing
        y: measured angle, (n,) [rad], nan where missing
        warm_start: start of the search, for example an earlier estimate
    """
    weight = 1.0 / _NOISE / np.sqrt(_TOGETHER)
    y, out = np.where(np.isfinite(y), y, 0.0), np.empty(len(y))
    good = np.isfinite(command)
    lag = (_USUAL if near is None else near).copy()

    def miss(at: np.ndarray) -> np.ndarray:
        follow(command, y, at, out)
        return np.where(good, (out - y) * weight, 0.0)

    found = miss(lag)
    cost = _cost(found, lag, weight)
    for _ in range(_STEPS):
        J = np.column_stack([(miss(lag + step) - found) / step.sum() for step in np.diag(_PACE)])
        calm = 1.0 / np.maximum(np.abs(found) / (_FAR * weight * _NOISE), 1.0)
        H = (J * calm[:, None]).T @ J + np.diag(_SPREAD**-2.0)
        wanted = np.linalg.solve(H, (J * calm[:, None]).T @ found + (lag - _USUAL) / _SPREAD**2)
        for share in (1.0, 0.3, 0.1):
            tried = np.clip(lag - share * wanted, _LOW, _HIGH)
            residual = miss(tried)
            if _cost(residual, tried, weight) < cost:
                break
        else:
            break
        gain = cost - _cost(residual, tried, weight)
        lag, found, cost = tried, residual, cost - gain
        if gain < 1e-3 * cost:
            break
    return lag


def _cost(miss: np.ndarray, lag: np.ndarray, weight: float) -> float:
    """Return the Huber cost of the residuals plus the cost of the deviation from the prior."""
    far = _FAR * weight * _NOISE
    size = np.abs(miss)
    huber = np.where(size < far, size**2, far * (2 * size - far)).sum()
    return float(huber + (((lag - _USUAL) / _SPREAD) ** 2).sum())
