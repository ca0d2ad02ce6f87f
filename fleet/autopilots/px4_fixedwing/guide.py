"""Complete guidance step of PX4: route, NPFG and TECS; attitude loops; and the integrator alignment after a replay."""

from math import cos, hypot, sin, tan

import numpy as np

from fleet.autopilots import control_law as S
from fleet.autopilots.arduplane import demand
from fleet.autopilots.arduplane import legs as leg_rules
from fleet.autopilots.control_law import array_kernel, clip, kernel
from fleet.autopilots.px4_fixedwing import params as P
from fleet.autopilots.px4_fixedwing import params as X
from fleet.autopilots.px4_fixedwing import path, tecs
from fleet.autopilots.px4_fixedwing import path as npfg
from fleet.frames import G
from fleet.mission import VA_C

_MAX_ANGLE = 1.4  # limit of roll and pitch in the turn equations [rad]
_P, _I, _IMAX = 1, 2, 3  # offsets of the gains from FF in `par`, for each axis


@kernel
def _limited_airspeed(par: np.ndarray, Va: float) -> float:
    """Return the limited airspeed; nan is replaced by cruise [m/s]."""
    return clip(Va, par[P.VA_MIN], par[P.VA_MAX]) if np.isfinite(Va) else par[P.VA_CRUISE]


@kernel
def scaler(par: np.ndarray, Va: float) -> float:
    """Return the dynamic-pressure scaler [-]."""
    return par[P.VA_CRUISE] / _limited_airspeed(par, Va) if par[P.SCALED] > 0.0 else 1.0


@kernel
def rate_demands(
    par: np.ndarray, phi_c: float, theta_c: float, euler: np.ndarray, Va: float
) -> tuple[float, float, float]:
    """Return the body rate demands [rad/s]."""
    phi, theta = clip(euler[0], -_MAX_ANGLE, _MAX_ANGLE), clip(euler[1], -_MAX_ANGLE, _MAX_ANGLE)
    phi_dot, theta_dot = (phi_c - euler[0]) / par[P.ROLL_TC], (theta_c - euler[1]) / par[P.PITCH_TC]
    psi_dot = G * tan(phi) * cos(theta) / (_limited_airspeed(par, Va) * par[P.EAS2TAS])
    p_d = phi_dot - sin(theta) * psi_dot
    q_d = cos(phi) * theta_dot + cos(theta) * sin(phi) * psi_dot
    r_d = -sin(phi) * theta_dot + cos(theta) * cos(phi) * psi_dot
    return (
        clip(p_d, -par[P.ROLL_RMAX], par[P.ROLL_RMAX]),
        clip(q_d, -par[P.PITCH_DOWN], par[P.PITCH_UP]),
        clip(r_d, -par[P.YAW_RMAX], par[P.YAW_RMAX]),
    )


@kernel
def _rate_loop(
    ctl: np.ndarray, par: np.ndarray, slots: tuple[int, int, int], rate_c: float, rate: float, s: float, dt: float
) -> float:
    """Convert a rate demand [rad/s] to a surface -1..1; slots: FF in `par`, integrator and last surface in `ctl`."""
    ff, i, last = slots
    error = rate_c - rate
    step = error * par[ff + _I] * dt
    if abs(ctl[last]) < 1.0 or step * ctl[last] < 0.0:  # anti-windup: at full throw integrate only towards zero
        ctl[i] = clip(ctl[i] + step, -par[ff + _IMAX], par[ff + _IMAX])
    ctl[last] = par[ff] * rate_c * s + s * s * (par[ff + _P] * error + ctl[i])
    return clip(ctl[last], -1.0, 1.0)


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
    dt = max(dt, 1e-4)
    s = scaler(par, Va)
    p_d, q_d, r_d = rate_demands(par, phi_c, theta_c, euler, Va)
    delta_a = _rate_loop(ctl, par, (P.ROLL_FF, S.I_A, X.S_A), p_d, rates[0], s, dt)
    delta_e = _rate_loop(ctl, par, (P.PITCH_FF, S.I_E, X.S_E), q_d, rates[1], s, dt)
    return delta_a, delta_e, _rate_loop(ctl, par, (P.YAW_FF, X.I_R, X.S_R), r_d, rates[2], s, dt)


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
    ctl[X.PHI] = min(max(euler[0], -par[P.ROLL_LIMIT]), par[P.ROLL_LIMIT])
    tecs.reset(ctl, par, -p[2], -v[2], Va, theta_c - par[P.PITCH_OFFSET], delta_t)
    return ctl


@kernel
def commanded_airspeed(ctl: np.ndarray, par: np.ndarray, legs: np.ndarray) -> float:
    """Return the commanded equivalent airspeed on the current leg [m/s]."""
    i = leg_rules.current_leg(ctl, legs)
    return legs[i, VA_C] if i >= 0 and legs[i, VA_C] > 0.0 else par[P.VA_CRUISE]


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
    dt = max(dt, 1e-3)
    demand.update_acceleration(ctl, v, euler, Va_dot, dt)
    demand.filter_speed(ctl, Va * par[P.EAS2TAS], par[P.VA_CRUISE] * par[P.EAS2TAS], dt)
    a_lat, leg_done = path.steer(ctl, par, legs, p, v, euler[2], ctl[S.V_HAT], dt)
    ctl[X.PHI] = npfg.to_roll(par, a_lat, ctl[X.PHI], dt)
    h_sp = path.height_demand(ctl, par, legs, p, hypot(v[0], v[1]))
    va_c, no_airspeed = commanded_airspeed(ctl, par, legs), not np.isfinite(Va)
    theta_c, delta_t = tecs.update(ctl, par, h_sp, va_c, -p[2], -v[2], euler[0], no_airspeed, dt)
    return ctl[X.PHI], theta_c + par[P.PITCH_OFFSET], delta_t, leg_done


@kernel
def align_integrators(ctl: np.ndarray, par: np.ndarray, residual: np.ndarray, reported: np.ndarray) -> None:
    """Shift the integrators by the output residuals, and set slew-limited outputs to the reported values.

    Arguments as for ArduPlane.
    """
    ctl[X.I_THETA] += residual[0]
    ctl[S.THETA] = reported[1] - par[P.PITCH_OFFSET] if np.isfinite(reported[1]) else ctl[S.THETA] + residual[0]
    ctl[S.I_THR] += residual[1]
    if np.isfinite(reported[2]):
        ctl[S.THR] = reported[2]
    if np.isfinite(reported[0]):
        ctl[X.PHI] = reported[0]
    s = scaler(par, reported[3]) ** 2
    ctl[S.I_A] += residual[2] / s
    ctl[S.I_E] += residual[3] / s
    ctl[X.I_R] += residual[4] / s
