"""TECS: throttle controls total energy, pitch its distribution between height and speed.

    SPE = g h      SKE = V^2 / 2      STE = SPE + SKE (throttle)      SEB = w_p SPE - w_k SKE (pitch)

Speeds are true airspeeds; heights are positive upward.
Source: Lambregts, "Total Energy Based Flight Control System" (1983); ArduPlane TECS.
"""

from math import cos

import numpy as np

from fleet.autopilots import control_law as S
from fleet.autopilots.arduplane import params as P
from fleet.autopilots.arduplane.demand import MIN_FILTERED_SPEED, demand_height, demand_speed, min_airspeed
from fleet.autopilots.control_law import clip, kernel
from fleet.frames import G


@kernel
def pitch_limits(par: np.ndarray) -> tuple[float, float]:
    """Return the lowest and highest pitch demand [rad]; a TECS limit of zero selects the general limit."""
    low = max(par[P.TECS_LOW], par[P.PITCH_LOW]) if par[P.TECS_LOW] < 0.0 else par[P.PITCH_LOW]
    high = min(par[P.TECS_HIGH], par[P.PITCH_HIGH]) if par[P.TECS_HIGH] > 0.0 else par[P.PITCH_HIGH]
    return low, high


@kernel
def energy_rates(ctl: np.ndarray, par: np.ndarray) -> tuple[float, float]:
    """Return the specific total energy rates at idle and full throttle [m2/s3]."""
    return -par[P.SINK_MIN] * G, max(par[P.CLIMB_MAX] * ctl[S.CLIMB_SHARE], 0.1) * G


@kernel
def _update_flags(ctl: np.ndarray, par: np.ndarray, h: float, phi: float, error: float, rate: float) -> None:
    """Detect underspeed (latched until the height is regained) and descent at full throttle."""
    too_slow = ctl[S.V_HAT] < 0.9 * min_airspeed(par, phi) and ctl[S.THR] + ctl[S.I_THR] >= 0.95 * par[P.THR_MAX]
    ctl[S.UNDERSPEED] = 1.0 if too_slow or (ctl[S.UNDERSPEED] > 0.0 and h < ctl[S.H_IN]) else 0.0
    full = ctl[S.THR] + ctl[S.I_THR] >= 0.9 * par[P.THR_MAX]
    falling = error > 200.0 and rate < 0.0 and full
    ctl[S.BAD_DESCENT] = (
        1.0 if ctl[S.UNDERSPEED] == 0.0 and (falling or (ctl[S.BAD_DESCENT] > 0.0 and error > 0.0)) else 0.0
    )


@kernel
def _throttle(ctl: np.ndarray, par: np.ndarray, h: float, h_dot: float, v_rate: float, phi: float, dt: float) -> float:
    """Close the loop on total energy; return the throttle 0..1."""
    idle, full = energy_rates(ctl, par)
    V, tc, thr_range = ctl[S.V_HAT], par[P.TIME_CONST], par[P.THR_MAX] - par[P.THR_MIN]
    ske, low, high = 0.5 * V * V, par[P.VA_MIN] * par[P.EAS2TAS], par[P.VA_MAX] * par[P.EAS2TAS]
    d_spe, d_ske = G * (ctl[S.H_DEM] - h), 0.5 * ctl[S.V_DEM] ** 2 - ske
    error = clip(d_spe, min(ske - 0.5 * high * high, 0.0), max(ske - 0.5 * low * low, 0.0)) + d_ske
    ste_dot_c = clip(d_spe / tc + V * v_rate, idle, full)
    rate = G * h_dot + V * (ctl[S.ACCEL] - ctl[S.ACCEL_LP])
    ctl[S.STE_LP] += min(2.0 * dt, 1.0) * (ste_dot_c - rate - ctl[S.STE_LP])
    _update_flags(ctl, par, h, phi, error, rate)
    k = thr_range / (tc * (full - idle))
    turn_drag = par[P.ROLL_TO_THR] * (1.0 / clip(cos(phi) ** 2, 0.1, 1.0) - 1.0)
    feed_forward = par[P.THR_TRIM] + (ste_dot_c + turn_drag) / (full - idle) * thr_range
    thr = (error + par[P.THR_DAMP] * ctl[S.STE_LP]) * k + feed_forward
    i_limit = 0.5 * thr_range
    ceiling, floor = (
        clip(par[P.THR_MAX] - thr + 0.1, -i_limit, i_limit),
        clip(par[P.THR_MIN] - thr - 0.1, -i_limit, i_limit),
    )
    ctl[S.I_THR] = clip(ctl[S.I_THR] + error * par[P.INTEG] * k * dt, floor, ceiling)
    return _slew(ctl, par, thr, dt)


