"""NPFG: lateral acceleration so that the ground track converges to a path in wind.

    e_b = v_g tau      la = pi/2 (min(|e|/e_b, 1) - 1)^2      bearing = cos(la) towards the path + sin(la) along it
    air course from the wind triangle      a_lat = p V sin(d_chi) + curvature feed-forward, p = 4 pi zeta / T

`e` is the distance to the right of the path. Right is positive.
Source: Stastny & Siegwart, "On Flying Backwards" (2019), and Stastny, "Low-Altitude Control and Local Re-Planning
Strategies for Small Fixed-Wing UAVs" (2020), as implemented in PX4 (NPFG).
"""

from math import atan, cos, hypot, pi, sin, sqrt

import numpy as np

from fleet.autopilots.common.controller_state import W_E, W_N
from fleet.autopilots.common.kernels import angle_to, clip, kernel
from fleet.autopilots.px4_fixedwing import params as P
from fleet.frames import G

_MIN_RADIUS_RATIO = 0.1  # lower limit of 1 - kappa e in the feed-forward [-]
_MAX_SWITCH_DISTANCE = 500.0  # maximum switch distance [m]
_MIN_AIRSPEED = 3.0  # minimum airspeed in the equations [m/s]


@kernel
def period(par: np.ndarray) -> float:
    """Return the period: the parameter, but not below the limit of the roll loop [s]."""
    min_period = pi * par[P.NPFG_TC] / par[P.DAMPING] * par[P.PERIOD_SF]
    return max(par[P.PERIOD], min_period) if par[P.LB_PERIOD] > 0.0 else par[P.PERIOD]


@kernel
def error_bound(par: np.ndarray, speed: float) -> float:
    """Return the distance beyond which the path is approached at right angles, for a ground speed [m]."""
    tau = period(par) * par[P.DAMPING]
    return speed * tau if speed > 1.0 else 0.5 * tau * (speed * speed + 1.0)


@kernel
def switch_distance(par: np.ndarray, speed: float) -> float:
    """Return the distance to a waypoint at which the next leg starts [m]."""
    return max(min(par[P.SWITCH] * error_bound(par, speed), _MAX_SWITCH_DISTANCE), par[P.ACC_RAD])


@kernel
def _air_course(par: np.ndarray, b_n: float, b_e: float, V: float) -> tuple[float, float, bool]:
    """Return the air velocity for ground course b in wind, and whether it exists; else the upwind direction."""
    crosswind = par[W_N] * b_e - par[W_E] * b_n
    if abs(crosswind) < V:
        air_along = sqrt(V * V - crosswind * crosswind)
        if air_along + par[W_N] * b_n + par[W_E] * b_e > 0.0:
            return air_along * b_n - crosswind * b_e, air_along * b_e + crosswind * b_n, True
    return -par[W_N], -par[W_E], False


@kernel
def _curvature_accel(par: np.ndarray, t_n: float, t_e: float, v: np.ndarray, V: float, e: float, kappa: float) -> float:
    """Return the lateral acceleration through the air for the path curvature `kappa` [1/m] [m/s2]."""
    w_t, w_c = par[W_N] * t_n + par[W_E] * t_e, par[W_N] * t_e - par[W_E] * t_n
    ratio = 1.0 + w_t / sqrt(max(V * V - w_c * w_c, 1.0))
    along = max(v[0] * t_n + v[1] * t_e, 0.0)
    return V * ratio * along * kappa / max(1.0 - kappa * e, _MIN_RADIUS_RATIO)


@kernel
def follow(
    par: np.ndarray, t_n: float, t_e: float, e: float, kappa: float, v: np.ndarray, psi: float, V: float
) -> float:
    """Return the lateral acceleration to follow a path.

    Args:
        par: parameters, including the wind estimate
        t_n, t_e: unit vector along the path at its nearest point
        e: distance right of it [m]
        kappa: its curvature, positive to the right [1/m]
        v: ground velocity, NED, (3,) [m/s]
        psi: heading, used without air velocity [rad]
        V: true airspeed [m/s]
    Returns:
        lateral acceleration, right positive [m/s2]
    """
    V = max(V, _MIN_AIRSPEED)
    e_normalised = min(abs(e) / error_bound(par, hypot(v[0], v[1])), 1.0)
    look_angle = 0.5 * pi * (e_normalised - 1.0) ** 2
    side = -1.0 if e > 0.0 else 1.0  # towards the path: right is (-t_e, t_n)
    b_n, b_e = (
        cos(look_angle) * side * -t_e + sin(look_angle) * t_n,
        cos(look_angle) * side * t_n + sin(look_angle) * t_e,
    )
    c_n, c_e, feasible = _air_course(par, b_n, b_e, V)
    a_n, a_e = v[0] - par[W_N], v[1] - par[W_E]
    if hypot(a_n, a_e) < 1.0:
        a_n, a_e = cos(psi), sin(psi)
    d_chi = angle_to(a_n, a_e, c_n, c_e)
    gain = 4.0 * pi * par[P.DAMPING] / period(par) * V
    a_lat = gain * (sin(d_chi) if abs(d_chi) < 0.5 * pi else (1.0 if d_chi > 0.0 else -1.0))
    if kappa != 0.0 and feasible:
        a_lat += sin(look_angle) ** 2 * _curvature_accel(par, t_n, t_e, v, V, e, kappa)
    return a_lat


@kernel
def to_roll(par: np.ndarray, a_lat: float, phi_last: float, dt: float) -> float:
    """Convert lateral acceleration [m/s2] to bank, limited and slew-limited from the previous demand [rad]."""
    phi = clip(atan(a_lat / G), -par[P.ROLL_LIMIT], par[P.ROLL_LIMIT])
    step = par[P.ROLL_SLEW] * dt
    return clip(phi, phi_last - step, phi_last + step) if step > 0.0 else phi
