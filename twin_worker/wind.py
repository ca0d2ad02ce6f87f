"""Mean wind and airspeed scale from ground velocity, airspeed and heading: a Kalman filter on the wind triangle."""

from math import atan2, cos, hypot, sin, sqrt

import numpy as np
from filterpy.kalman import KalmanFilter

_WANDER = 0.12  # random walk of the wind [m/s per sqrt(s)]
_SIGMA = 1.5  # gusts and sensors in one ground-velocity component [m/s]
_GATE = 25.0  # squared normalised innovation beyond which a row is ignored


class WindFilter:
    """States a, b, w_n, w_e of  v = Va cos(gamma) (a e(psi) + b e(psi + 90 deg)) + w.

    a, b are airspeed scale times cosine and sine of the heading bias.
    Source: Beard & McLain 2012, section 2.4 (wind triangle); gating after Bar-Shalom 2001, section 5.4.
    """

    def __init__(self) -> None:
        filt = KalmanFilter(dim_x=4, dim_z=2)
        filt.x = np.array([1.0, 0.0, 0.0, 0.0])
        filt.P = np.diag([0.04**2, 0.05**2, 64.0, 64.0])
        filt.R = np.eye(2) * _SIGMA**2
        self._filter = filt
        self._rows = 0
        self.t = -np.inf

    def update(self, t: float, ground: np.ndarray, Va: float, psi: float) -> None:
        """Take one row: ground velocity NED (3,) [m/s], reported airspeed [m/s], heading [rad]."""
        dt = min(t - self.t, 5.0) if np.isfinite(self.t) else 0.2
        if dt <= 0 or Va < 3.0:
            return
        self.t = t
        level = Va * sqrt(max(1 - (ground[2] / Va) ** 2, 0.25))
        c, s = level * cos(psi), level * sin(psi)
        H = np.array([[c, -s, 1.0, 0.0], [s, c, 0.0, 1.0]])
        filt = self._filter
        filt.predict(Q=np.diag([1e-8, 1e-8, _WANDER**2 * dt, _WANDER**2 * dt]))
        y = ground[:2] - H @ filt.x
        S = H @ filt.P @ H.T + filt.R
        self._rows += 1
        if self._rows < 50 or y @ np.linalg.solve(S, y) < _GATE:
            filt.update(ground[:2], H=H)

    @property
    def wind(self) -> np.ndarray:
        """Give the wind, NED, the direction it blows to, (3,) [m/s]."""
        return np.array([self._filter.x[2], self._filter.x[3], 0.0])

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
        """Give the standard deviation of the wind's larger component [m/s]."""
        return sqrt(max(self._filter.P[2, 2], self._filter.P[3, 3]))
