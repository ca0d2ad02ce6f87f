"""Leg sequencing and height demand along the route.

A line is complete within the turn distance of its end, or beyond the line through its end at right angles. The next
line starts at that end. After a circle it starts at the centre, or at the exit where the item's `param4` is positive;
after a takeoff and a change of mode there is no line, and the aircraft flies directly to the target.
Source: ArduPlane mission commands, waypoint switching, loiter exits and altitude slope.
"""

from math import asin, atan2, ceil, cos, pi, sin, tan

import numpy as np

from fleet.autopilots import control_law as S
from fleet.autopilots import control_law as kernels
from fleet.autopilots.arduplane import l1
from fleet.autopilots.arduplane import params as P
from fleet.autopilots.control_law import hypot, kernel
from fleet.frames import G, wrap
from fleet.mission import (
    ACCEPT_RADIUS,
    CHANGE_ALTITUDE,
    CONSTANT_BANK,
    GLIDE,
    KIND,
    LAND,
    LOITER_TIME,
    LOITER_TO_ALT,
    LOITER_TURNS,
    LOITER_UNLIMITED,
    P_D,
    P_E,
    P_N,
    RADIUS,
    SEQ,
    TAKEOFF,
    TURNS,
    WAYPOINT,
)  # fmt: skip

_CLIMB_AT_ONCE = 1 << 14  # FLIGHT_OPTIONS: climb to the next altitude at once
_EXIT_SECTOR = pi / 18  # exit from a circle within 10 deg of the exit course, plus 10 deg per extra turn [rad]
_LINE_RADII = 3.0  # distance in radii beyond which the line to a circle is followed
_ALT_TOLERANCE = 5.0  # altitude error that ends LOITER_TO_ALT and CHANGE_ALTITUDE [m]
_RETURN_ALT_TOLERANCE = 10.0  # altitude error at which a return with RTL_AUTOLAND 1 proceeds to the landing [m]
_LOITER_RADIUS = 60.0  # used where WP_LOITER_RAD is 1 m or less [m]
_EXTENSION, _EXTEND_AT = 300.0, 200.0  # CHANGE_ALTITUDE lengthens its line by this, this far before its end [m]


@kernel
def current_leg(ctl: np.ndarray, legs: np.ndarray) -> int:
    """Return the index of the current leg; -1 if the route is empty."""
    return min(max(int(ctl[S.LEG]), 0), legs.shape[0] - 1)


@kernel
def along_line(ctl: np.ndarray, leg: np.ndarray, p: np.ndarray) -> tuple[float, float]:
    """Return the along-track distance on the current line, and the length of the line [m]."""
    t_n, t_e = leg[P_N] - ctl[S.PREV_N], leg[P_E] - ctl[S.PREV_E]
    length = hypot(t_n, t_e)
    if length < 0.1:
        return 0.0, 0.0
    return ((p[0] - ctl[S.PREV_N]) * t_n + (p[1] - ctl[S.PREV_E]) * t_e) / length, length


@kernel
def set_leg(ctl: np.ndarray, par: np.ndarray, legs: np.ndarray, k: int, from_p: np.ndarray) -> None:
    """Start leg `k` (clamped to the route) on the line from `from_p`, NED (3,) [m]; not finite: from its target."""
    ctl[: S.N_LEG] = 0.0
    ctl[S.EXIT_ANGLE] = -1.0
    ctl[S.LEG] = max(k, 0)
    i = current_leg(ctl, legs)
    ctl[S.LEG] = max(i, 0)
    has_start = np.isfinite(from_p[0]) and np.isfinite(from_p[1]) and np.isfinite(from_p[2])
    for j in range(3):
        ctl[S.PREV_N + j] = from_p[j] if has_start else (legs[i, P_N + j] if i >= 0 else 0.0)
    if i < 0:
        return
    _set_turn(ctl, legs, i)


@kernel
def _set_turn(ctl: np.ndarray, legs: np.ndarray, i: int) -> None:
    """Set the turn angle at the end of leg `i`; 90 deg where no item follows."""
    ctl[S.TURN] = pi / 2
    if i + 1 < legs.shape[0] and not is_return(legs[i + 1]):
        bearing = atan2(legs[i, P_E] - ctl[S.PREV_E], legs[i, P_N] - ctl[S.PREV_N])
        ctl[S.TURN] = abs(wrap(atan2(legs[i + 1, P_E] - legs[i, P_E], legs[i + 1, P_N] - legs[i, P_N]) - bearing))


