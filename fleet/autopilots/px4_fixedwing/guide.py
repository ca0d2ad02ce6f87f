"""Complete guidance step of PX4: route, NPFG and TECS; and the integrator alignment after a replay."""

from math import hypot

import numpy as np

from fleet.autopilots.arduplane import demand
from fleet.autopilots.arduplane import legs as leg_rules
from fleet.autopilots.common import controller_state as S
from fleet.autopilots.common.kernels import array_kernel, kernel
from fleet.autopilots.px4_fixedwing import npfg, path, tecs
from fleet.autopilots.px4_fixedwing import params as P
from fleet.autopilots.px4_fixedwing import state as X
from fleet.autopilots.px4_fixedwing.attitude import scaler
from fleet.mission import VA_C


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
