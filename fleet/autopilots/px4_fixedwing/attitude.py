"""PX4 attitude and rate loops: body rates of a coordinated turn, one rate loop per axis.

    phi_dot_c = (phi_c - phi) / R_TC      theta_dot_c = (theta_c - theta) / P_TC
    psi_dot_c = g tan(phi) cos(theta) / V
    surface = FF rate_c s + s^2 (P (rate_c - rate) + I)        s = AIRSPD_TRIM / Va

Gains are in fractions of full throw per rad/s. The derivative gains, zero by default, are not modelled.
Source: PX4 fixed-wing attitude and rate controllers.
"""

from math import cos, sin, tan

import numpy as np

from fleet.autopilots.common import controller_state as S
from fleet.autopilots.common.kernels import clip, kernel
from fleet.autopilots.px4_fixedwing import params as P
from fleet.autopilots.px4_fixedwing import state as X
from fleet.frames import G

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