@kernel
def is_return(leg: np.ndarray) -> bool:
    """Return whether a leg is a return to launch: another mode, without a line to it or from it."""
    return int(leg[KIND]) == LOITER_UNLIMITED and (leg[SEQ] < 0.0 or leg[ACCEPT_RADIUS] > 0.0)


@kernel
def _has_line(legs: np.ndarray, i: int, k: int) -> bool:
    """Return whether leg `k` is flown along a line after leg `i`; an item selected with a mode has none."""
    if i < 0 or k != i + 1 or is_return(legs[k]):
        return False
    return int(legs[i, KIND]) != TAKEOFF and int(legs[i, KIND]) != LOITER_UNLIMITED


@kernel
def begin(ctl: np.ndarray, par: np.ndarray, legs: np.ndarray, k: int, p: np.ndarray) -> None:
    """Switch to leg `k` at the aircraft position `p`, NED (3,) [m].

    The new line starts where the previous leg ends, but at the aircraft where the aircraft is beyond its end.
    """
    i = current_leg(ctl, legs)
    course, (end_n, end_e) = _course(ctl, legs, i, p), _extended_line(ctl, p)[2:]
    if not _has_line(legs, i, k):
        set_leg(ctl, par, legs, k, p)
        ctl[S.FOLLOW_LINE], ctl[S.COURSE] = -1.0, course
        return
    from_exit = int(legs[i, KIND]) in (LOITER_TURNS, LOITER_TIME, LOITER_TO_ALT) and legs[i, ACCEPT_RADIUS] > 0.0
    set_leg(ctl, par, legs, k, p if from_exit else legs[i, P_N : P_D + 1])
    ctl[S.FOLLOW_LINE], ctl[S.COURSE] = 1.0, course
    if int(legs[i, KIND]) == CHANGE_ALTITUDE:
        ctl[S.PREV_N], ctl[S.PREV_E] = end_n, end_e
        _set_turn(ctl, legs, k)
    along, length = along_line(ctl, legs[k], p)
    if along >= length and int(legs[k, KIND]) != CHANGE_ALTITUDE:
        set_leg(ctl, par, legs, k, p)
        ctl[S.FOLLOW_LINE], ctl[S.COURSE] = 1.0, course


@kernel
def _course(ctl: np.ndarray, legs: np.ndarray, i: int, p: np.ndarray) -> float:
    """Return the course of the line of leg `i` [rad]; a line without length keeps the one before."""
    if i < 0 or int(legs[i, KIND]) == CHANGE_ALTITUDE:
        return ctl[S.COURSE]
    to_here = int(legs[i, KIND]) == TAKEOFF or (int(legs[i, KIND]) != WAYPOINT and legs[i, ACCEPT_RADIUS] > 0.0)
    n, e = (p[0], p[1]) if to_here else (legs[i, P_N], legs[i, P_E])
    n, e = n - ctl[S.PREV_N], e - ctl[S.PREV_E]
    return atan2(e, n) if hypot(n, e) > 0.1 else ctl[S.COURSE]


@kernel
def _extended_line(ctl: np.ndarray, p: np.ndarray) -> tuple[float, float, float, float]:
    """Return the line of CHANGE_ALTITUDE: the previous one, lengthened in steps while its end is near [m]."""
    c, s = cos(ctl[S.COURSE]), sin(ctl[S.COURSE])
    along = (p[0] - ctl[S.PREV_N]) * c + (p[1] - ctl[S.PREV_E]) * s
    reach = max(ceil((along + _EXTEND_AT) / _EXTENSION), 0.0) * _EXTENSION
    start = min(along, 0.0) - _EXTENSION  # any point behind the aircraft on the line
    n, e = ctl[S.PREV_N], ctl[S.PREV_E]
    return n + start * c, e + start * s, n + reach * c, e + reach * s


