"""Leg sequencing and height demand along the route.

A line is complete within the turn distance of its end, or beyond the line through its end at right angles.
Source: ArduPlane mission logic, waypoint switching and altitude slope.
"""

from math import atan2, cos, pi, tan

import numpy as np

from fleet.autopilots import control_law as S
from fleet.autopilots import control_law as kernels
from fleet.autopilots.arduplane import l1
from fleet.autopilots.arduplane import params as P
from fleet.autopilots.control_law import hypot, kernel
from fleet.frames import G, wrap
from fleet.mission import (
    ACCEPT_RADIUS,
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
_ALT_TOLERANCE = 5.0  # altitude error that ends LOITER_TO_ALT [m]


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
    ctl[S.TURN] = pi / 2
    if i + 1 < legs.shape[0]:
        bearing = atan2(legs[i, P_E] - ctl[S.PREV_E], legs[i, P_N] - ctl[S.PREV_N])
        ctl[S.TURN] = abs(wrap(atan2(legs[i + 1, P_E] - legs[i, P_E], legs[i + 1, P_N] - legs[i, P_N]) - bearing))


@kernel
def begin(ctl: np.ndarray, par: np.ndarray, legs: np.ndarray, k: int, p: np.ndarray) -> None:
    """Switch to leg `k` at the aircraft position `p`, NED (3,) [m].

    The new line starts at the end of the previous one, but at the aircraft after a circle, after takeoff, or beyond its
    own end.
    """
    i = current_leg(ctl, legs)
    continues = i >= 0 and k == i + 1 and int(legs[i, KIND]) == WAYPOINT
    if not continues:
        set_leg(ctl, par, legs, k, p)
        return
    set_leg(ctl, par, legs, k, legs[i, P_N : P_D + 1])
    ctl[S.FOLLOW_LINE] = 1.0
    along, length = along_line(ctl, legs[k], p)
    if along > length:
        set_leg(ctl, par, legs, k, p)


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
    if kind in (WAYPOINT, LAND):
        if hypot(leg[P_N] - ctl[S.PREV_N], leg[P_E] - ctl[S.PREV_E]) < 0.1:  # no line: start one here
            ctl[S.PREV_N], ctl[S.PREV_E] = p[0], p[1]
        start_n, start_e = ctl[S.PREV_N], ctl[S.PREV_E]
        if ctl[S.FOLLOW_LINE] < 0.0:  # no crosstrack: the line starts at the aircraft at every step
            ctl[S.PREV_N], ctl[S.PREV_E] = p[0], p[1]
        a_lat = l1.follow_line(ctl, par, leg, p, v, euler[2], dt)
        ctl[S.PREV_N], ctl[S.PREV_E] = start_n, start_e
        return a_lat, kind == WAYPOINT and _arrived(ctl, par, leg, p, v, euler[2])
    radius = leg[RADIUS] if leg[RADIUS] != 0.0 else par[P.LOITER_RAD]
    d, R = 1.0 if radius >= 0.0 else -1.0, l1.circle_radius(par, abs(radius))
    if (
        ctl[S.CIRCLE_REACHED] == 0.0
        and ctl[S.FOLLOW_LINE] > 0.0
        and hypot(leg[P_N] - p[0], leg[P_E] - p[1]) > _LINE_RADII * R
    ):
        return l1.follow_line(ctl, par, leg, p, v, euler[2], dt), False
    a_lat, circling = l1.follow_circle(ctl, par, leg, p, v, euler[2], d * R)
    _update_circle(ctl, leg, p, circling, d, dt)
    return a_lat, _circle_done(ctl, legs, i, p, v, euler[2], R)


@kernel
def _arrived(ctl: np.ndarray, par: np.ndarray, leg: np.ndarray, p: np.ndarray, v: np.ndarray, psi: float) -> bool:
    to_go = hypot(leg[P_N] - p[0], leg[P_E] - p[1])
    accept = leg[ACCEPT_RADIUS]
    if accept == 0.0:
        _, _, speed = l1.ground_track(v, psi)
        reach = min(par[P.WP_RADIUS] * par[P.EAS2TAS] ** 2, l1.distance(par, speed))
        accept = reach * min(ctl[S.TURN], pi / 2) / (pi / 2)
    if accept > 0.0 and to_go <= accept:
        return True
    along, length = along_line(ctl, leg, p)
    if along <= length + max(-accept, 0.0):
        return False
    if par[P.WP_MAX_RADIUS] > 0.0 and to_go > par[P.WP_MAX_RADIUS]:  # passed too far away: fly to it again from here
        ctl[S.PREV_N], ctl[S.PREV_E], ctl[S.PREV_D] = p[0], p[1], p[2]
        return False
    return True


@kernel
def _update_circle(ctl: np.ndarray, leg: np.ndarray, p: np.ndarray, circling: bool, d: float, dt: float) -> None:
    """Integrate angle and time since reaching the circle."""
    bearing = atan2(leg[P_E] - p[1], leg[P_N] - p[0])
    ctl[S.CIRCLING] = 1.0 if circling else 0.0
    if ctl[S.CIRCLE_REACHED] > 0.0:
        ctl[S.ANGLE] += wrap(bearing - ctl[S.BEARING]) * d
        ctl[S.TIMER] += dt
    along, length = along_line(ctl, leg, p)
    if circling or along > length:
        ctl[S.CIRCLE_REACHED] = 1.0
    ctl[S.BEARING] = bearing


@kernel
def _circle_done(ctl: np.ndarray, legs: np.ndarray, i: int, p: np.ndarray, v: np.ndarray, psi: float, R: float) -> bool:
    leg = legs[i]
    if i + 1 >= legs.shape[0] or int(leg[KIND]) == LOITER_UNLIMITED or ctl[S.CIRCLE_REACHED] == 0.0:
        return False
    if ctl[S.EXIT_ANGLE] < 0.0:
        if not exit_condition_met(ctl, leg, p):
            return False
        ctl[S.EXIT_ANGLE] = max(ctl[S.ANGLE], 0.0)
    out_n, out_e = legs[i + 1, P_N] - p[0], legs[i + 1, P_E] - p[1]
    if hypot(legs[i + 1, P_N] - leg[P_N], legs[i + 1, P_E] - leg[P_E]) < R:  # the next target is inside the circle
        return True
    v_n, v_e, _ = l1.ground_track(v, psi)
    extra = np.floor(max(ctl[S.ANGLE] - ctl[S.EXIT_ANGLE], 0.0) / (2 * pi))
    return abs(kernels.angle_to(v_n, v_e, out_n, out_e)) <= _EXIT_SECTOR * (1.0 + extra)


@kernel
def exit_condition_met(ctl: np.ndarray, leg: np.ndarray, p: np.ndarray) -> bool:
    """Return whether the turns, time or height of a circle are complete; p: NED, (3,) [m]."""
    kind = int(leg[KIND])
    if kind == LOITER_TURNS:
        return ctl[S.ANGLE] >= 2 * pi * leg[TURNS]
    if kind == LOITER_TIME:
        return ctl[S.TIMER] >= leg[TURNS]
    return kind == LOITER_TO_ALT and abs(p[2] - leg[P_D]) < _ALT_TOLERANCE


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
    immediate = int(par[P.OPTIONS]) & _CLIMB_AT_ONCE != 0 or leg[SEQ] < 0.0
    if int(leg[KIND]) in (CONSTANT_BANK, GLIDE):
        return -ctl[S.PREV_D]
    if (
        int(leg[KIND]) == TAKEOFF
        or abs(rise) < par[P.SLOPE_MIN]
        or (rise > 0.0 and immediate)
        or ctl[S.CIRCLE_REACHED] > 0.0
    ):
        return h
    along, length = along_line(ctl, leg, p)
    if length < 0.1:
        return h
    return h - rise * (1.0 - kernels.clip(along / length, 0.0, 1.0))
