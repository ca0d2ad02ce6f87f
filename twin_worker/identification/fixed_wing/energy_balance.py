"""Turn rate, angle of attack and excess power, and attitude lags: regressions with priors on smoothed flight data.

psi_dot = k g tan phi / V + b(t)            theta - gamma = a_0 + a_n (n (V_0 / V)^2 - 1)
V_dot + g h_dot / V = c_0 + c_t (delta_t - t_0) + c_v (V - V_0) + c_n (n^2 - 1)
"""

from dataclasses import dataclass

import numba as nb
import numpy as np

from fleet.frames import G
from twin_worker.numerics.gauss_newton import gauss_newton

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
_BESIDE = np.vstack([np.zeros(3), np.diag(_DIFFERENCE_STEP)])


@nb.njit(cache=True, error_model="numpy", nogil=True, _nrt=False)  # type: ignore[call-overload]
def _lag_sums(command: np.ndarray, y: np.ndarray, lags: np.ndarray, state: np.ndarray, sums: np.ndarray) -> float:
    """Simulate several lags, and sum over the rows with a command; after one without, each restarts from `y`.

    Args:
        command: (n,) [rad], nan where missing
        y: measured angle, (n,) [rad], nan where missing
        lags: the lag, and lags beside it for the numerical derivatives, (m, 3)
        state: overwritten, (m, 2)
        sums: output, w d_i d_j, where d_0 is the residual, the others its derivatives, w the Huber weight, (m, m)
    Returns:
        the Huber cost of the residuals
    """
    m, h, weight = len(lags), STEP / _SUBSTEPS, 1.0 / (_NOISE * np.sqrt(_CORRELATED_ROWS))
    limit, cost, restart = _HUBER_LIMIT * weight * _NOISE, 0.0, True
    for i in range(m):
        for j in range(m):
            sums[i, j] = 0.0
    for k in range(len(command)):
        measured = y[k] if np.isfinite(y[k]) else 0.0
        if restart:
            for i in range(m):
                state[i, 0], state[i, 1] = measured, 0.0
        restart = not np.isfinite(command[k])
        if restart:
            continue
        residual = (state[0, 0] - measured) * weight
        size = abs(residual)
        huber_weight = 1.0 / max(size / limit, 1.0)
        cost += size * size if size < limit else limit * (2.0 * size - limit)
        for i in range(m):
            d_i = residual if i == 0 else (state[i, 0] - state[0, 0]) * weight / _DIFFERENCE_STEP[i - 1]
            for j in range(i + 1):
                d_j = residual if j == 0 else (state[j, 0] - state[0, 0]) * weight / _DIFFERENCE_STEP[j - 1]
                sums[i, j] += huber_weight * d_i * d_j
        for i in range(m):
            wn, zeta, target = lags[i, 0], lags[i, 1], command[k] + lags[i, 2]
            angle, rate = state[i, 0], state[i, 1]
            for _ in range(_SUBSTEPS):
                rate += h * (wn * wn * (target - angle) - 2.0 * zeta * wn * rate)
                angle += h * rate
            state[i, 0], state[i, 1] = angle, rate
    for i in range(m):
        for j in range(i):
            sums[j, i] = sums[i, j]
    return cost  # type: ignore[no-any-return]


def fit_attitude_lag(command: np.ndarray, y: np.ndarray, warm_start: np.ndarray | None = None) -> np.ndarray:
    """Estimate wn, zeta, b that minimise the free-run error, (3,).

    Args:
        command: (n,) [rad], nan where missing
        y: measured angle, (n,) [rad], nan where missing
        warm_start: start of the search, for example an earlier estimate
    """
    command, y = np.ascontiguousarray(command), np.ascontiguousarray(y)
    start = _PRIOR_MEAN if warm_start is None else warm_start
    state, sums, no_sums = np.empty((4, 2)), np.empty((4, 4)), np.empty((1, 1))
    precision = _PRIOR_SIGMA**-2.0

    def linearise(lag: np.ndarray, count: int) -> tuple[float, np.ndarray, np.ndarray]:
        cost = _lag_sums(command, y, lag + _BESIDE, state, sums)
        offset = lag - _PRIOR_MEAN
        H = sums[1:, 1:] + np.diag(precision)
        return cost + float(precision @ offset**2), H, -(sums[1:, 0] + offset * precision)

    def move(lag: np.ndarray, change: np.ndarray) -> tuple[np.ndarray, float]:
        candidate = np.clip(lag + change, _LOWER, _UPPER)
        cost = _lag_sums(command, y, candidate[None], state, no_sums)
        return candidate, cost + float(precision @ (candidate - _PRIOR_MEAN) ** 2)

    return gauss_newton(start.copy(), linearise, move, steps=_MAX_STEPS, mu=0.0)[0]