@kernel
def steer(
    ctl: np.ndarray, par: np.ndarray, legs: np.ndarray, p: np.ndarray, v: np.ndarray, euler: np.ndarray, dt: float
) -> tuple[float, bool]:
    """Compute lateral guidance on the current leg.

    Args:
        ctl, par, legs: controller state, parameters, route
        p, v: position and ground velocity, NED, (3,) [m, m/s]
        euler: phi, theta, psi (3,) [rad]
        dt: step [s]
    Returns:
        lateral acceleration, right positive [m/s2]; whether the leg is complete
    """
    i = current_leg(ctl, legs)
    if i < 0:
        return 0.0, False
    leg = legs[i]
    kind = int(leg[KIND])
    if kind == TAKEOFF:
        return 0.0, p[2] <= leg[P_D]
    if kind in (CONSTANT_BANK, GLIDE):
        return G * cos(euler[1]) * tan(leg[TURNS]), False
    line = (ctl[S.PREV_N], ctl[S.PREV_E], leg[P_N], leg[P_E])
    if kind == CHANGE_ALTITUDE:
        a_lat = l1.follow_line(ctl, par, _extended_line(ctl, p), p, v, euler[2], dt)
        return a_lat, _altitude_reached(leg, p)
    if kind in (WAYPOINT, LAND):
        if hypot(leg[P_N] - ctl[S.PREV_N], leg[P_E] - ctl[S.PREV_E]) < 0.1:  # no line: start one here
            ctl[S.PREV_N], ctl[S.PREV_E] = p[0], p[1]
        if ctl[S.FOLLOW_LINE] < 0.0:
            line = (p[0], p[1], leg[P_N], leg[P_E])
        a_lat = l1.follow_line(ctl, par, line, p, v, euler[2], dt)
        return a_lat, kind == WAYPOINT and _arrived(ctl, par, leg, p, v, euler[2])
    radius = leg[RADIUS] if leg[RADIUS] != 0.0 else par[P.LOITER_RAD]
    d, R = 1.0 if radius >= 0.0 else -1.0, abs(radius) if abs(radius) > 1.0 else _LOITER_RADIUS
    R = l1.circle_radius(par, R, ctl[S.V_DEM] / par[P.EAS2TAS])
    if (
        ctl[S.CIRCLE_REACHED] == 0.0
        and ctl[S.FOLLOW_LINE] > 0.0
        and hypot(leg[P_N] - p[0], leg[P_E] - p[1]) > _LINE_RADII * R
    ):
        return l1.follow_line(ctl, par, line, p, v, euler[2], dt), False
    a_lat, on_circle = l1.follow_circle(ctl, par, leg, p, v, euler[2], d * R)
    leg_done = _circle_done(ctl, legs, i, p, R, d)
    _update_circle(ctl, leg, p, on_circle, d, dt)
    return a_lat, leg_done


@kernel
def _altitude_reached(leg: np.ndarray, p: np.ndarray) -> bool:
    """Return whether CHANGE_ALTITUDE is complete: climbed to, descended to, or within 5 m of its altitude."""
    above = leg[P_D] - p[2]
    if leg[TURNS] == 1.0:
        return above >= 0.0
    return above <= 0.0 if leg[TURNS] == 2.0 else abs(above) <= _ALT_TOLERANCE


@kernel
def _arrived(ctl: np.ndarray, par: np.ndarray, leg: np.ndarray, p: np.ndarray, v: np.ndarray, psi: float) -> bool:
    to_go = hypot(leg[P_N] - p[0], leg[P_E] - p[1])
    accept = leg[ACCEPT_RADIUS]
    if accept == 0.0:
        _, _, speed = l1.ground_track(v, psi)
        reach = min(par[P.WP_RADIUS] * par[P.EAS2TAS] ** 2, l1.distance(par, speed))
        accept = reach * min(ctl[S.TURN], pi / 2) / (pi / 2)
    along, length = along_line(ctl, leg, p)
    passed = along > length + max(-accept, 0.0)
    if par[P.WP_MAX_RADIUS] > 0.0 and to_go > par[P.WP_MAX_RADIUS]:
        if passed and accept >= 0.0:  # too far away: fly to it again from here
            ctl[S.PREV_N], ctl[S.PREV_E], ctl[S.PREV_D] = p[0], p[1], p[2]
        return False
    return passed or (accept > 0.0 and to_go <= accept)


@kernel
def _update_circle(ctl: np.ndarray, leg: np.ndarray, p: np.ndarray, on_circle: bool, d: float, dt: float) -> None:
    """Integrate the time since the target was reached, and the angle since the circle was."""
    bearing = atan2(leg[P_E] - p[1], leg[P_N] - p[0])
    if ctl[S.CIRCLING] > 0.0:
        ctl[S.ANGLE] += wrap(bearing - ctl[S.BEARING]) * d
    if ctl[S.CIRCLE_REACHED] > 0.0:
        ctl[S.TIMER] += dt
    along, length = along_line(ctl, leg, p)
    if on_circle:
        ctl[S.CIRCLING] = 1.0  # and stays on it in a gust
    if on_circle or along > length:
        ctl[S.CIRCLE_REACHED] = 1.0
    ctl[S.BEARING] = bearing