@kernel
def _slew(ctl: np.ndarray, par: np.ndarray, thr: float, dt: float) -> float:
    """Slew-limit the throttle, add its integrator, store the saturation flag, limit."""
    step = par[P.THR_SLEW] * (par[P.THR_MAX] - par[P.THR_MIN]) * dt
    ctl[S.THR] = clip(thr, ctl[S.THR] - step, ctl[S.THR] + step) if step > 0.0 else thr
    thr = ctl[S.THR] + ctl[S.I_THR]
    if ctl[S.UNDERSPEED] > 0.0:
        thr = par[P.THR_MAX]
    ctl[S.THR_SAT] = 1.0 if thr > par[P.THR_MAX] else (-1.0 if thr < par[P.THR_MIN] else 0.0)
    return clip(thr, par[P.THR_MIN], par[P.THR_MAX])


@kernel
def _throttle_no_airspeed(ctl: np.ndarray, par: np.ndarray, phi: float, dt: float) -> float:
    """Set the throttle from the pitch demand, without an airspeed sensor."""
    low, high = pitch_limits(par)
    idle, full = energy_rates(ctl, par)
    if ctl[S.THETA] > 0.0:
        thr = par[P.THR_TRIM] + (par[P.THR_MAX] - par[P.THR_TRIM]) * ctl[S.THETA] / high
    else:
        thr = par[P.THR_TRIM] + (par[P.THR_MIN] - par[P.THR_TRIM]) * ctl[S.THETA] / low
    turn_drag = par[P.ROLL_TO_THR] * (1.0 / clip(cos(phi) ** 2, 0.1, 1.0) - 1.0)
    ctl[S.I_THR], ctl[S.UNDERSPEED], ctl[S.BAD_DESCENT] = 0.0, 0.0, 0.0
    return _slew(ctl, par, thr + turn_drag / (full - idle) * (par[P.THR_MAX] - par[P.THR_MIN]), dt)


@kernel
def _weights(ctl: np.ndarray, par: np.ndarray, no_airspeed: bool) -> tuple[float, float]:
    """Return the weights of height and speed in the pitch loop."""
    weight = 0.0 if no_airspeed else (2.0 if ctl[S.UNDERSPEED] > 0.0 else clip(par[P.SPEED_WEIGHT], 0.0, 2.0))
    return min(2.0 - weight, 1.0), min(weight, 1.0)


@kernel
def _pitch(
    ctl: np.ndarray, par: np.ndarray, h: float, h_dot: float, h_dot_c: float, no_airspeed: bool, dt: float
) -> float:
    """Close the loop on the energy balance; return the pitch demand [rad]."""
    w_p, w_k = _weights(ctl, par, no_airspeed)
    V, tc = ctl[S.V_HAT], par[P.TIME_CONST]
    low, high = pitch_limits(par)
    d_ske = 0.5 * ctl[S.V_DEM] ** 2 - 0.5 * V * V
    seb_dot_free = h_dot_c * G * w_p + (G * (ctl[S.H_DEM] - h) * w_p - d_ske * w_k) / tc
    seb_dot_c = clip(seb_dot_free, -par[P.SINK_MAX] * G, par[P.CLIMB_MAX] * G)
    ctl[S.THETA_SAT] = 1.0 if seb_dot_free > seb_dot_c else (-1.0 if seb_dot_free < seb_dot_c else 0.0)
    error = seb_dot_c - (G * h_dot * w_p - V * (ctl[S.ACCEL] - ctl[S.ACCEL_LP]) * w_k)
    demand = seb_dot_c + par[P.PITCH_DAMP] * error
    _integrate(ctl, par, demand, error, -d_ske * w_k, dt)
    theta = (demand + ctl[S.I_SEB] + ctl[S.I_KE]) / (V * G)
    if theta > high:
        ctl[S.THETA_SAT] = 1.0
    elif theta < low:
        ctl[S.THETA_SAT] = -1.0
    step = par[P.VERT_ACC] / V * dt
    ctl[S.THETA] = clip(clip(theta, low, high), ctl[S.THETA] - step, ctl[S.THETA] + step)
    return ctl[S.THETA]


