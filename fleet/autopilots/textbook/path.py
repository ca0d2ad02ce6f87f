"""Course demand: vector field of a line, of an orbit and of a fillet between two lines.

Source: Beard & McLain, "Small Unmanned Aircraft" (2012), sections 10.1, 10.2 and 11.1.
"""

from math import atan, atan2, cos, hypot, pi, sin, tan

import numpy as np

from fleet.autopilots import control_law as S
from fleet.autopilots.arduplane import legs as leg_rules
from fleet.autopilots.control_law import clip, kernel
from fleet.autopilots.textbook import params as P
from fleet.autopilots.textbook import params as X
from fleet.frames import G, wrap
from fleet.mission import KIND, LAND, LOITER_UNLIMITED, P_D, P_E, P_N, RADIUS, TAKEOFF, WAYPOINT

_ORBIT_MARGIN = 1.3  # distance to the centre, in radii, that counts as orbit reached [-]
_MAX_FILLET_TURN = 2.6  # maximum turn angle of a fillet [rad]


@kernel
def _turn_angle(ctl: np.ndarray, leg: np.ndarray, next_leg: np.ndarray) -> tuple[float, float, float, float, float]:
    """Return the directions of this line and the next, and the turn angle between them, right positive [rad]."""
    chi_line = atan2(leg[P_E] - ctl[S.PREV_E], leg[P_N] - ctl[S.PREV_N])
    chi_next = atan2(next_leg[P_E] - leg[P_E], next_leg[P_N] - leg[P_N])
    return cos(chi_line), sin(chi_line), cos(chi_next), sin(chi_next), wrap(chi_next - chi_line)


@kernel
def _fillet_distance(par: np.ndarray, turn: float) -> float:
    """Return the distance from the corner to the tangent points of the fillet [m]."""
    return par[P.FILLET] * tan(min(abs(turn), _MAX_FILLET_TURN) / 2)


@kernel
def begin(ctl: np.ndarray, par: np.ndarray, legs: np.ndarray, k: int, p: np.ndarray) -> None:
    """Switch to leg `k` over a fillet, or from the aircraft `p`, NED (3,) [m], if the lines do not meet."""
    i = leg_rules.current_leg(ctl, legs)
    continues = i >= 0 and k == i + 1 and k < legs.shape[0] and int(legs[i, KIND]) == WAYPOINT
    if not continues:
        leg_rules.set_leg(ctl, par, legs, k, p)
        ctl[X.FILLET_SIDE] = 0.0
        return
    q_n, q_e, _, _, turn = _turn_angle(ctl, legs[i], legs[k])
    side, tangent_distance = (1.0 if turn > 0.0 else -1.0), _fillet_distance(par, turn)
    ctl[X.C_N] = legs[i, P_N] - tangent_distance * q_n - side * par[P.FILLET] * q_e
    ctl[X.C_E] = legs[i, P_E] - tangent_distance * q_e + side * par[P.FILLET] * q_n
    leg_rules.set_leg(ctl, par, legs, k, legs[i, P_N : P_D + 1])
    ctl[S.FOLLOW_LINE], ctl[X.FILLET_SIDE] = (
        1.0,
        side if abs(turn) > 0.02 and int(legs[k, KIND]) in (WAYPOINT, LAND) else 0.0,
    )


@kernel
def _to_line(ctl: np.ndarray, par: np.ndarray, leg: np.ndarray, p: np.ndarray, chi: float) -> float:
    """Return the course to a line. Source: Beard & McLain eq. 10.8."""
    q_n, q_e = leg[P_N] - ctl[S.PREV_N], leg[P_E] - ctl[S.PREV_E]
    if hypot(q_n, q_e) < 1.0:
        q_n, q_e = leg[P_N] - p[0], leg[P_E] - p[1]
    chi_q = chi + wrap(atan2(q_e, q_n) - chi)
    e = (q_n * (p[1] - ctl[S.PREV_E]) - q_e * (p[0] - ctl[S.PREV_N])) / max(hypot(q_n, q_e), 0.1)
    return chi_q - par[P.CHI_INF] * 2 / pi * atan(par[P.K_PATH] * e)


@kernel
def _to_orbit(par: np.ndarray, n: float, e: float, radius: float, p: np.ndarray, v: np.ndarray) -> tuple[float, float]:
    """Return course and bank on an orbit around (n, e), radius positive clockwise [m]. Source: eq. 10.13."""
    d, R = 1.0 if radius > 0.0 else -1.0, max(abs(radius), 1.0)
    out_n, out_e = p[0] - n, p[1] - e
    chi = atan2(out_e, out_n) + d * (pi / 2 + atan(par[P.K_ORBIT] * (hypot(out_n, out_e) - R) / R))
    near_orbit = abs(hypot(out_n, out_e) - R) < 0.3 * R
    return chi, d * atan((v[0] ** 2 + v[1] ** 2) / (G * R)) if near_orbit else 0.0


