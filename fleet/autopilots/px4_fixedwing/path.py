"""Path, leg sequencing and height demand of PX4; lateral guidance by NPFG, or by L1 before PX4 1.13.

A waypoint is reached within the switch distance and the height tolerance; a missed waypoint is approached again.
Source: PX4 navigator (mission items) and its fixed-wing mode manager (lines, circles, first-order altitude hold).
"""

from math import atan, atan2, cos, hypot, pi, sin, sqrt

import numpy as np

from fleet.autopilots import control_law as S
from fleet.autopilots.arduplane import legs as leg_rules
from fleet.autopilots.control_law import W_E, W_N, angle_to, clip, kernel
from fleet.autopilots.px4_fixedwing import l1
from fleet.autopilots.px4_fixedwing import params as P
from fleet.autopilots.px4_fixedwing import params as X
from fleet.frames import G, wrap
from fleet.mission import ACCEPT_RADIUS, KIND, LAND, LOITER_UNLIMITED, P_D, P_E, P_N, RADIUS, TAKEOFF, WAYPOINT

_EXIT_SECTOR = pi / 15  # exit from a circle within 12 deg of the exit course, if required [rad]
_CIRCLE_MARGIN = 1.2  # distance to a circle, in switch distances, that counts as reached [-]


@kernel
def begin(ctl: np.ndarray, par: np.ndarray, legs: np.ndarray, k: int, p: np.ndarray) -> None:
    """Switch to leg `k`; its line starts at the point of the previous leg, else at the aircraft `p`, NED (3,) [m]."""
    i = leg_rules.current_leg(ctl, legs)
    continues = i >= 0 and k == i + 1 and int(legs[i, KIND]) != TAKEOFF
    leg_rules.set_leg(ctl, par, legs, k, legs[i, P_N : P_D + 1] if continues else p)
    ctl[S.FOLLOW_LINE] = 1.0 if continues else 0.0


@kernel
def _to_point(n: float, e: float, p: np.ndarray) -> tuple[float, float, float]:
    """Return the direction to a point, and zero crosstrack error."""
    d_n, d_e = n - p[0], e - p[1]
    distance = max(hypot(d_n, d_e), 0.1)
    return d_n / distance, d_e / distance, 0.0


@kernel
def _line(ctl: np.ndarray, leg: np.ndarray, p: np.ndarray, reach: float) -> tuple[float, float, float]:
    """Return direction and crosstrack error of the line; beyond its ends the direction to the nearer end."""
    a_n, a_e = ctl[S.PREV_N], ctl[S.PREV_E]
    along, length = leg_rules.along_line(ctl, leg, p)
    if length < 1.0 or along > length:
        return _to_point(leg[P_N], leg[P_E], p)
    if along < 0.0 and hypot(p[0] - a_n, p[1] - a_e) > reach:
        return _to_point(a_n, a_e, p)
    t_n, t_e = (leg[P_N] - a_n) / length, (leg[P_E] - a_e) / length
    return t_n, t_e, t_n * (p[1] - a_e) - t_e * (p[0] - a_n)


@kernel
def _circle(leg: np.ndarray, p: np.ndarray, radius: float) -> tuple[float, float, float, float]:
    """Return direction, error and curvature of a circle at its nearest point; radius positive clockwise [m]."""
    out_n, out_e = p[0] - leg[P_N], p[1] - leg[P_E]
    r = hypot(out_n, out_e)
    if r < 0.1:
        out_n, out_e, r = 1.0, 0.0, 1.0
    d = 1.0 if radius > 0.0 else -1.0
    return -out_e / r * d, out_n / r * d, (abs(radius) - r) * d, 1.0 / radius


