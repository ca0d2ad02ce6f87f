"""Attitude and rate loops: attitude error to rate demand to surface, for roll and pitch.

    p_d = (phi_c - phi) / T        s = SCALING_SPEED / Va
    surface = FF p_t s / EAS2TAS + s^2 (P (p_t - p) + I + D d/dt(p_t - p))        p_t: p_d low-passed

Gains are in degrees of surface per deg/s of rate; 45 deg is full throw.
Source: ArduPlane roll and pitch controllers (fixed-wing rate PID).
"""

from math import cos, pi, radians, sin, tan

import numpy as np

from fleet.autopilots.arduplane import params as P
from fleet.autopilots.common import controller_state as S
from fleet.autopilots.common.kernels import clip, kernel
from fleet.frames import G

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