_WINDOW_ROWS = 20  # rows of each mean
_TURN_PRIOR = np.array([1.0, 0.0]), np.array([0.1, 0.02])  # mean of k [-] and b [rad/s], standard deviation
# hypotheses on b, of equal prior probability: random walk [rad/s per sqrt(s)], noise of a row [rad/s]
_TURN_WALK, _TURN_NOISE = (
    values.ravel() for values in np.meshgrid((0.0, 0.002, 0.005, 0.01, 0.02), (0.005, 0.01, 0.02, 0.03, 0.05))
)
_LIFT_PRIOR = np.array([0.0, 0.06]), np.array([1e3, 0.1]), 0.02  # the same of a_0, a_n [rad]
_POWER_PRIOR = np.array([0.0, np.nan, -0.10, -0.15]), np.array([30.0, 1.0, 0.03, 0.15]), 0.35  # the same of c, SI
_GLIDE_RATIO, _THRUST_SLOPE = 9.0, 1.3  # lift-to-drag ratio; slope of thrust over throttle relative to proportional [-]
_MAX_BANK = 1.3  # bank limit: larger load factors are noise [rad]


@dataclass(frozen=True)
class PointMassData:
    """Data in rows of `STEP`, all (n,): true airspeed, height, climb rate, angles, throttle;
    then commands: climb rate and airspeed of the route, angles of the autopilot [m/s, m, rad, 0..1]; then whether a
    row lies outside the gaps of telemetry, None: all do.
    """

    V: np.ndarray
    h: np.ndarray
    h_dot: np.ndarray
    phi: np.ndarray
    theta: np.ndarray
    psi: np.ndarray
    delta_t: np.ndarray
    climb_c: np.ndarray
    V_c: np.ndarray
    phi_c: np.ndarray
    theta_c: np.ndarray
    valid: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.V)

    @property
    def measured(self) -> np.ndarray:
        """Return which moving means and slopes contain no row in a gap, (n - _WINDOW_ROWS,) bool."""
        invalid = np.zeros(len(self)) if self.valid is None else ~self.valid
        total = np.concatenate([[0.0], np.cumsum(invalid)])
        return total[_WINDOW_ROWS + 1 :] == total[: -_WINDOW_ROWS - 1]


@dataclass(frozen=True)
class RegressionResult:
    """Result of a regression with a prior: value (k,), covariance (k, k)."""

    value: np.ndarray
    cov: np.ndarray


def regress_with_prior(X: np.ndarray, y: np.ndarray, prior: tuple[np.ndarray, np.ndarray, float]) -> RegressionResult:
    """Regress y (n,) on X (n, k) with a Gaussian prior; rows overlap, so that `_WINDOW_ROWS` of them count as one."""
    prior_mean, prior_sigma, noise = prior
    information = X.T @ X / _WINDOW_ROWS / noise**2 + np.diag(prior_sigma**-2.0)
    cov = np.linalg.inv(information)
    value = cov @ (X.T @ y / _WINDOW_ROWS / noise**2 + prior_mean / prior_sigma**2)
    return RegressionResult(value, cov)


def moving_mean(x: np.ndarray) -> np.ndarray:
    """Return the moving mean over `_WINDOW_ROWS` steps, (n - _WINDOW_ROWS,)."""
    total = np.concatenate([[0.0], np.cumsum(x)])
    return ((total[_WINDOW_ROWS:] - total[:-_WINDOW_ROWS]) / _WINDOW_ROWS)[: len(x) - _WINDOW_ROWS]


def moving_slope(x: np.ndarray) -> np.ndarray:
    """Return the slope over `_WINDOW_ROWS` steps, (n - _WINDOW_ROWS,) [1/s]."""
    return (x[_WINDOW_ROWS:] - x[:-_WINDOW_ROWS]) / (_WINDOW_ROWS * STEP)


def load_factor(phi: np.ndarray) -> np.ndarray:
    """Return the load factor of a level turn [-]."""
    return 1.0 / np.cos(np.clip(phi, -_MAX_BANK, _MAX_BANK))


@nb.njit(cache=True, error_model="numpy", nogil=True, _nrt=False)  # type: ignore[call-overload]
def _filter_turn_rate(
    rate: np.ndarray,
    y: np.ndarray,
    measured: np.ndarray,
    hypotheses: tuple[np.ndarray, np.ndarray],
    x: np.ndarray,
    P: np.ndarray,
    log_likelihood: np.ndarray,
) -> None:
    """Filter k and b by every hypothesis, in place.

    Args:
        rate, y, measured: g tan(phi) / V, psi_dot, and whether both are known, (n,)
        hypotheses: random walk and noise, (m,)
        x, P: mean and covariance of k and b, (m, 2) and (m, 2, 2)
        log_likelihood: of the flight, (m,)
    """
    walk, noise = hypotheses
    for m in range(len(x)):
        for i in range((len(y) - 1) % _WINDOW_ROWS, len(y), _WINDOW_ROWS):  # independent rows
            P[m, 1, 1] += walk[m] ** 2 * _WINDOW_ROWS * STEP
            if not measured[i]:
                continue
            from_k, from_b = P[m, 0, 0] * rate[i] + P[m, 0, 1], P[m, 1, 0] * rate[i] + P[m, 1, 1]
            error = y[i] - x[m, 0] * rate[i] - x[m, 1]
            variance = from_k * rate[i] + from_b + noise[m] ** 2
            x[m, 0] += from_k * error / variance
            x[m, 1] += from_b * error / variance
            P[m, 0, 0] -= from_k * from_k / variance
            P[m, 0, 1] -= from_k * from_b / variance
            P[m, 1, 0] = P[m, 0, 1]
            P[m, 1, 1] -= from_b * from_b / variance
            log_likelihood[m] -= 0.5 * (error * error / variance + np.log(variance))


