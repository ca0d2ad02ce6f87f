"""Inputs of TECS: filtered airspeed, and rate-limited speed and height demands.

Speeds are true airspeeds; heights are positive upward.
Source: ArduPlane TECS; the deceleration limit is identified from flights of ArduPlane 4.7.
"""

from math import cos, sin, sqrt

import numpy as np

from fleet.autopilots import control_law as S
from fleet.autopilots.arduplane import params as P
from fleet.autopilots.control_law import clip, kernel
from fleet.frames import G

_FILTER_BANDWIDTH = 2.0  # bandwidth of the airspeed filter [rad/s]
MIN_FILTERED_SPEED = 3.0  # lower limit of the airspeed filter [m/s]
_ACCEL_LAG = 0.2  # time constant for acceleration from velocity differences [s]


@kernel
def update_speed(
    ctl: np.ndarray, par: np.ndarray, v: np.ndarray, euler: np.ndarray, Va: float, Va_dot: float, dt: float
) -> None:
    """Filter airspeed and forward acceleration: second-order complementary filter of 2 rad/s.

    Args:
        ctl, par: controller state, parameters
        v: ground velocity, NED, (3,) [m/s]
        euler: phi, theta, psi (3,) [rad]
        Va: equivalent airspeed; nan: no sensor, cruise speed is used [m/s]
        Va_dot: forward acceleration; nan: derived from `v` [m/s2]
        dt: step [s]
    """
    update_acceleration(ctl, v, euler, Va_dot, dt)
    ctl[S.ACCEL_LP] += dt / (dt + par[P.TIME_CONST]) * (ctl[S.ACCEL] - ctl[S.ACCEL_LP])
    filter_speed(ctl, Va * par[P.EAS2TAS], par[P.VA_CRUISE] * par[P.EAS2TAS], dt)


@kernel
def update_acceleration(ctl: np.ndarray, v: np.ndarray, euler: np.ndarray, Va_dot: float, dt: float) -> None:
    """Update the forward acceleration ctl[S.ACCEL], from `Va_dot` or else from ground velocity differences.

    Args:
        ctl: controller state
        v, euler, Va_dot, dt: as for `update_speed`
    """
    if np.isfinite(Va_dot):
        ctl[S.ACCEL] = Va_dot
    elif ctl[S.HAS_VELOCITY] > 0.0 and dt > 0.0:
        ct, st = cos(euler[1]), sin(euler[1])
        d_n, d_e, d_d = v[0] - ctl[S.V_N], v[1] - ctl[S.V_E], v[2] - ctl[S.V_E + 1]
        forward = (d_n * ct * cos(euler[2]) + d_e * ct * sin(euler[2]) - d_d * st) / dt
        ctl[S.ACCEL] += dt / (dt + _ACCEL_LAG) * (clip(forward, -30.0, 30.0) - ctl[S.ACCEL])
    for j in range(3):
        ctl[S.V_N + j] = v[j]
    ctl[S.HAS_VELOCITY] = 1.0


@kernel
def filter_speed(ctl: np.ndarray, tas: float, default: float, dt: float) -> None:
    """Filter a true airspeed [m/s] with the forward acceleration; nan: use `default`."""
    if not np.isfinite(tas):
        ctl[S.V_HAT], ctl[S.V_DOT_HAT] = default, 0.0
        return
    error = tas - ctl[S.V_HAT]
    ctl[S.V_DOT_HAT] += error * _FILTER_BANDWIDTH * _FILTER_BANDWIDTH * dt
    ctl[S.V_HAT] += (ctl[S.V_DOT_HAT] + ctl[S.ACCEL] + error * _FILTER_BANDWIDTH * sqrt(2.0)) * dt
    if ctl[S.V_HAT] < MIN_FILTERED_SPEED:
        ctl[S.V_HAT], ctl[S.V_DOT_HAT] = MIN_FILTERED_SPEED, max(ctl[S.V_DOT_HAT], 0.0)