@kernel
def steer(
    ctl: np.ndarray,
    par: np.ndarray,
    legs: np.ndarray,
    p: np.ndarray,
    v: np.ndarray,
    psi: float,
    V: float,
    dt: float,
) -> tuple[float, bool]:
    """Compute lateral guidance on the current leg.

    Args:
        ctl, par, legs: controller state, parameters, route
        p, v: position and ground velocity, NED, (3,) [m, m/s]
        psi: heading [rad]
        V: true airspeed [m/s]
        dt: step [s]
    Returns:
        lateral acceleration, right positive [m/s2]; whether the leg is complete
    """
    i = leg_rules.current_leg(ctl, legs)
    if i < 0:
        return 0.0, False
    leg, kind = legs[i], int(legs[i, KIND])
    if kind == TAKEOFF:
        return 0.0, p[2] <= leg[P_D]
    reach = switch_distance(par, hypot(v[0], v[1]))
    radius = leg[RADIUS] if leg[RADIUS] != 0.0 and kind not in (WAYPOINT, LAND) else par[P.LOITER_RAD]
    radius = radius if abs(radius) > 1.0 else 1.0
    if kind in (WAYPOINT, LAND):
        return _along_line(par, ctl, leg, p, v, psi, V, reach, radius)
    _update_circle(ctl, par, leg, p, radius, reach, dt)
    return _follow_circle(ctl, par, leg, p, v, psi, V, radius), _circle_done(ctl, legs, i, p, v)


@kernel
def _follow_circle(
    ctl: np.ndarray, par: np.ndarray, leg: np.ndarray, p: np.ndarray, v: np.ndarray, psi: float, V: float, radius: float
) -> float:
    """Return the lateral acceleration to follow a circle, right positive [m/s2]."""
    if par[P.USES_L1] > 0.0:
        return l1.follow_circle(ctl, par, leg, p, v, radius)
    t_n, t_e, e, kappa = _circle(leg, p, radius)
    return follow(par, t_n, t_e, e, kappa, v, psi, V)


@kernel
def _along_line(
    par: np.ndarray, ctl: np.ndarray, leg: np.ndarray, p: np.ndarray, v: np.ndarray, psi: float, V: float,
    reach: float, radius: float,
) -> tuple[float, bool]:  # fmt: skip
    """Follow the line to a waypoint; circle there while the height error is large."""
    to_go, alt_error = hypot(leg[P_N] - p[0], leg[P_E] - p[1]), abs(p[2] - leg[P_D])
    waypoint = int(leg[KIND]) == WAYPOINT
    if (
        waypoint
        and to_go < 2.0 * abs(radius)
        and alt_error > 2.0 * par[P.ALT_RAD]
        and (to_go < reach or ctl[S.CIRCLING] > 0)
    ):
        ctl[S.CIRCLING] = 1.0
    elif alt_error < par[P.ALT_RAD]:
        ctl[S.CIRCLING] = 0.0
    if ctl[S.CIRCLING] > 0.0:
        return _follow_circle(ctl, par, leg, p, v, psi, V, radius), False
    t_n, t_e, e = _line(ctl, leg, p, reach)
    leg_done = waypoint and to_go <= max(reach, leg[ACCEPT_RADIUS]) and alt_error <= par[P.ALT_RAD]
    if par[P.USES_L1] > 0.0:
        return l1.follow_line(par, t_n, t_e, e, v), leg_done
    return follow(par, t_n, t_e, e, 0.0, v, psi, V), leg_done


@kernel
def _update_circle(
    ctl: np.ndarray, par: np.ndarray, leg: np.ndarray, p: np.ndarray, radius: float, reach: float, dt: float
) -> None:
    """Integrate angle and time since reaching the circle at its height."""
    out_n, out_e = leg[P_N] - p[0], leg[P_E] - p[1]
    bearing = atan2(out_e, out_n)
    if ctl[S.CIRCLE_REACHED] > 0.0:
        ctl[S.ANGLE] += wrap(bearing - ctl[S.BEARING]) * (1.0 if radius > 0.0 else -1.0)
        ctl[S.TIMER] += dt
    elif abs(hypot(out_n, out_e) - abs(radius)) < _CIRCLE_MARGIN * reach and abs(p[2] - leg[P_D]) < par[P.ALT_RAD]:
        ctl[S.CIRCLE_REACHED] = 1.0
    ctl[S.BEARING] = bearing


