"""Wind and airspeed scale from ground velocity, airspeed and heading: a Kalman filter on the wind triangle."""

from math import atan2, cos, exp, hypot, sin, sqrt

import numpy as np
from filterpy.kalman import KalmanFilter

DRIFT, DRIFT_S = 0.6, 60.0  # slow change of the wind: standard deviation, correlation time [m/s, s]
GUST, GUST_S = 0.8, 7.0  # turbulence along the flight, likewise
_WANDER = 0.01  # random walk of the mean [m/s per sqrt(s)]
_SIGMA = 1.0  # sideslip and sensors in one ground-velocity component [m/s]
_GATE = 25.0  # squared normalised innovation beyond which a row is ignored
_SURPRISE_S = 60.0  # innovations are averaged over as much [s]
_CALM, _ROUGH = 0.05, 10.0  # least and most mean squared innovation that is believed [-]
_START = np.array([0.03, 0.03, 6.0, 6.0, DRIFT, DRIFT, GUST, GUST])


class WindFilter:
    """States a, b, mean, drift, gust of  v = Va cos(gamma) (a e(psi) + b e(psi + 90 deg)) + mean + drift + gust.

    a, b are airspeed scale times cosine and sine of the heading bias; the mean wanders, drift and gust are first-order
    Gauss-Markov processes, so that a gust does not pass for wind.
    Source: Beard & McLain 2012, sec. 2.4 (wind triangle); Bar-Shalom 2001, 5.4 (gating), 8.2 (coloured noise).
    """

    def __init__(self) -> None:
        filt = KalmanFilter(dim_x=8, dim_z=2)
        filt.x = np.array([1.0, *np.zeros(7)])
        filt.P = np.diag(_START**2)
        filt.R = np.eye(2) * _SIGMA**2
        self._filter = filt
        self._rows = 0
        self._surprise = 1.0
        self.t = -np.inf

    def update(self, t: float, ground: np.ndarray, Va: float, psi: float) -> None:
        """Take one row: ground velocity NED (3,) [m/s], reported airspeed [m/s], heading [rad]."""
        dt = min(t - self.t, 5.0) if np.isfinite(self.t) else 0.2
        if dt <= 0 or Va < 3.0:
            return
        self.t = t
        level = Va * sqrt(max(1 - (ground[2] / Va) ** 2, 0.25))
        c, s = level * cos(psi), level * sin(psi)
        H = np.hstack([[[c, -s], [s, c]], np.tile(np.eye(2), 3)])
        filt = self._filter
        keep = np.array([1.0, 1.0, 1.0, 1.0, *[exp(-dt / DRIFT_S)] * 2, *[exp(-dt / GUST_S)] * 2])
        walk = np.array([1e-8, 1e-8, _WANDER**2 * dt, _WANDER**2 * dt, *(_START[4:] ** 2 * (1 - keep[4:] ** 2))])
        filt.predict(F=np.diag(keep), Q=np.diag(walk))
        y = ground[:2] - H @ filt.x
        S = H @ filt.P @ H.T + filt.R
        self._rows += 1
        surprise = float(y @ np.linalg.solve(S, y))
        self._surprise += dt / _SURPRISE_S * (min(surprise, _GATE) / len(y) - self._surprise)
        if self._rows < 50 or surprise < _GATE:
            filt.update(ground[:2], H=H)

    def blow(self, t: float, wind: np.ndarray) -> None:
        """Believe this wind at time `t` [s since 1970], NED, (3,) [m/s]."""
        self.t = t
        self._filter.x[2:6] = *wind[:2], 0.0, 0.0  # mean, and no drift from it

    def jump(self, wind: np.ndarray, scale: float, doubt: float) -> None:
        """Let wind and airspeed sensor change at once, by what is known only up to a share `doubt`.

        Args:
            wind: added, NED, (3,) [m/s]
            scale: true over reported airspeed from now on, over what it was [-]
            doubt: standard deviation, as a share of the change
        """
        x, P = self._filter.x, self._filter.P
        x[2:4] += wind[:2]
        P[[2, 3], [2, 3]] += (doubt * wind[:2]) ** 2
        P[[0, 1], [0, 1]] += (doubt * (scale - 1.0) * x[:2]) ** 2
        x[:2] *= scale

    @property
    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Give a, b, mean, drift and gust, north before east, (8,) [-, m/s], and their covariance, (8, 8)."""
        return self._filter.x.copy(), self._filter.P.copy()

    @property
    def wind(self) -> np.ndarray:
        """Give the wind without its gusts, NED, the direction it blows to, (3,) [m/s]."""
        x = self._filter.x
        return np.array([x[2] + x[4], x[3] + x[5], 0.0])

    @property
    def roughness(self) -> float:
        """Give how rough the air of the last minute was, over what the filter takes for usual [-]."""
        return sqrt(min(max(self._surprise, _CALM), _ROUGH))

    @property
    def scale(self) -> float:
        """Give true over reported airspeed [-]."""
        return hypot(self._filter.x[0], self._filter.x[1])

    @property
    def heading_bias(self) -> float:
        """Give air-velocity direction minus reported heading [rad]."""
        return atan2(self._filter.x[1], self._filter.x[0])

    @property
    def sigma(self) -> float:
        """Give the standard deviation of the larger component of the wind without gusts [m/s]."""
        P = self._filter.P
        both = P[2:4, 2:4] + P[2:4, 4:6] + P[4:6, 2:4] + P[4:6, 4:6]
        return sqrt(max(both[0, 0], both[1, 1]))
