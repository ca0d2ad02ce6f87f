"""A point mass with lags that the control laws fly in tests."""

from math import cos, pi, sin, tan

import numpy as np

from fleet import mission as m
from fleet.autopilots import arduplane as ap
from fleet.autopilots import laws
from fleet.frames import G

HERE = np.full(3, np.nan)
PLANE = {"AIRSPEED_CRUISE": 20, "AIRSPEED_MIN": 12, "AIRSPEED_MAX": 28, "SCALING_SPEED": 20, "WP_RADIUS": 50}
PAR, _ = ap.parameters(PLANE)
TRIM_ALPHA, TRIM_THR = 0.06, 0.5


def leg(kind=m.WAYPOINT, n=0.0, e=0.0, h=100.0, **more) -> list[float]:
    row = np.zeros(m.N_COLUMNS)
    row[m.KIND], row[m.P_N], row[m.P_E], row[m.P_D] = kind, n, e, -h
    for name, value in more.items():
        row[getattr(m, name.upper())] = value
    return list(row)


def route(*rows) -> np.ndarray:
    out = np.array(rows)
    out[:, m.SEQ] = np.arange(1, len(out) + 1)
    return out


class Plane:
    """A point mass: roll, pitch and flight path follow with lags, thrust and drag change the speed."""

    def __init__(self, p=(0.0, 0.0, -100.0), Va=20.0, psi=0.0, wind=(0.0, 0.0)):
        self.p, self.Va, self.psi, self.gamma, self.phi, self.wind = np.array(p), Va, psi, 0.0, 0.0, wind
        self.theta = TRIM_ALPHA

    @property
    def v(self):
        ground = self.Va * cos(self.gamma)
        n, e = ground * cos(self.psi) + self.wind[0], ground * sin(self.psi) + self.wind[1]
        return np.array([n, e, -self.Va * sin(self.gamma)])

    @property
    def euler(self):
        return np.array([self.phi, self.theta, (self.psi + pi) % (2 * pi) - pi])

    def step(self, phi_c, theta_c, delta_t, dt):
        self.p = self.p + self.v * dt
        load = 1 / cos(self.phi) ** 2 - 1
        pull = 8 * (delta_t - TRIM_THR) - 0.1 * (self.Va - 20) - 0.3 * load - G * sin(self.gamma)
        self.Va = max(self.Va + pull * dt, 5.0)
        self.phi += (phi_c - self.phi) * dt / 0.4
        self.theta += (theta_c - self.theta) * dt / 0.4
        self.gamma += (self.theta - TRIM_ALPHA - self.gamma) * dt / 0.6
        self.psi += G * tan(self.phi) / self.Va * dt


def begin(legs, plane, par=PAR, start=HERE):
    return laws.init(
        par, legs, 0, np.array(start, float), plane.p, plane.v, plane.euler, plane.Va, TRIM_ALPHA, TRIM_THR
    )


def fly(legs, plane, seconds, par=PAR, *, start=HERE, dt=0.1, sensor=True, ctl=None):
    """Fly a plane along legs and record t, p, v, euler, Va, phi_c, theta_c, delta_t, leg, each row one step."""
    ctl = begin(legs, plane, par, start) if ctl is None else ctl
    rows = []
    for k in range(round(seconds / dt)):
        p, v, euler, Va = plane.p.copy(), plane.v, plane.euler, plane.Va
        seq = legs[int(ctl[ap.LEG]), m.SEQ]
        out = laws.guide(ctl, par, legs, p, v, euler, Va if sensor else np.nan, np.nan, dt)
        rows.append([k * dt, *p, *v, *euler, Va, *out, seq])
        for _ in range(4):
            plane.step(*out, dt / 4)
    return np.array(rows), ctl