def fit_turn_rate(data: PointMassData) -> RegressionResult:
    """Estimate k, and b at the end of the data.

    b is the error of the attitude estimate, which drifts in long turns: a random walk. Its size, zero included, and the
    noise are hypotheses; each is filtered, and the estimates are averaged with the likelihood of the flight.
    Source: Bar-Shalom 2001, 5.2 (Kalman filter), 11.6.2 (static multiple-model estimator).
    """
    rate = moving_mean(G * np.tan(np.clip(data.phi, -_MAX_BANK, _MAX_BANK)) / np.maximum(data.V, 5.0))
    y, measured = moving_slope(np.unwrap(data.psi)), data.measured
    prior_mean, prior_sigma = _TURN_PRIOR
    n = len(_TURN_WALK)
    x, P, log_likelihood = np.tile(prior_mean, (n, 1)), np.tile(np.diag(prior_sigma**2), (n, 1, 1)), np.zeros(n)
    _filter_turn_rate(rate, y, measured, (_TURN_WALK, _TURN_NOISE), x, P, log_likelihood)
    weight = np.exp(log_likelihood - log_likelihood.max())
    weight /= weight.sum()
    value = weight @ x
    spread = x - value
    return RegressionResult(value, np.einsum("m,mij->ij", weight, P + spread[:, :, None] * spread[:, None, :]))


def fit_angle_of_attack(data: PointMassData, V_0: float) -> RegressionResult:
    """Estimate a_0 and a_n of the angle of attack."""
    alpha = data.theta - np.arcsin(np.clip(data.h_dot / np.maximum(data.V, 5.0), -0.6, 0.6))
    X = moving_mean(load_factor(data.phi) * (V_0 / np.maximum(data.V, 5.0)) ** 2 - 1.0)
    A, rows = np.column_stack([np.ones(len(X)), X]), data.measured
    return regress_with_prior(A[rows], moving_mean(alpha)[rows], _LIFT_PRIOR)


def _power_regression(data: PointMassData, t_0: float, V_0: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the regressors of c_0 c_t c_v c_n, (n, 4), and the measured excess power, (n,) [m/s2]."""
    V = moving_mean(data.V)
    y = moving_slope(0.5 * data.V**2 + G * data.h) / np.maximum(V, 5.0)
    n = moving_mean(load_factor(data.phi) ** 2 - 1.0)
    return np.column_stack([np.ones(len(y)), moving_mean(data.delta_t) - t_0, V - V_0, n]), y


def excess_power_residual(data: PointMassData, c: np.ndarray, t_0: float, V_0: float) -> np.ndarray:
    """Return measured minus predicted excess power for c, (4,), (n,) [m/s2]."""
    X, y = _power_regression(data, t_0, V_0)
    return (y - X @ c)[data.measured]  # type: ignore[no-any-return]


def fit_excess_power(data: PointMassData, t_0: float, V_0: float) -> RegressionResult:
    """Estimate c_0, c_t, c_v, c_n of the specific excess power with instrumental variables.

    TECS reacts to every gust with throttle, which biases least squares: it returns one to two thirds of the true c_t.
    The route commands (height, speed, bank) do not depend on gusts and are the instruments: the regressors are first
    projected on them.

    Source: Soderstrom & Stoica 1989, chapter 8 (instrumental variables in closed loop).
    """
    (X, y), rows = _power_regression(data, t_0, V_0), data.measured
    instruments = np.column_stack([np.ones(len(y)), moving_mean(data.climb_c), moving_mean(data.V_c) - V_0, X[:, 3]])
    prior_mean, prior_sigma, noise = _POWER_PRIOR
    prior_mean = prior_mean.copy()
    # t_0 balances drag in level flight; thrust grows faster
    prior_mean[1] = _THRUST_SLOPE * G / _GLIDE_RATIO / max(t_0, 0.15)
    if np.isfinite(instruments[rows]).all():
        X = instruments @ np.linalg.lstsq(instruments[rows], X[rows], rcond=1e-6)[0]
    else:
        X[:, 1:] = 0.0
    return regress_with_prior(X[rows], y[rows], (prior_mean, prior_sigma, noise))
