"""Feasibility of the mission legs ahead: headwind, climb and descent rate, circle radius.

    ground speed   sqrt(Va^2 - w_cross^2) + w_along, at most Va - |w_cross|
    slope          (rise - tolerated miss) / length x ground speed, against the autopilot's climb and sink limits
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
from fleet.autopilots import control_law as parameters
from fleet.autopilots.arduplane import params as P
from fleet.contract import AlertKind
from fleet.frames import G, Origin, to_geodetic
from twin_worker.alerts.hysteresis import HazardEstimate

_LEGS = 12  # legs ahead that are checked
_MIN_GROUND_SPEED = 1.0  # minimum ground speed that counts as headway [m/s]
_WIND_DRIFT = 0.55  # standard deviation of the change of wind within minutes [m/s]
_LIMIT_SIGMA = 0.05  # relative standard deviation of a limit [-]
_TOLERATED_MISS = 15.0  # height by which the end of a leg may be missed [m]
_CLEAR_TEXT = "the mission is achievable"
_CIRCLES = (m.LOITER_TURNS, m.LOITER_UNLIMITED, m.LOITER_TIME, m.LOITER_TO_ALT)


class FlightLimits(NamedTuple):
    """Limits of a fixed wing from autopilot parameters; nan where they were not received."""

    Va: float  # cruise airspeed, true [m/s]
    climb: float  # [m/s]
    sink: float  # [m/s]
    bank: float  # [rad]
    radius: float  # of circles without a radius of their own [m]


class MissionState(NamedTuple):
    """State of an aircraft on its mission.

    Attributes:
        t: data time [s since 1970]
        position: NED from `origin`, (3,) [m]
        origin: origin of the route's frame
        wind: north and east component of the wind velocity, and its sigma, (3,) [m/s]
        route: route from the active item on
    """

    t: float
    position: np.ndarray
    origin: Origin
    wind: np.ndarray
    route: m.Route


def read_limits(params: Mapping[str, float], altitude_m: float) -> FlightLimits:
    """Read limits from ArduPlane or PX4 parameters, at a height above sea level [m]."""
    if "FW_AIRSPD_TRIM" in params:
        names = ("FW_AIRSPD_TRIM", "FW_T_CLMB_MAX", "FW_T_SINK_MAX", "FW_R_LIM", "NAV_LOITER_RAD")
        Va, climb, sink, bank, radius = (params.get(name, np.nan) for name in names)
        return FlightLimits(Va * parameters.eas2tas(altitude_m), climb, sink, radians(bank), abs(radius))
    values, absent = arduplane.parameters(params, altitude_m)
    indices = (P.VA_CRUISE, P.CLIMB_MAX, P.SINK_MAX, P.ROLL_LIMIT, P.LOITER_RAD)
    Va, climb, sink, bank, radius = (np.nan if P.NAMES[i] in absent else float(values[i]) for i in indices)
    return FlightLimits(Va * parameters.eas2tas(altitude_m), climb, sink, bank, abs(radius))


def feasibility_hazard(state: MissionState, limits: FlightLimits) -> HazardEstimate:
    """Check the legs ahead and return the least feasible one; the check ends at a leg of unknown airspeed.

    Without a wind estimate no leg is checked.
    """
    if not np.isfinite(state.wind).all():
        return HazardEstimate(AlertKind.NOT_ACHIEVABLE, 0.0, "", _CLEAR_TEXT)
    t, start = state.t, state.route.start if np.isfinite(state.route.start).all() else state.position
    assessed: list[tuple[float, str, np.ndarray, float]] = []
    for leg in state.route.legs[:_LEGS]:
        end = leg[m.P_N : m.P_D + 1]
        Va = leg[m.VA_C] * parameters.eas2tas(state.origin.alt_mm * 1e-3 - end[2]) if leg[m.VA_C] > 0 else limits.Va
        if not isfinite(Va):
            break
        speed, (probability, reason) = _assess_leg(leg, start, Va, limits, state.wind)
        assessed.append((probability, reason, leg, t))
        t += float(np.hypot(*(end - start)[:2])) / max(speed, _MIN_GROUND_SPEED)
        start = end
    probability, reason, leg, t = max(assessed, key=lambda each: each[0], default=(0.0, "", np.empty(0), t))
    if not probability > 0.0:
        return HazardEstimate(AlertKind.NOT_ACHIEVABLE, 0.0, "", _CLEAR_TEXT)
    position = Origin(*map(int, to_geodetic(state.origin, leg[m.P_N : m.P_D + 1])))
    item = f"mission item {int(leg[m.SEQ])}" if leg[m.SEQ] >= 0 else "the return to launch"
    return HazardEstimate(
        AlertKind.NOT_ACHIEVABLE, probability, f"{item} is not achievable: {reason}", _CLEAR_TEXT, -1, t, position
    )


def _assess_leg(
    leg: np.ndarray, start: np.ndarray, Va: float, limits: FlightLimits, wind: np.ndarray
) -> tuple[float, tuple[float, str]]:
    """Return the ground speed on a leg [m/s], and the greatest probability of infeasibility with its reason."""
    vector, length = leg[m.P_N : m.P_D + 1] - start, hypot(*(leg[m.P_N : m.P_D] - start[:2]))
    unit = vector[:2] / length if length > 1.0 else np.array([1.0, 0.0])
    along, cross = float(wind[:2] @ unit), float(wind[1] * unit[0] - wind[0] * unit[1])
    speed = sqrt(max(Va * Va - cross * cross, 0.0)) + along
    sigma = hypot(wind[2], _WIND_DRIFT)
    checks = []
    if length > 1.0:
        headway = min(speed, Va - abs(cross))
        reason = f"wind of {hypot(*wind[:2]):.0f} m/s leaves no headway at {Va:.0f} m/s of airspeed; raise the airspeed"
        checks.append((_probability(_MIN_GROUND_SPEED - headway, sigma), reason))
        if (rise := abs(float(vector[2])) - _TOLERATED_MISS) > 0.0:
            rate = -float(np.sign(vector[2])) * rise / length * max(speed, 0.0)
            checks += _assess_slope(leg, rate, limits, sigma / max(speed, _MIN_GROUND_SPEED))
    radius = abs(leg[m.RADIUS]) or limits.radius
    if int(leg[m.KIND]) in _CIRCLES and isfinite(limits.bank + radius) and radius > 0 and limits.bank > 0:
        required, allowed = Va * Va / (G * radius), tan(min(limits.bank, 1.5))
        reason = f"a circle of {radius:.0f} m at {Va:.0f} m/s needs {np.degrees(np.arctan(required)):.0f} deg of bank, "
        checks.append(
            (
                _probability(required / allowed - 1, _LIMIT_SIGMA),
                reason + f"the limit is {np.degrees(limits.bank):.0f}; widen it",
            )
        )
    return speed, max(checks, default=(0.0, ""))


def _assess_slope(leg: np.ndarray, rate: float, limits: FlightLimits, sigma: float) -> list[tuple[float, str]]:
    """Check the climb rate [m/s] that a leg requires; legs to a landing are not checked."""
    kind, allowed = int(leg[m.KIND]), limits.climb if rate > 0 else limits.sink
    if kind not in (m.WAYPOINT, m.LOITER_TURNS, m.LOITER_TIME) or not (isfinite(allowed) and allowed > 0):
        return []
    direction = "climb" if rate > 0 else "descent"
    reason = f"it requires a {direction} of {abs(rate):.1f} m/s, the limit is {allowed:.1f}; make the leg longer"
    return [(_probability(abs(rate) / allowed - 1, hypot(_LIMIT_SIGMA, sigma)), reason)]


def _probability(excess: float, sigma: float) -> float:
    return float(ndtr(excess / sigma))
