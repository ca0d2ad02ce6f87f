"""Turn rate, angle of attack and excess power: three regressions with priors on smoothed flight data.

psi_dot = k g tan phi / V + b               theta - gamma = a_0 + a_n (n (V_0 / V)^2 - 1)
V_dot + g h_dot / V = c_0 + c_t (delta_t - t_0) + c_v (V - V_0) + c_n (n^2 - 1)
"""

from dataclasses import dataclass

import numpy as np

from fleet.frames import G
from twin_worker.identification.fixed_wing.attitude_lag import STEP

_OVER = 20  # rows of each mean
# mean of k [-] and b [rad/s], standard deviation, noise
_TURN = np.array([1.0, 0.0]), np.array([0.1, 0.02]), 0.03
_LIFT = np.array([0.0, 0.06]), np.array([1e3, 0.1]), 0.02  # the same of a_0, a_n [rad]
_POWER = np.array([0.0, np.nan, -0.10, -0.15]), np.array([30.0, 1.0, 0.03, 0.15]), 0.35  # the same of c, SI
_GLIDE, _STEEPER = 9.0, 1.3  # lift-to-drag ratio; slope of thrust over throttle relative to proportional [-]
_BANK = 1.3  # bank limit: larger load factors are noise [rad]


@dataclass(frozen=True)
class Flight:
    """Data in rows of `STEP`, all (n,): true airspeed, height, climb rate, angles, throttle;
    then commands: climb rate and airspeed of the route, angles of the autopilot [m/s, m, rad, 0..1].
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

    def __len__(self) -> int:
        return len(self.V)


@dataclass(frozen=True)
class Ridge:
    """Result of a regression with a prior: value (k,), covariance (k, k), residual standard deviation."""

    value: np.ndarray
    cov: np.ndarray
    left: float


def ridge(X: np.ndarray, y: np.ndarray, prior: tuple[np.ndarray, np.ndarray, float]) -> Ridge:
    """Regress y (n,) on X (n, k) with a Gaussian prior; rows overlap, so that `_WINDOW_ROWS` of them count as one."""
    usual, spread, noise = prior
    inverse = X.T @ X / _OVER / noise**2 + np.diag(spread**-2.0)
    cov = np.linalg.inv(inverse)
    value = cov @ (X.T @ y / _OVER / noise**2 + usual / spread**2)
    return Ridge(value, cov, float(np.std(y - X @ value)))


def mean(x: np.ndarray) -> np.ndarray:
    """Return the moving mean over `_WINDOW_ROWS` steps, (n - _WINDOW_ROWS,)."""
    total = np.concatenate([[0.0], np.cumsum(x)])
    return ((total[_OVER:] - total[:-_OVER]) / _OVER)[: len(x) - _OVER]


def slope(x: np.ndarray) -> np.ndarray:
    """Return the slope over `_WINDOW_ROWS` steps, (n - _WINDOW_ROWS,) [1/s]."""
    return (x[_OVER:] - x[:-_OVER]) / (_OVER * STEP)


def load(phi: np.ndarray) -> np.ndarray:
    """Return the load factor of a level turn [-]."""
    return 1.0 / np.cos(np.clip(phi, -_BANK, _BANK))


def turning(flight: Flight) -> Ridge:
    """Estimate k and b of the turn rate."""
    X = mean(G * np.tan(np.clip(flight.phi, -_BANK, _BANK)) / np.maximum(flight.V, 5.0))
    return ridge(np.column_stack([X, np.ones(len(X))]), slope(np.unwrap(flight.psi)), _TURN)


def lifting(flight: Flight, V_0: float) -> Ridge:
    """Estimate a_0 and a_n of the angle of attack."""
    alpha = flight.theta - np.arcsin(np.clip(flight.h_dot / np.maximum(flight.V, 5.0), -0.6, 0.6))
    X = mean(load(flight.phi) * (V_0 / np.maximum(flight.V, 5.0)) ** 2 - 1.0)
    return ridge(np.column_stack([np.ones(len(X)), X]), mean(alpha), _LIFT)


def _budget(flight: Flight, t_0: float, V_0: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the regressors of c_0 c_t c_v c_n, (n, 4), and the measured excess power, (n,) [m/s2]."""
    V = mean(flight.V)
    y = slope(0.5 * flight.V**2 + G * flight.h) / np.maximum(V, 5.0)
    n = mean(load(flight.phi) ** 2 - 1.0)
    return np.column_stack([np.ones(len(y)), mean(flight.delta_t) - t_0, V - V_0, n]), y


def missed(flight: Flight, c: np.ndarray, t_0: float, V_0: float) -> np.ndarray:
    """Return measured minus predicted excess power for c, (4,), (n,) [m/s2]."""
    X, y = _budget(flight, t_0, V_0)
    return y - X @ c  # type: ignore[no-any-return]


def power(flight: Flight, t_0: float, V_0: float) -> Ridge:
    """Estimate c_0, c_t, c_v, c_n of the specific excess power with instrumental variables.

    TECS reacts to every gust with throttle, which biases least squares: it returns one to two thirds of the true c_t.
    The route commands (height, speed, bank) do not depend on gusts and are the instruments: the regressors are first
    projected on them.

    Source: Soderstrom & Stoica 1989, chapter 8 (instrumental variables in closed loop).
    """
    X, y = _budget(flight, t_0, V_0)
    asked = np.column_stack([np.ones(len(y)), mean(flight.climb_c), mean(flight.V_c) - V_0, X[:, 3]])
    usual, spread, noise = _POWER
    usual = usual.copy()
    # t_0 balances drag in level flight; thrust grows faster
    usual[1] = _STEEPER * G / _GLIDE / max(t_0, 0.15)
    if np.isfinite(asked).all():
        X = asked @ np.linalg.lstsq(asked, X, rcond=1e-6)[0]
        return ridge(X, y, (usual, spread, noise))
    X[:, 1:] = 0.0
    return ridge(X, y, (usual, spread, noise))