@kernel
def course(
    ctl: np.ndarray, par: np.ndarray, legs: np.ndarray, p: np.ndarray, v: np.ndarray, chi: float, dt: float
) -> tuple[float, float, bool]:
    """Return course and bank demands of the path, and whether the leg is complete.

    Args:
        ctl, par, legs: controller state, parameters, route
        p, v: position and ground velocity, NED, (3,) [m, m/s]
        chi: current course [rad]
        dt: step [s]
    """
    i = leg_rules.current_leg(ctl, legs)
    if i < 0 or int(legs[i, KIND]) == TAKEOFF:
        return chi, 0.0, i >= 0 and p[2] <= legs[i, P_D]
    leg, has_next = legs[i], i + 1 < legs.shape[0]
    if int(leg[KIND]) not in (WAYPOINT, LAND):
        radius = leg[RADIUS] if leg[RADIUS] != 0.0 else par[P.ORBIT]
        chi_c, bank = _to_orbit(par, leg[P_N], leg[P_E], radius, p, v)
        return chi_c, bank, _orbit_done(ctl, leg, p, radius, dt) and has_next
    along, length = leg_rules.along_line(ctl, leg, p)
    if ctl[X.FILLET_SIDE] != 0.0:
        chi_c, bank = _to_orbit(par, ctl[X.C_N], ctl[X.C_E], ctl[X.FILLET_SIDE] * par[P.FILLET], p, v)
        q_n, q_e = (leg[P_N] - ctl[S.PREV_N]) / max(length, 0.1), (leg[P_E] - ctl[S.PREV_E]) / max(length, 0.1)
        fillet_end = (ctl[X.C_N] - ctl[S.PREV_N]) * q_n + (ctl[X.C_E] - ctl[S.PREV_E]) * q_e
        if along < fillet_end and along < length:
            return chi_c, bank, False
        ctl[X.FILLET_SIDE] = 0.0
    tangent_distance = 0.0
    if has_next and int(leg[KIND]) == WAYPOINT and int(legs[i + 1, KIND]) in (WAYPOINT, LAND):
        tangent_distance = min(_fillet_distance(par, _turn_angle(ctl, leg, legs[i + 1])[4]), 0.5 * length)
    return _to_line(ctl, par, leg, p, chi), 0.0, int(leg[KIND]) == WAYPOINT and along > length - tangent_distance


@kernel
def _orbit_done(ctl: np.ndarray, leg: np.ndarray, p: np.ndarray, radius: float, dt: float) -> bool:
    """Integrate angle and time on an orbit; return whether it is complete."""
    n, e = leg[P_N] - p[0], leg[P_E] - p[1]
    bearing = atan2(e, n)
    if ctl[S.CIRCLE_REACHED] > 0.0:
        ctl[S.ANGLE] += wrap(bearing - ctl[S.BEARING]) * (1.0 if radius > 0.0 else -1.0)
        ctl[S.TIMER] += dt
    elif hypot(n, e) < _ORBIT_MARGIN * abs(radius):
        ctl[S.CIRCLE_REACHED] = 1.0
    ctl[S.BEARING] = bearing
    return (
        ctl[S.CIRCLE_REACHED] > 0.0 and int(leg[KIND]) != LOITER_UNLIMITED and leg_rules.exit_condition_met(ctl, leg, p)
    )


@kernel
def height_demand(ctl: np.ndarray, legs: np.ndarray, p: np.ndarray) -> float:
    """Return the height demand: linear along a line that starts at a waypoint, else constant [m].

    Args:
        ctl, legs: controller state, route
        p: position, NED, (3,) [m]
    """
    i = leg_rules.current_leg(ctl, legs)
    if i < 0:
        return -ctl[S.PREV_D]
    along, length = leg_rules.along_line(ctl, legs[i], p)
    if ctl[S.FOLLOW_LINE] == 0.0 or length < 1.0 or ctl[S.CIRCLE_REACHED] > 0.0 or int(legs[i, KIND]) == TAKEOFF:
        return -legs[i, P_D]
    return -ctl[S.PREV_D] + (ctl[S.PREV_D] - legs[i, P_D]) * clip(along / length, 0.0, 1.0)
