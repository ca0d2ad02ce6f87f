"""Second-order lag between an angle and its command, identified from the free run over the segment.

y'' = wn^2 (c + b - y) - 2 zeta wn y'
"""

import numba as nb
import numpy as np

STEP = 0.1  # interval of the rows [s]
_SUBSTEPS = 4
_PRIOR_MEAN = np.array([3.0, 0.9, 0.0])  # wn [rad/s], zeta [-], b [rad]
_PRIOR_SIGMA = np.array([2.0, 0.4, 0.03])  # of the prior
_LOWER, _UPPER = np.array([0.5, 0.3, -0.2]), np.array([12.0, 2.5, 0.2])
_NOISE = 0.02  # standard deviation of the residual [rad]
_CORRELATED_ROWS = 10  # correlated rows that count as one
_HUBER_LIMIT = 3.0  # Huber limit, in standard deviations [-]
_MAX_STEPS = 8
_DIFFERENCE_STEP = (1e-3, 1e-3, 1e-4)  # steps of the numerical derivatives


@nb.njit(cache=True, error_model="numpy", nogil=True)
def second_order_response(command: np.ndarray, y: np.ndarray, lag: np.ndarray, out: np.ndarray) -> None:
    """Simulate the lag over commands, (n,) [rad], into `out`, (n,); after a nan command it restarts from `y`."""
    wn, zeta, bias = lag[0], lag[1], lag[2]
    h = STEP / _SUBSTEPS
    angle, rate, restart = y[0], 0.0, True
    for k in range(len(command)):
        if restart:
            angle, rate = y[k], 0.0
        out[k] = angle
        restart = not np.isfinite(command[k])
        if restart:
            continue
        for _ in range(_SUBSTEPS):
            rate += h * (wn * wn * (command[k] + bias - angle) - 2.0 * zeta * wn * rate)
            angle += h * rate


def identify(command: np.ndarray, y: np.ndarray, warm_start: np.ndarray | None = None) -> np.ndarray:
    """Estimate wn, zeta, b that minimise the free-run error, (3,).

    Args:
        command: (n,) [rad], nan where missing
        y: measured angle, (n,) [rad], nan where missing
        warm_start: start of the search, for example an earlier estimate
    """
    weight = 1.0 / _NOISE / np.sqrt(_CORRELATED_ROWS)
    y, out = np.where(np.isfinite(y), y, 0.0), np.empty(len(y))
    valid = np.isfinite(command)
    lag = (_PRIOR_MEAN if warm_start is None else warm_start).copy()

    def residual_of(parameters: np.ndarray) -> np.ndarray:
        second_order_response(command, y, parameters, out)
        return np.where(valid, (out - y) * weight, 0.0)

    residual = residual_of(lag)
    cost = _cost(residual, lag, weight)
    for _ in range(_MAX_STEPS):
        J = np.column_stack([(residual_of(lag + step) - residual) / step.sum() for step in np.diag(_DIFFERENCE_STEP)])
        huber_weight = 1.0 / np.maximum(np.abs(residual) / (_HUBER_LIMIT * weight * _NOISE), 1.0)
        H = (J * huber_weight[:, None]).T @ J + np.diag(_PRIOR_SIGMA**-2.0)
        descent = np.linalg.solve(H, (J * huber_weight[:, None]).T @ residual + (lag - _PRIOR_MEAN) / _PRIOR_SIGMA**2)
        for fraction in (1.0, 0.3, 0.1):
            trial = np.clip(lag - fraction * descent, _LOWER, _UPPER)
            trial_residual = residual_of(trial)
            if _cost(trial_residual, trial, weight) < cost:
                break
        else:
            break
        gain = cost - _cost(trial_residual, trial, weight)
        lag, residual, cost = trial, trial_residual, cost - gain
        if gain < 1e-3 * cost:
            break
    return lag


def _cost(residual: np.ndarray, lag: np.ndarray, weight: float) -> float:
    """Return the Huber cost of the residuals plus the cost of the deviation from the prior."""
    limit = _HUBER_LIMIT * weight * _NOISE
    size = np.abs(residual)
    huber = np.where(size < limit, size**2, limit * (2 * size - limit)).sum()
    return float(huber + (((lag - _PRIOR_MEAN) / _PRIOR_SIGMA) ** 2).sum())
