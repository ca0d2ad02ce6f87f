"""TECS of PX4: throttle controls the total energy rate, pitch the energy balance rate of height and speed.

    h_dot_c = (h_ref - h) / ALT_TC + HRATE_FF h_dot_ref        V_dot_c = (V_c - V) / TAS_TC
    STE_dot = g h_dot + V V_dot (throttle)        SEB_dot = w_p g h_dot - w_k V V_dot (pitch)

Speeds are true airspeeds; heights are positive upward.
Source: Lambregts, "Total Energy Based Flight Control System" (1983); PX4 TECS.
"""

from math import cos, sqrt

import numpy as np

from fleet.autopilots import control_law as S
from fleet.autopilots.arduplane.demand import MIN_FILTERED_SPEED
from fleet.autopilots.control_law import clip, kernel
from fleet.autopilots.px4_fixedwing import params as P
from fleet.autopilots.px4_fixedwing import params as X
from fleet.frames import G

_MARGIN = 0.15  # fraction of cruise: underspeed starts one margin below minimum speed, and is full at two [-]


@kernel
def _advance_reference(ctl: np.ndarray, par: np.ndarray, h_sp: float, dt: float) -> None:
    """Advance the height reference to the set point with limited rate and acceleration (VERT_ACC)."""
    h_error = h_sp - ctl[X.H_REF]
    max_rate = min(sqrt(2.0 * par[P.VERT_ACC] * abs(h_error)), abs(h_error) / dt)
    h_dot_c = min(max_rate, par[P.CLIMB]) if h_error > 0.0 else -min(max_rate, par[P.SINK])
    step = par[P.VERT_ACC] * dt
    ctl[X.H_DOT_REF] += clip(h_dot_c - ctl[X.H_DOT_REF], -step, step)
    ctl[X.H_REF] += ctl[X.H_DOT_REF] * dt


@kernel
def _underspeed(ctl: np.ndarray, par: np.ndarray, no_airspeed: bool) -> float:
    """Return the degree of underspeed, 0..1."""
    if no_airspeed:
        return 0.0
    margin = _MARGIN * par[P.VA_CRUISE] * par[P.EAS2TAS]
    threshold = max(par[P.VA_MIN] * par[P.EAS2TAS] - margin, margin)
    return clip((threshold - ctl[S.V_HAT]) / margin, 0.0, 1.0)


@kernel
def _pitch(
    ctl: np.ndarray, par: np.ndarray, h_dot: float, rates_c: tuple[float, float], w_k: float, dt: float
) -> float:
    """Close the loop on the energy balance; return the pitch demand [rad]."""
    V, w_p = ctl[S.V_HAT], min(2.0 - w_k, 1.0)
    w_k = min(w_k, 1.0)
    balance_c = G * rates_c[0] * w_p - V * rates_c[1] * w_k
    error = balance_c - (G * h_dot * w_p - V * ctl[S.ACCEL] * w_k)
    step = error * par[P.I_PITCH] / (V * G) * dt
    low, high = par[P.PITCH_LOW], par[P.PITCH_HIGH]
    if ctl[S.THETA] >= high:
        step = min(step, 0.0)
    elif ctl[S.THETA] <= low:
        step = max(step, 0.0)
    ctl[X.I_THETA] = clip(ctl[X.I_THETA] + step, low, high)
    theta = (par[P.SEB_FF] * balance_c + par[P.PITCH_DAMP] * error) / (V * G) + ctl[X.I_THETA]
    max_step = par[P.VERT_ACC] / V * dt
    ctl[S.THETA] = clip(clip(theta, low, high), ctl[S.THETA] - max_step, ctl[S.THETA] + max_step)
    return ctl[S.THETA]


@kernel
def trim_throttle(par: np.ndarray, ste_dot: float) -> float:
    """Return the trim throttle for a total energy rate [m2/s3]: linear between idle, trim and full."""
    if ste_dot >= 0.0:
        return par[P.THR_TRIM] + ste_dot / (par[P.CLIMB_MAX] * G) * (par[P.THR_MAX] - par[P.THR_TRIM])
    return par[P.THR_TRIM] - ste_dot / (par[P.SINK_MIN] * G) * (par[P.THR_MIN] - par[P.THR_TRIM])