@kernel
def _integrate(ctl: np.ndarray, par: np.ndarray, demand: float, error: float, excess: float, dt: float) -> None:
    """Integrate the balance error and the speed excess; decay both while pitch is at its limit."""
    low, high = pitch_limits(par)
    gain = ctl[S.V_HAT] * G
    floor, ceiling = gain * (low - 0.0873) - demand, gain * (high + 0.0873) - demand
    step = clip(error * par[P.INTEG] * dt, -0.1 * (ceiling - floor), 0.1 * (ceiling - floor))
    theta = (demand + ctl[S.I_SEB] + ctl[S.I_KE] + step) / gain
    if (theta > high and step > 0.0) or (theta < low and step < 0.0):
        decay = par[P.TIME_CONST] / (dt + par[P.TIME_CONST])
        ctl[S.I_SEB] *= decay
        ctl[S.I_KE] *= decay
    else:
        ctl[S.I_SEB] += step
        ctl[S.I_KE] += excess * dt / par[P.TIME_CONST]
    i_limit = 0.25 * (high - low) * gain
    ctl[S.I_SEB] = clip(ctl[S.I_SEB], floor, ceiling)
    ctl[S.I_KE] = clip(ctl[S.I_KE], -i_limit, i_limit)


@kernel
def update(
    ctl: np.ndarray,
    par: np.ndarray,
    h_sp: float,
    va_c: float,
    h: float,
    h_dot: float,
    phi: float,
    no_airspeed: bool,
    dt: float,
) -> tuple[float, float]:
    """Return pitch and throttle for height and speed demands; call `demand.update_speed` first.

    Args:
        ctl, par: controller state, parameters
        h_sp: height demand, up positive above the origin [m]
        va_c: airspeed demand, equivalent [m/s]
        h, h_dot: height and climb rate, up positive [m, m/s]
        phi: roll [rad]
        no_airspeed: no airspeed sensor is available
        dt: step [s]
    Returns:
        theta_c [rad], delta_t 0..1
    """
    v_rate = demand_speed(ctl, par, va_c, phi, dt)
    h_dot_c = demand_height(ctl, par, h_sp, dt)
    delta_t = (
        _throttle_no_airspeed(ctl, par, phi, dt) if no_airspeed else _throttle(ctl, par, h, h_dot, v_rate, phi, dt)
    )
    return _pitch(ctl, par, h, h_dot, h_dot_c, no_airspeed, dt), delta_t


@kernel
def reset(ctl: np.ndarray, par: np.ndarray, h: float, h_dot: float, Va: float, theta_c: float, delta_t: float) -> None:
    """Initialise with `theta_c` [rad] and `delta_t` as trim at height `h` [m] and airspeed `Va` [m/s]."""
    V = max((Va if np.isfinite(Va) else par[P.VA_CRUISE]) * par[P.EAS2TAS], MIN_FILTERED_SPEED)
    ctl[S.V_HAT], ctl[S.V_DEM], ctl[S.V_TOP] = V, V, par[P.VA_MAX] * par[P.EAS2TAS]
    ctl[S.H_IN], ctl[S.H_LIMITED], ctl[S.H_DEM], ctl[S.H_LAST] = h, h, h, h
    ctl[S.CLIMB_SHARE], ctl[S.SINK_SHARE] = 1.0, 1.0
    idle, full = energy_rates(ctl, par)
    thr_range = par[P.THR_MAX] - par[P.THR_MIN]
    ctl[S.I_THR] = clip(
        delta_t - par[P.THR_TRIM] - h_dot * G / (full - idle) * thr_range, -0.5 * thr_range, 0.5 * thr_range
    )
    ctl[S.THR] = delta_t - ctl[S.I_THR]
    ctl[S.THETA] = theta_c
    ctl[S.I_SEB] = (theta_c - clip(h_dot / V, -1.0, 1.0)) * V * G