@kernel
def min_airspeed(par: np.ndarray, phi: float) -> float:
    """Return the minimum true airspeed, increased with the load factor of the bank [m/s]."""
    return par[P.VA_MIN] * par[P.EAS2TAS] / sqrt(max(cos(phi), 0.2))


@kernel
def demand_speed(ctl: np.ndarray, par: np.ndarray, va_c: float, phi: float, dt: float) -> float:
    """Rate-limit the speed demand by power and drag; return its high-passed rate [m/s2].

    Acceleration uses half the climb power, deceleration 0.9 of the drag (SINK_MIN at cruise, growing with V^2).
    """
    V = ctl[S.V_HAT]
    max_rate = 0.5 * par[P.CLIMB_MAX] * ctl[S.CLIMB_SHARE] * G / V
    min_rate = -0.9 * par[P.SINK_MIN] * G * V * V / (par[P.VA_CRUISE] * par[P.EAS2TAS]) ** 3
    low, high = min_airspeed(par, phi), par[P.VA_MAX] * par[P.EAS2TAS]
    if ctl[S.THR_SAT] > 0.0:  # no power left: lower the upper limit
        ctl[S.V_TOP] = max(ctl[S.V_TOP] + min_rate * dt, min(par[P.VA_CRUISE] * par[P.EAS2TAS], high))
    else:
        ctl[S.V_TOP] = min(ctl[S.V_TOP] + max(max_rate, 0.0) * dt, high)
    V_target = low if ctl[S.BAD_DESCENT] > 0.0 or ctl[S.UNDERSPEED] > 0.0 else va_c * par[P.EAS2TAS]
    V_target = max(min(V_target, ctl[S.V_TOP]), low)
    step = clip(V_target - ctl[S.V_DEM], min_rate * dt, max_rate * dt)
    ctl[S.V_DEM] += step
    rate = step / dt
    ctl[S.V_DEM_LP] += dt / (dt + par[P.TIME_CONST]) * (rate - ctl[S.V_DEM_LP])
    return rate - ctl[S.V_DEM_LP]


@kernel
def demand_height(ctl: np.ndarray, par: np.ndarray, h_sp: float, dt: float) -> float:
    """Rate-limit and lag the height demand; return the climb rate demand [m/s]."""
    mean = 0.5 * (h_sp + ctl[S.H_IN])
    ctl[S.H_IN] = h_sp
    down, up = par[P.SINK_MAX] * ctl[S.SINK_SHARE] * dt, par[P.CLIMB_MAX] * ctl[S.CLIMB_SHARE] * dt
    ctl[S.H_LIMITED] += clip(mean - ctl[S.H_LIMITED], -down, up)
    tau = max(par[P.H_TIME], dt)
    h_dot = (ctl[S.H_LIMITED] - ctl[S.H_DEM]) / tau
    ctl[S.H_DEM] += dt / (dt + tau) * (ctl[S.H_LIMITED] - ctl[S.H_DEM])
    _adapt_rate_shares(ctl, dt / (dt + tau))
    return h_dot


@kernel
def _adapt_rate_shares(ctl: np.ndarray, gain: float) -> None:
    """Reduce the climb or sink limit while throttle or pitch is saturated, else restore it."""
    up = ctl[S.THETA_SAT] > 0.0 or ctl[S.THR_SAT] > 0.0
    down = ctl[S.THETA_SAT] < 0.0 or ctl[S.THR_SAT] < 0.0
    if up and ctl[S.H_DEM] > ctl[S.H_LAST]:
        ctl[S.CLIMB_SHARE] *= 1.0 - gain
    elif down and ctl[S.H_DEM] < ctl[S.H_LAST]:
        ctl[S.SINK_SHARE] *= 1.0 - gain
    else:
        ctl[S.CLIMB_SHARE] += gain * (1.0 - ctl[S.CLIMB_SHARE])
        ctl[S.SINK_SHARE] += gain * (1.0 - ctl[S.SINK_SHARE])
    ctl[S.H_LAST] = ctl[S.H_DEM]