@kernel
def _circle_done(ctl: np.ndarray, legs: np.ndarray, i: int, p: np.ndarray, v: np.ndarray) -> bool:
    """Return whether a circle is complete: time or height reached, and exit course if required."""
    leg = legs[i]
    if i + 1 >= legs.shape[0] or int(leg[KIND]) == LOITER_UNLIMITED or ctl[S.CIRCLE_REACHED] == 0.0:
        return False
    if not leg_rules.exit_condition_met(ctl, leg, p):
        return False
    out_n, out_e = legs[i + 1, P_N] - p[0], legs[i + 1, P_E] - p[1]
    inside = hypot(legs[i + 1, P_N] - leg[P_N], legs[i + 1, P_E] - leg[P_E]) < abs(leg[RADIUS])
    return leg[ACCEPT_RADIUS] == 0.0 or inside or abs(angle_to(v[0], v[1], out_n, out_e)) <= _EXIT_SECTOR


@kernel
def height_demand(ctl: np.ndarray, par: np.ndarray, legs: np.ndarray, p: np.ndarray, speed: float) -> float:
    """Return the height demand [m]: linear in the remaining distance to the switch distance, else constant.

    Args:
        ctl, par, legs: controller state, parameters, route
        p: position, NED, (3,) [m]
        speed: over ground [m/s]
    """
    i = leg_rules.current_leg(ctl, legs)
    if i < 0:
        return -ctl[S.PREV_D]
    leg = legs[i]
    to_go = hypot(leg[P_N] - p[0], leg[P_E] - p[1])
    ctl[X.MIN_DISTANCE] = to_go if ctl[X.MIN_DISTANCE] < 0.0 else min(to_go, ctl[X.MIN_DISTANCE])
    switch_radius = max(switch_distance(par, speed), abs(leg[RADIUS]))
    length = hypot(leg[P_N] - ctl[S.PREV_N], leg[P_E] - ctl[S.PREV_E])
    if (
        ctl[S.FOLLOW_LINE] == 0.0
        or length <= switch_radius
        or ctl[S.CIRCLE_REACHED] + ctl[S.CIRCLING] > 0.0
        or int(leg[KIND]) == TAKEOFF
    ):
        return -leg[P_D]
    fraction_left = clip((ctl[X.MIN_DISTANCE] - switch_radius) / (length - switch_radius), 0.0, 1.0)
    return -leg[P_D] + (leg[P_D] - ctl[S.PREV_D]) * fraction_left


_MIN_RADIUS_RATIO = 0.1  # lower limit of 1 - kappa e in the feed-forward [-]
_MAX_SWITCH_DISTANCE = 500.0  # maximum switch distance [m]
_MIN_AIRSPEED = 3.0  # minimum airspeed in the equations [m/s]


@kernel
def period(par: np.ndarray) -> float:
    """Return the period: the parameter, but not below the limit of the roll loop [s]."""
    min_period = pi * par[P.NPFG_TC] / par[P.DAMPING] * par[P.PERIOD_SF]
    return max(par[P.PERIOD], min_period) if par[P.LB_PERIOD] > 0.0 else par[P.PERIOD]


@kernel
def error_bound(par: np.ndarray, speed: float) -> float:
    """Return the distance beyond which the path is approached at right angles, for a ground speed [m]."""
    tau = period(par) * par[P.DAMPING]
    return speed * tau if speed > 1.0 else 0.5 * tau * (speed * speed + 1.0)


