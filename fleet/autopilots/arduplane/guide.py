"""Complete guidance step at 10 Hz: route, L1 and TECS; and the attitude loops below it."""

from math import atan2, cos, pi, radians, sin, tan

import numpy as np

from fleet.autopilots import control_law as S
from fleet.autopilots.arduplane import demand, l1, tecs
from fleet.autopilots.arduplane import legs as leg_rules
from fleet.autopilots.arduplane import params as P
from fleet.autopilots.control_law import array_kernel, clip, kernel
from fleet.frames import G
from fleet.mission import GLIDE, KIND, RADIUS, VA_C

FULL_THROW = radians(45.0)  # full throw [rad]
_P, _I, _D, _IMAX, _FLTT, _FLTD = 1, 2, 3, 4, 5, 6  # offsets of the gains from FF in `par`, for roll and pitch


@kernel
def scaler(par: np.ndarray, Va: float) -> float:
    """Return the dynamic-pressure scaler SCALING_SPEED / Va, limited [-]; nan airspeed is replaced by cruise."""
    V = Va if np.isfinite(Va) else par[P.VA_CRUISE]
    low = min(0.5, par[P.VA_SCALING] / (2.0 * par[P.VA_MAX]))
    high = max(2.0, par[P.VA_SCALING] / (0.7 * par[P.VA_MIN]))
    return clip(par[P.VA_SCALING] / max(V, 0.1), low, high)


@kernel
def _low_pass_gain(hertz: float, dt: float) -> float:
    """Return the gain of a first-order low-pass filter; 0 Hz: no filter."""
    return dt / (dt + 1.0 / (2 * pi * hertz)) if hertz > 0.0 else 1.0


@kernel
def _rate_loop(ctl: np.ndarray, par: np.ndarray, pitch: bool, rate_c: float, rate: float, s: float, dt: float) -> float:
    """Convert a rate demand [rad/s] to a surface deflection -1..1."""
    t, i, e, d, last = (S.Q_T, S.I_E, S.E_E, S.D_E, S.S_E) if pitch else (S.P_T, S.I_A, S.E_A, S.D_A, S.S_A)
    ff = P.PITCH_FF if pitch else P.ROLL_FF
    ctl[t] += _low_pass_gain(par[ff + _FLTT], dt) * (rate_c - ctl[t])
    error = (ctl[t] - rate) * s * s
    ctl[d] += _low_pass_gain(par[ff + _FLTD], dt) * ((error - ctl[e]) / dt - ctl[d])
    ctl[e] = error
    step = error * par[ff + _I] * dt
    if abs(ctl[last]) < 1.0 or step * ctl[last] < 0.0:  # anti-windup: at full throw integrate only towards zero
        ctl[i] = clip(ctl[i] + step, -par[ff + _IMAX], par[ff + _IMAX])
    total = par[ff] * ctl[t] * s / par[P.EAS2TAS] + par[ff + _P] * error + ctl[i] + par[ff + _D] * ctl[d]
    ctl[last] = total / FULL_THROW
    return clip(ctl[last], -1.0, 1.0)


@kernel
def _limit_rate(rate: float, down: float, up: float) -> float:
    """Limit a rate; a zero limit is inactive."""
    if up > 0.0 and rate > up:
        return up
    return -down if down > 0.0 and rate < -down else rate


