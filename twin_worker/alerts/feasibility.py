"""Feasibility of the mission legs ahead: headwind, climb and descent rate, circle radius.

    ground speed   sqrt(Va^2 - w_cross^2) + w_along, at most Va - |w_cross|
    slope          rise / length x ground speed, against the autopilot's climb and sink limits
    circle         tan(phi) = Va^2 / (g R) in still air, against the bank limit

Limits that were not received are not checked. The probability includes the sigma and drift of the wind, and 5 % of each
limit.
"""

from collections.abc import Mapping
from math import hypot, isfinite, radians, sqrt, tan
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from fleet import mission as m
from fleet.autopilots import arduplane
from fleet.autopilots.arduplane import params as P
from fleet.autopilots.common import parameters
from fleet.contract import AlertKind
from fleet.frames import G, Origin, to_geodetic
from twin_worker.alerts.hysteresis import Finding

_LEGS = 12  # legs ahead that are checked
_SLOWEST = 1.0  # minimum ground speed that counts as headway [m/s]
_CHANGES = 0.55  # standard deviation of the change of wind within minutes [m/s]
_SHARE = 0.05  # relative standard deviation of a limit [-]
_FLAT = 15.0  # smaller height differences are not checked: they take little time [m]
_OVER = "the mission is achievable"
_CIRCLES = (m.LOITER_TURNS, m.LOITER_UNLIMITED, m.LOITER_TIME, m.LOITER_TO_ALT)


class Ability(NamedTuple):
    """Limits of a fixed wing from autopilot parameters; nan where they were not received."""

    Va: float  # cruise airspeed, true [m/s]
    climb: float  # [m/s]
    sink: float  # [m/s]
    bank: float  # [rad]
    radius: float  # of circles without a radius of their own [m]


class Now(NamedTuple):
    """State of an aircraft on its mission.

    Attributes:
        t: data time [s since 1970]
        position: NED from `origin`, (3,) [m]
        origin: origin of the route's frame
        wind: north and east component of the wind velocity, and its sigma, (3,) [m/s]
        route: route from the active item on
    """

    t: float
    p: np.ndarray
    origin: Origin
    wind: np.ndarray
    way: m.Route


def ability(params: Mapping[str, float], altitude_m: float) -> Ability:
    """Read limits from ArduPlane or PX4 parameters, at a height above sea level [m]."""
    if "FW_AIRSPD_TRIM" in params:
        names = ("FW_AIRSPD_TRIM", "FW_T_CLMB_MAX", "FW_T_SINK_MAX", "FW_R_LIM", "NAV_LOITER_RAD")
        Va, climb, sink, bank, radius = (params.get(name, np.nan) for name in names)
        return Ability(Va * parameters.eas2tas(altitude_m), climb, sink, radians(bank), abs(radius))
    par, absent = arduplane.parameters(params, altitude_m)
    at = (P.VA_CRUISE, P.CLIMB_MAX, P.SINK_MAX, P.ROLL_LIMIT, P.LOITER_RAD)
    Va, climb, sink, bank, radius = (np.nan if P.NAMES[i] in absent else float(par[i]) for i in at)
    return Ability(Va * parameters.eas2tas(altitude_m), climb, sink, bank, abs(radius))


def achievable(now: Now, able: Ability) -> Finding:
    """Check the legs ahead and return the least feasible one; the check ends at a leg of unknown airspeed.

    Without a wind estimate no leg is checked.
    """
    if not np.isfinite(now.wind).all():
        return Finding(AlertKind.NOT_ACHIEVABLE, 0.0, "", _OVER)
    at, from_p = now.t, now.way.start if np.isfinite(now.way.start).all() else now.p
    worst: tuple[float, str, np.ndarray, float] | None = None
    for leg in now.way.legs[:_LEGS]:
        to = leg[m.P_N : m.P_D + 1]
        Va = leg[m.VA_C] * parameters.eas2tas(now.origin.alt_mm * 1e-3 - to[2]) if leg[m.VA_C] > 0 else able.Va
        if not isfinite(Va):
            break
        speed, (p, why) = _worst(leg, from_p, Va, able, now.wind)
        if p > (worst[0] if worst is not None else 0.0):
            worst = p, why, leg, at
        at += float(np.hypot(*(to - from_p)[:2])) / max(speed, _SLOWEST)
        from_p = to
    if worst is None:
        return Finding(AlertKind.NOT_ACHIEVABLE, 0.0, "", _OVER)
    p, why, leg, at = worst
    place = Origin(*map(int, to_geodetic(now.origin, leg[m.P_N : m.P_D + 1])))
    item = f"mission item {int(leg[m.SEQ])}" if leg[m.SEQ] >= 0 else "the return to launch"
    return Finding(AlertKind.NOT_ACHIEVABLE, p, f"{item} is not achievable: {why}", _OVER, -1, at, place)


def _worst(
    leg: np.ndarray, from_p: np.ndarray, Va: float, able: Ability, wind: np.ndarray
) -> tuple[float, tuple[float, str]]:
    """Return the ground speed on a leg [m/s], and the greatest probability of infeasibility with its reason."""
    way, length = leg[m.P_N : m.P_D + 1] - from_p, hypot(*(leg[m.P_N : m.P_D] - from_p[:2]))
    unit = way[:2] / length if length > 1.0 else np.array([1.0, 0.0])
    along, cross = float(wind[:2] @ unit), float(wind[1] * unit[0] - wind[0] * unit[1])
    speed = sqrt(max(Va * Va - cross * cross, 0.0)) + along
    sigma = hypot(wind[2], _CHANGES)
    checks = []
    if length > 1.0:
        left = min(speed, Va - abs(cross))
        why = f"wind of {hypot(*wind[:2]):.0f} m/s leaves no headway at {Va:.0f} m/s of airspeed; raise the airspeed"
        checks.append((_p(_SLOWEST - left, sigma), why))
        if abs(way[2]) > _FLAT:
            checks += _steep(leg, -float(way[2]) / length * max(speed, 0.0), able, sigma / max(speed, _SLOWEST))
    radius = abs(leg[m.RADIUS]) or able.radius
    if int(leg[m.KIND]) in _CIRCLES and isfinite(able.bank + radius) and radius > 0 and able.bank > 0:
        needed, most = Va * Va / (G * radius), tan(min(able.bank, 1.5))
        why = f"a circle of {radius:.0f} m at {Va:.0f} m/s needs {np.degrees(np.arctan(needed)):.0f} deg of bank, "
        checks.append((_p(needed / most - 1, _SHARE), why + f"the limit is {np.degrees(able.bank):.0f}; widen it"))
    return speed, max(checks, default=(0.0, ""))


def _steep(leg: np.ndarray, rate: float, able: Ability, share: float) -> list[tuple[float, str]]:
    """Check the climb rate [m/s] that a leg requires; legs to a landing are not checked."""
    kind, most = int(leg[m.KIND]), able.climb if rate > 0 else able.sink
    if kind not in (m.WAYPOINT, m.LOITER_TURNS, m.LOITER_TIME) or not (isfinite(most) and most > 0):
        return []
    word = "climb" if rate > 0 else "descent"
    why = f"it requires a {word} of {abs(rate):.1f} m/s, the limit is {most:.1f}; make the leg longer"
    return [(_p(abs(rate) / most - 1, hypot(_SHARE, share)), why)]


def _p(excess: float, sigma: float) -> float:
    return float(ndtr(excess / sigma))
