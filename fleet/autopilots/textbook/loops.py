"""Cascaded loops: course to bank, height to pitch, airspeed to throttle, attitude to surfaces.

Source: Beard & McLain, "Small Unmanned Aircraft" (2012), chapter 6; the feed-forward terms are additions.
"""

from math import asin, atan2, cos, hypot

import numpy as np

from fleet.autopilots import control_law as S
from fleet.autopilots.arduplane import demand
from fleet.autopilots.arduplane import legs as leg_rules
from fleet.autopilots.control_law import array_kernel, clip, kernel
from fleet.autopilots.textbook import params as P
from fleet.autopilots.textbook import params as X
from fleet.autopilots.textbook import path
from fleet.frames import G, wrap
from fleet.mission import VA_C

_H_ERROR_TAU = 4.0  # time constant from height error to climb rate [s]
_H_ERROR_MAX = 10.0  # limit of the height error in the proportional and integral terms [m]


@array_kernel
def init(
    par: np.ndarray,
    legs: np.ndarray,
    k: int,
    start: np.ndarray,
    p: np.ndarray,
    v: np.ndarray,
    euler: np.ndarray,
    Va: float,
    theta_c: float,
    delta_t: float,
) -> np.ndarray:
    """Initialise on leg `k` with bumpless transfer; arguments as for `arduplane.init`."""
    theta_c = theta_c if np.isfinite(theta_c) else euler[1]
    delta_t = delta_t if np.isfinite(delta_t) else par[P.THR_TRIM]
    ctl = np.zeros(S.N_CTL)
    has_start = np.isfinite(start[0]) and np.isfinite(start[1]) and np.isfinite(start[2])
    leg_rules.set_leg(ctl, par, legs, k, start if has_start else p)
    ctl[S.FOLLOW_LINE] = 1.0 if has_start else 0.0
    ctl[S.V_HAT] = max((Va if np.isfinite(Va) else par[P.CRUISE]) * par[P.EAS2TAS], demand.MIN_FILTERED_SPEED)
    ctl[S.THETA], ctl[S.THR] = theta_c, delta_t
    ctl[X.I_H] = theta_c - asin(clip(-v[2] / ctl[S.V_HAT], -1.0, 1.0))
    ctl[X.I_V] = delta_t - par[P.THR_TRIM] + par[P.K_FF_H] * v[2]
    return ctl


@kernel
def fly(
    ctl: np.ndarray,
    par: np.ndarray,
    legs: np.ndarray,
    p: np.ndarray,
    v: np.ndarray,
    euler: np.ndarray,
    Va: float,
    Va_dot: float,
    dt: float,
) -> tuple[float, float, float, bool]:
    """Run one guidance step on the current leg; return the result of `arduplane.guide` and whether it is complete."""
    dt, speed = max(dt, 1e-3), hypot(v[0], v[1])
    demand.update_acceleration(ctl, v, euler, Va_dot, dt)
    demand.filter_speed(ctl, Va * par[P.EAS2TAS], par[P.CRUISE] * par[P.EAS2TAS], dt)
    chi = atan2(v[1], v[0]) if speed > 1.0 else euler[2]
    chi_c, bank, leg_done = path.course(ctl, par, legs, p, v, chi, dt)
    chi_error, v_over_g = wrap(chi_c - chi), max(speed, demand.MIN_FILTERED_SPEED) / G
    phi_free = bank + 2.0 * par[P.ZETA] * par[P.OMEGA] * v_over_g * chi_error + ctl[X.I_CHI]
    phi_c = clip(phi_free, -par[P.PHI_MAX], par[P.PHI_MAX])
    if phi_free == phi_c:
        ctl[X.I_CHI] += par[P.K_I_CHI] * v_over_g * chi_error * dt
    theta_c, delta_t = _climb(ctl, par, legs, p, v, phi_c, np.isfinite(Va), dt)
    return phi_c, theta_c, delta_t, leg_done


@kernel
def _climb(
    ctl: np.ndarray,
    par: np.ndarray,
    legs: np.ndarray,
    p: np.ndarray,
    v: np.ndarray,
    phi: float,
    has_airspeed: bool,
    dt: float,
) -> tuple[float, float]:
    """Close the loops on height and airspeed; return pitch [rad] and throttle 0..1."""
    i, V = leg_rules.current_leg(ctl, legs), ctl[S.V_HAT]
    va_c = (legs[i, VA_C] if i >= 0 and legs[i, VA_C] > 0.0 else par[P.CRUISE]) * par[P.EAS2TAS]
    h_error = path.height_demand(ctl, legs, p) + p[2]
    h_dot_c = clip(h_error / _H_ERROR_TAU, -par[P.SINK], par[P.CLIMB])
    h_error_limited = clip(h_error, -_H_ERROR_MAX, _H_ERROR_MAX)
    theta = asin(clip(h_dot_c / V, -0.5, 0.5)) + par[P.K_P_H] * h_error_limited + ctl[X.I_H]
    ctl[S.THETA] = clip(theta, -par[P.THETA_MAX], par[P.THETA_MAX])
    if theta == ctl[S.THETA]:
        ctl[X.I_H] += par[P.K_I_H] * h_error_limited * dt
    Va_error = va_c - V if has_airspeed else 0.0
    feed_forward = par[P.THR_TRIM] + par[P.K_FF_H] * h_dot_c + par[P.K_FF_N] * (1.0 / cos(phi) ** 2 - 1.0)
    thr = feed_forward + par[P.K_P_V] * Va_error + ctl[X.I_V]
    ctl[S.THR] = clip(thr, 0.0, 1.0)
    if thr == ctl[S.THR]:
        ctl[X.I_V] += par[P.K_I_V] * Va_error * dt
    return ctl[S.THETA], ctl[S.THR]


@kernel
def stabilise(
    ctl: np.ndarray,
    par: np.ndarray,
    phi_c: float,
    theta_c: float,
    euler: np.ndarray,
    rates: np.ndarray,
    Va: float,
    dt: float,
) -> tuple[float, float, float]:
    """Return the surface deflections for a commanded attitude; arguments and signs as for `arduplane.stabilise`."""
    delta_a = clip(par[P.K_P_PHI] * (phi_c - euler[0]) - par[P.K_D_PHI] * rates[0] + ctl[X.I_A], -1.0, 1.0)
    delta_e_free = par[P.K_P_THETA] * (theta_c - euler[1]) - par[P.K_D_THETA] * rates[1] + ctl[X.I_E]
    delta_e = clip(delta_e_free, -1.0, 1.0)
    if delta_e_free == delta_e:
        ctl[X.I_E] = clip(ctl[X.I_E] + par[P.K_I_THETA] * (theta_c - euler[1]) * dt, -1.0, 1.0)
    return delta_a, delta_e, 0.0


@kernel
def align_integrators(ctl: np.ndarray, par: np.ndarray, residual: np.ndarray, reported: np.ndarray) -> None:
    """Shift the integrators by the output residuals; arguments as for ArduPlane."""
    ctl[X.I_H] += residual[0]
    ctl[X.I_V] += residual[1]
    ctl[X.I_A] = clip(ctl[X.I_A] + residual[2], -1.0, 1.0)
    ctl[X.I_E] = clip(ctl[X.I_E] + residual[3], -1.0, 1.0)
