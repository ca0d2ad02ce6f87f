"""What the airframe does with bank, pitch and throttle in the large: three ridge regressions on smoothed flight.

psi_dot = k g tan phi / V + b               theta - gamma = a_0 + a_n (n (V_0 / V)^2 - 1)
V_dot + g h_dot / V = c_0 + c_t (delta_t - t_0) + c_v (V - V_0) + c_n (n^2 - 1)
"""

from dataclasses import dataclass

import numpy as np

from fleet.frames import G
from twin_worker.identification.fixed_wing.attitude_lag import STEP

_OVER = 20  # rows each mean is over
_TURN = np.array([1.0, 0.0]), np.array([0.1, 0.02]), 0.03  # usual k [-] and b [rad/s], spread, noise
_LIFT = np.array([0.0, 0.06]), np.array([1e3, 0.1]), 0.02  # usual a_0, a_n [rad]
_POWER = np.array([0.0, np.nan, -0.10, -0.15]), np.array([30.0, 1.0, 0.03, 0.15]), 0.35  # usual c, SI
_GLIDE, _STEEPER = 9.0, 1.3  # usual lift over drag; slope of thrust over throttle, beyond proportional [-]
_BANK = 1.3  # beyond, load factors are noise [rad]


@dataclass(frozen=True)
class Flight:
    """One stretch in rows of `STEP`, all (n,): true airspeed, height, climb, angles, throttle;
    then what was asked for: climb and airspeed by the route, angles by the autopilot [m/s, m, rad, 0..1].
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
    """A regression held by what is usual: value (k,), covariance (k, k), standard deviation of what is left."""

    value: np.ndarray
    cov: np.ndarray
    left: float


def ridge(X: np.ndarray, y: np.ndarray, prior: tuple[np.ndarray, np.ndarray, float]) -> Ridge:
    """Regress y (n,) on X (n, k); rows overlap, so that `_OVER` of them count as one."""
    usual, spread, noise = prior
    inverse = X.T @ X / _OVER / noise**2 + np.diag(spread**-2.0)
    cov = np.linalg.inv(inverse)
    value = cov @ (X.T @ y / _OVER / noise**2 + usual / spread**2)
    return Ridge(value, cov, float(np.std(y - X @ value)))


def mean(x: np.ndarray) -> np.ndarray:
    """Return the moving mean over `_OVER` steps, (n - _OVER,)."""
    total = np.concatenate([[0.0], np.cumsum(x)])
    return ((total[_OVER:] - total[:-_OVER]) / _OVER)[: len(x) - _OVER]


def slope(x: np.ndarray) -> np.ndarray:
    """Return the slope over `_OVER` steps, (n - _OVER,) [1/s]."""
    return (x[_OVER:] - x[:-_OVER]) / (_OVER * STEP)


def load(phi: np.ndarray) -> np.ndarray:
    """Return the load factor of a level turn [-]."""
    return 1.0 / np.cos(np.clip(phi, -_BANK, _BANK))


def turning(flight: Flight) -> Ridge:
    """Identify k and b of the turn."""
    X = mean(G * np.tan(np.clip(flight.phi, -_BANK, _BANK)) / np.maximum(flight.V, 5.0))
    return ridge(np.column_stack([X, np.ones(len(X))]), slope(np.unwrap(flight.psi)), _TURN)


def lifting(flight: Flight, V_0: float) -> Ridge:
    """Identify a_0 and a_n of the angle of attack."""
    alpha = flight.theta - np.arcsin(np.clip(flight.h_dot / np.maximum(flight.V, 5.0), -0.6, 0.6))
    X = mean(load(flight.phi) * (V_0 / np.maximum(flight.V, 5.0)) ** 2 - 1.0)
    return ridge(np.column_stack([np.ones(len(X)), X]), mean(alpha), _LIFT)


def _budget(flight: Flight, t_0: float, V_0: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what c_0 c_t c_v c_n are multiplied by, (n, 4), and the excess power that was had, (n,) [m/s2]."""
    V = mean(flight.V)
    y = slope(0.5 * flight.V**2 + G * flight.h) / np.maximum(V, 5.0)
    n = mean(load(flight.phi) ** 2 - 1.0)
    return np.column_stack([np.ones(len(y)), mean(flight.delta_t) - t_0, V - V_0, n]), y


def missed(flight: Flight, c: np.ndarray, t_0: float, V_0: float) -> np.ndarray:
    """Return the excess power that was had beyond what c, (4,), foretells, (n,) [m/s2]."""
    X, y = _budget(flight, t_0, V_0)
    return y - X @ c  # type: ignore[no-any-return]


def power(flight: Flight, t_0: float, V_0: float) -> Ridge:
    """Identify c_0, c_t, c_v, c_n of the specific excess power, by instruments.

    TECS answers every gust with throttle, so that plain regression finds gusts where it looks for power: it came out
    with a third to two thirds of the true c_t. What the route asks for (height, speed, bank) knows of no gust: the
    regressors are first projected on that.

    Source: Soderstrom & Stoica 1989, chapter 8 (instrumental variables in closed loop).
    """
    X, y = _budget(flight, t_0, V_0)
    asked = np.column_stack([np.ones(len(y)), mean(flight.climb_c), mean(flight.V_c) - V_0, X[:, 3]])
    usual, spread, noise = _POWER
    usual = usual.copy()
    usual[1] = _STEEPER * G / _GLIDE / max(t_0, 0.15)  # level flight takes t_0 against the drag, thrust grows faster
    if np.isfinite(asked).all():
        X = asked @ np.linalg.lstsq(asked, X, rcond=1e-6)[0]
        return ridge(X, y, (usual, spread, noise))
    X[:, 1:] = 0.0
    return ridge(X, y, (usual, spread, noise))