@kernel
def switch_distance(par: np.ndarray, speed: float) -> float:
    """Return the distance to a waypoint at which the next leg starts [m]."""
    reach = l1.distance(par, speed) if par[P.USES_L1] > 0.0 else par[P.SWITCH] * error_bound(par, speed)
    return max(min(reach, _MAX_SWITCH_DISTANCE), par[P.ACC_RAD])


@kernel
def _air_course(par: np.ndarray, b_n: float, b_e: float, V: float) -> tuple[float, float, bool]:
    """Return the air velocity for ground course b in wind, and whether it exists; else the upwind direction."""
    crosswind = par[W_N] * b_e - par[W_E] * b_n
    if abs(crosswind) < V:
        air_along = sqrt(V * V - crosswind * crosswind)
        if air_along + par[W_N] * b_n + par[W_E] * b_e > 0.0:
            return air_along * b_n - crosswind * b_e, air_along * b_e + crosswind * b_n, True
    return -par[W_N], -par[W_E], False


@kernel
def _curvature_accel(par: np.ndarray, t_n: float, t_e: float, v: np.ndarray, V: float, e: float, kappa: float) -> float:
    """Return the lateral acceleration through the air for the path curvature `kappa` [1/m] [m/s2]."""
    w_t, w_c = par[W_N] * t_n + par[W_E] * t_e, par[W_N] * t_e - par[W_E] * t_n
    ratio = 1.0 + w_t / sqrt(max(V * V - w_c * w_c, 1.0))
    along = max(v[0] * t_n + v[1] * t_e, 0.0)
    return V * ratio * along * kappa / max(1.0 - kappa * e, _MIN_RADIUS_RATIO)


@kernel
def follow(
    par: np.ndarray, t_n: float, t_e: float, e: float, kappa: float, v: np.ndarray, psi: float, V: float
) -> float:
    """Return the lateral acceleration to follow a path.

    Args:
        par: parameters, including the wind estimate
        t_n, t_e: unit vector along the path at its nearest point
        e: distance right of it [m]
        kappa: its curvature, positive to the right [1/m]
        v: ground velocity, NED, (3,) [m/s]
        psi: heading, used without air velocity [rad]
        V: true airspeed [m/s]
    Returns:
        lateral acceleration, right positive [m/s2]
    """
    V = max(V, _MIN_AIRSPEED)
    e_normalised = min(abs(e) / error_bound(par, hypot(v[0], v[1])), 1.0)
    look_angle = 0.5 * pi * (e_normalised - 1.0) ** 2
    side = -1.0 if e > 0.0 else 1.0  # towards the path: right is (-t_e, t_n)
    b_n, b_e = (
        cos(look_angle) * side * -t_e + sin(look_angle) * t_n,
        cos(look_angle) * side * t_n + sin(look_angle) * t_e,
    )
    c_n, c_e, feasible = _air_course(par, b_n, b_e, V)
    a_n, a_e = v[0] - par[W_N], v[1] - par[W_E]
    if hypot(a_n, a_e) < 1.0:
        a_n, a_e = cos(psi), sin(psi)
    d_chi = angle_to(a_n, a_e, c_n, c_e)
    gain = 4.0 * pi * par[P.DAMPING] / period(par) * V
    a_lat = gain * (sin(d_chi) if abs(d_chi) < 0.5 * pi else (1.0 if d_chi > 0.0 else -1.0))
    if kappa != 0.0 and feasible:
        a_lat += sin(look_angle) ** 2 * _curvature_accel(par, t_n, t_e, v, V, e, kappa)
    return a_lat


@kernel
def to_roll(par: np.ndarray, a_lat: float, phi_last: float, dt: float) -> float:
    """Convert lateral acceleration [m/s2] to bank, limited and slew-limited from the previous demand [rad]."""
    phi = clip(atan(a_lat / G), -par[P.ROLL_LIMIT], par[P.ROLL_LIMIT])
    step = par[P.ROLL_SLEW] * dt
    return clip(phi, phi_last - step, phi_last + step) if step > 0.0 else phi