@kernel
def _circle_done(ctl: np.ndarray, legs: np.ndarray, i: int, p: np.ndarray, R: float, d: float) -> bool:
    """Return whether a circle of radius `R` [m] and direction `d` is left here, towards the next leg."""
    leg = legs[i]
    if i + 1 >= legs.shape[0]:
        return False
    if is_return(leg):
        near = ctl[S.CIRCLING] > 0.0 and abs(p[2] - leg[P_D]) < _RETURN_ALT_TOLERANCE
        return leg[TURNS] == 2.0 or (leg[TURNS] == 1.0 and near)
    if int(leg[KIND]) == LOITER_UNLIMITED or ctl[S.CIRCLE_REACHED] == 0.0:
        return False
    if ctl[S.EXIT_ANGLE] < 0.0:
        off_circle = int(leg[KIND]) != LOITER_TIME and ctl[S.CIRCLING] == 0.0
        if off_circle or not exit_condition_met(ctl, leg, p):
            return False
        ctl[S.EXIT_ANGLE] = max(ctl[S.ANGLE], 0.0)
    if is_return(legs[i + 1]):
        return True
    extra = np.floor(max(ctl[S.ANGLE] - ctl[S.EXIT_ANGLE], 0.0) / (2 * pi))
    return abs(_exit_error(leg, legs[i + 1], p, R, d)) <= _EXIT_SECTOR * (1.0 + extra)


@kernel
def _exit_error(leg: np.ndarray, next_leg: np.ndarray, p: np.ndarray, R: float, d: float) -> float:
    """Return the angle from the tangent of the circle, at the aircraft, to the exit course [rad].

    The exit course leads from the nearest point of the circle to the next target. A target inside the circle is left
    for before its bearing: by the angle of a chord as long as the target's distance from the circle.
    """
    angle = atan2(p[1] - leg[P_E], p[0] - leg[P_N])
    t_n, t_e = next_leg[P_N] - leg[P_N], next_leg[P_E] - leg[P_E]
    distance = hypot(t_n, t_e)
    if distance <= 0.0:
        return 0.0
    if distance >= R:
        exit_course = atan2(t_e - R * sin(angle), t_n - R * cos(angle))
    else:
        exit_course = atan2(t_e, t_n) + d * (pi / 2 - 2.0 * asin((R - distance) / (2.0 * R)))
    return wrap(exit_course - (angle + d * pi / 2))


@kernel
def exit_condition_met(ctl: np.ndarray, leg: np.ndarray, p: np.ndarray) -> bool:
    """Return whether the turns, time or height of a circle are complete; p: NED, (3,) [m]."""
    kind = int(leg[KIND])
    if kind == LOITER_TURNS:
        return ctl[S.ANGLE] > 2 * pi * leg[TURNS]
    if kind == LOITER_TIME:
        return ctl[S.TIMER] > leg[TURNS]
    return kind in (LOITER_TO_ALT, CHANGE_ALTITUDE) and abs(p[2] - leg[P_D]) < _ALT_TOLERANCE


@kernel
def height_demand(ctl: np.ndarray, par: np.ndarray, legs: np.ndarray, p: np.ndarray) -> float:
    """Return the height demand above the origin [m]: linear along a sloped leg, constant on a flat one.

    Args:
        ctl, par, legs: controller state, parameters, route
        p: position, NED, (3,) [m]
    """
    i = current_leg(ctl, legs)
    if i < 0:
        return -ctl[S.PREV_D]
    leg = legs[i]
    h, rise = -leg[P_D], ctl[S.PREV_D] - leg[P_D]
    immediate = int(par[P.OPTIONS]) & _CLIMB_AT_ONCE != 0 or is_return(leg)
    if int(leg[KIND]) in (CONSTANT_BANK, GLIDE):
        return -ctl[S.PREV_D]
    if (
        int(leg[KIND]) in (TAKEOFF, CHANGE_ALTITUDE)
        or par[P.SLOPE_MIN] <= 0.0
        or abs(rise) < par[P.SLOPE_MIN]
        or (rise > 0.0 and immediate)
        or ctl[S.CIRCLING] > 0.0
    ):
        return h
    along, length = along_line(ctl, leg, p)
    if length < 0.1:
        return h
    return h - rise * (1.0 - kernels.clip(along / length, 0.0, 1.0))