@kernel
def _throttle(
    ctl: np.ndarray,
    par: np.ndarray,
    h_dot: float,
    rates_c: tuple[float, float],
    phi: float,
    no_airspeed: bool,
    dt: float,
) -> float:
    """Close the loop on the total energy rate; return the throttle 0..1."""
    V, idle, full = ctl[S.V_HAT], -par[P.SINK_MIN] * G, par[P.CLIMB_MAX] * G
    rate = G * h_dot + V * (0.0 if no_airspeed else ctl[S.ACCEL])
    ctl[X.STE_DOT] += dt / (dt + par[P.STE_TC]) * (rate - ctl[X.STE_DOT])
    load = par[P.ROLL_TO_THR] * (1.0 / max(cos(phi), 0.2) - 1.0)
    rate_c = clip(G * rates_c[0] + V * rates_c[1] + load, idle, full)
    error = (rate_c - ctl[X.STE_DOT]) / (full - idle)
    step = error * par[P.I_THROTTLE] * dt
    if ctl[S.THR] >= par[P.THR_MAX]:
        step = min(step, 0.0)
    elif ctl[S.THR] <= par[P.THR_MIN]:
        step = max(step, 0.0)
    ctl[S.I_THR] = clip(ctl[S.I_THR] + step, -par[P.THR_MAX], par[P.THR_MAX])
    thr = trim_throttle(par, rate_c) + error * par[P.THR_DAMP] + ctl[S.I_THR]
    underspeed = _underspeed(ctl, par, no_airspeed)
    thr = underspeed * par[P.THR_MAX] + (1.0 - underspeed) * thr
    max_step = par[P.THR_SLEW] * dt
    if max_step > 0.0:
        thr = clip(thr, ctl[S.THR] - max_step, ctl[S.THR] + max_step)
    ctl[S.THR] = clip(thr, par[P.THR_MIN], par[P.THR_MAX])
    return ctl[S.THR]


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
    """Return pitch and throttle for height and speed demands; arguments as for `arduplane.tecs.update`.

    Call `demand.update_acceleration` and `demand.filter_speed` first.
    """
    _advance_reference(ctl, par, h_sp, dt)
    h_dot_c = (ctl[X.H_REF] - h) / par[P.ALT_TC] + par[P.H_RATE_FF] * ctl[X.H_DOT_REF]
    h_dot_c = clip(h_dot_c, -par[P.SINK_MAX], par[P.CLIMB_MAX])
    V, v_dot_c = ctl[S.V_HAT], 0.0
    if not no_airspeed:
        V_c = clip(va_c, par[P.VA_MIN], par[P.VA_MAX]) * par[P.EAS2TAS]
        v_dot_c = clip((V_c - V) / par[P.TAS_TC], -0.5 * par[P.SINK_MIN] * G / V, 0.5 * par[P.CLIMB_MAX] * G / V)
    underspeed = _underspeed(ctl, par, no_airspeed)
    w_k = 0.0 if no_airspeed else 2.0 * underspeed + (1.0 - underspeed) * par[P.SPEED_WEIGHT]
    rates_c = (h_dot_c, v_dot_c)
    return _pitch(ctl, par, h_dot, rates_c, w_k, dt), _throttle(ctl, par, h_dot, rates_c, phi, no_airspeed, dt)


@kernel
def reset(ctl: np.ndarray, par: np.ndarray, h: float, h_dot: float, Va: float, theta_c: float, delta_t: float) -> None:
    """Initialise with `theta_c` [rad] and `delta_t` as trim at climb rate `h_dot` [m/s] and airspeed `Va` [m/s]."""
    V = max((Va if np.isfinite(Va) else par[P.VA_CRUISE]) * par[P.EAS2TAS], MIN_FILTERED_SPEED)
    ctl[S.V_HAT] = V
    ctl[X.H_REF], ctl[X.H_DOT_REF], ctl[X.STE_DOT] = h, clip(h_dot, -par[P.SINK], par[P.CLIMB]), G * h_dot
    ctl[S.THETA], ctl[S.THR] = theta_c, delta_t
    ctl[X.I_THETA] = clip(theta_c - par[P.SEB_FF] * clip(h_dot / V, -1.0, 1.0), par[P.PITCH_LOW], par[P.PITCH_HIGH])
    rate = clip(G * h_dot, -par[P.SINK_MIN] * G, par[P.CLIMB_MAX] * G)
    ctl[S.I_THR] = clip(delta_t - trim_throttle(par, rate), -par[P.THR_MAX], par[P.THR_MAX])