@kernel
def rate_demands(par: np.ndarray, phi_c: float, theta_c: float, euler: np.ndarray, Va: float) -> tuple[float, float]:
    """Return the roll and pitch rate demands, including the pitch rate of a turn [rad/s]."""
    V = max(Va if np.isfinite(Va) else par[P.VA_CRUISE], par[P.VA_MIN]) * par[P.EAS2TAS]
    phi = clip(euler[0], -1.396, 1.396)
    p_d = _limit_rate((phi_c - euler[0]) / par[P.ROLL_TC], par[P.ROLL_RMAX], par[P.ROLL_RMAX])
    q_d = _limit_rate((theta_c + par[P.PITCH_TRIM] - euler[1]) / par[P.PITCH_TC], par[P.PITCH_DOWN], par[P.PITCH_UP])
    turn = abs(cos(euler[1]) * G / V * tan(phi) * sin(phi)) * par[P.PITCH_ROLL]
    return p_d, q_d + turn


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
    """Return the surface deflections for a commanded attitude, at about 50 Hz.

    Args:
        ctl, par: controller state, parameters
        phi_c, theta_c: commanded roll and pitch from `guide` [rad]
        euler: phi, theta, psi (3,) [rad]
        rates: p, q, r body FRD (3,) [rad/s]
        Va: equivalent airspeed; nan: no sensor [m/s]
        dt: step [s]
    Returns:
        delta_a, delta_e, delta_r, -1..1; positive rolls right, pitches up, yaws right
    """
    dt = max(dt, 1e-4)
    s = scaler(par, Va)
    p_d, q_d = rate_demands(par, phi_c, theta_c, euler, Va)
    delta_a = _rate_loop(ctl, par, False, p_d, rates[0], s, dt)
    delta_e = _rate_loop(ctl, par, True, q_d, rates[1], s, dt)
    return delta_a, delta_e, clip(par[P.RUDDER_MIX] * delta_a, -1.0, 1.0)


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
    """Initialise on leg `k` with bumpless transfer of pitch and throttle.

    Args:
        par: parameters (N_PAR,)
        legs: route (m, 9)
        k: leg to fly
        start: start point of its line, NED, (3,) [m]; nan: aircraft position; inf: no line, as after a mode change
        p, v: position and ground velocity, NED, (3,) [m, m/s]
        euler: phi, theta, psi (3,) [rad]
        Va: equivalent airspeed; nan: no sensor [m/s]
        theta_c, delta_t: current pitch command and throttle; nan: unknown [rad, 0..1]
    Returns:
        ctl (S.N_CTL,)
    """
    theta_c = theta_c if np.isfinite(theta_c) else euler[1]
    delta_t = delta_t if np.isfinite(delta_t) else 0.5 * (par[P.THR_MIN] + par[P.THR_MAX])
    ctl = np.zeros(S.N_CTL)
    has_start = np.isfinite(start[0]) and np.isfinite(start[1]) and np.isfinite(start[2])
    leg_rules.set_leg(ctl, par, legs, k, start if has_start else p)
    ctl[S.FOLLOW_LINE] = 1.0 if has_start else (-1.0 if np.isinf(start[0]) else 0.0)
    ctl[S.COURSE] = atan2(v[1], v[0])
    tecs.reset(ctl, par, -p[2], -v[2], Va, theta_c, delta_t)
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
    """Run one guidance step on the current leg; return the result of `guide` and whether the leg is complete."""
    dt = max(dt, 1e-3)
    a_lat, leg_done = leg_rules.steer(ctl, par, legs, p, v, euler, dt)
    phi_c = l1.to_roll(par, a_lat, euler[1])
    h_sp = leg_rules.height_demand(ctl, par, legs, p)
    demand.update_speed(ctl, par, v, euler, Va, Va_dot, dt)
    va_c, no_airspeed = commanded_airspeed(ctl, par, legs), not np.isfinite(Va)
    theta_c, delta_t = tecs.update(ctl, par, h_sp, va_c, -p[2], -v[2], euler[0], no_airspeed, dt)
    i = leg_rules.current_leg(ctl, legs)
    if i >= 0 and int(legs[i, KIND]) == GLIDE:
        theta_c, delta_t = legs[i, RADIUS], par[P.THR_MIN]
    return phi_c, theta_c, delta_t, leg_done


@kernel
def guide(
    ctl: np.ndarray,
    par: np.ndarray,
    legs: np.ndarray,
    p: np.ndarray,
    v: np.ndarray,
    euler: np.ndarray,
    Va: float,
    Va_dot: float,
    dt: float,
) -> tuple[float, float, float]:
    """Run one guidance step at about 10 Hz; switch to the next leg when one is complete, and stay on the last.

    Args:
        ctl, par, legs: controller state (changed), parameters, route
        p, v: position and ground velocity, NED, (3,) [m, m/s]
        euler: phi, theta, psi (3,) [rad]
        Va: equivalent airspeed from the sensor; nan: no sensor [m/s]
        Va_dot: forward acceleration, x_body . v_dot; nan: derived from `v` [m/s2]
        dt: step [s]
    Returns:
        phi_c, theta_c [rad], delta_t 0..1
    """
    phi_c, theta_c, delta_t, leg_done = fly(ctl, par, legs, p, v, euler, Va, Va_dot, dt)
    if leg_done and int(ctl[S.LEG]) + 1 < legs.shape[0]:
        leg_rules.begin(ctl, par, legs, int(ctl[S.LEG]) + 1, p)
    return phi_c, theta_c, delta_t


@kernel
def assume_commanded_speed(ctl: np.ndarray, par: np.ndarray, legs: np.ndarray) -> None:
    """Set the speed demand to the commanded speed, as in steady flight."""
    ctl[S.V_DEM] = commanded_airspeed(ctl, par, legs) * par[P.EAS2TAS]


@kernel
def align_integrators(ctl: np.ndarray, par: np.ndarray, residual: np.ndarray, reported: np.ndarray) -> None:
    """Shift the integrators by the output residuals, and set slew-limited outputs to the reported values.

    Args:
        ctl, par: controller state, parameters
        residual: reported minus replayed theta_c, delta_t, delta_a, delta_e, delta_r; 0: unknown, (5,)
        reported: reported phi_c, theta_c, delta_t and airspeed at the end, nan where missing, (4,)
    """
    i_limit = 0.5 * (par[P.THR_MAX] - par[P.THR_MIN])
    ctl[S.I_SEB] += residual[0] * ctl[S.V_HAT] * G
    ctl[S.THETA] = reported[1] if np.isfinite(reported[1]) else ctl[S.THETA] + residual[0]
    ctl[S.I_THR] = min(max(ctl[S.I_THR] + residual[1], -i_limit), i_limit)
    if np.isfinite(reported[2]):
        ctl[S.THR] = reported[2] - ctl[S.I_THR]
    ctl[S.I_A] += residual[2] * FULL_THROW
    ctl[S.I_E] += residual[3] * FULL_THROW
