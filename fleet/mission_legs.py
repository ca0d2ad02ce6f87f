"""Legs of a route: the columns of a leg, and the leg of one mission item.

A leg is one row of float64 with the columns named here; the first one is the leg type:

    WAYPOINT         fly the line from the previous point to here, then continue
    LOITER_TURNS     circle `TURNS` times, exit towards the next leg
    LOITER_UNLIMITED circle indefinitely
    LOITER_TIME      circle for `TURNS` seconds
    LOITER_TO_ALT    circle until the altitude is reached
    TAKEOFF          climb wings level to the altitude
    LAND             fly to the point; no leg follows automatically
    CHANGE_ALTITUDE  continue on the line of the previous leg until the altitude is reached
    CONSTANT_BANK    hold a bank, at the height where the leg began
    GLIDE            hold a bank and a pitch at idle

Source: MAVLink mission protocol, MAV_CMD and MAV_FRAME; ArduPlane mission command list.
"""

from collections.abc import Mapping
from math import isfinite, nan

import numpy as np

from fleet.contract import Item

WAYPOINT, LOITER_TURNS, LOITER_UNLIMITED, LOITER_TIME, LOITER_TO_ALT = range(5)
TAKEOFF, LAND, CHANGE_ALTITUDE, CONSTANT_BANK, GLIDE = range(5, 10)
KIND = 0  # leg type, one of the ten above
P_N, P_E, P_D = 1, 2, 3  # target, or centre of the circle, NED from the route's origin [m]
RADIUS = 4  # radius of the circle, positive clockwise; 0: the autopilot's WP_LOITER_RAD [m]; pitch [rad] of GLIDE
# Turns; seconds for LOITER_TIME; of a return: RTL_AUTOLAND; of CHANGE_ALTITUDE: 1 climb, 2 descend, 0 either;
# of CONSTANT_BANK and GLIDE: bank [rad].
TURNS = 5
VA_C = 6  # commanded airspeed; <= 0: cruise [m/s]
# Acceptance radius; 0: from the parameters; negative: pass by at that distance [m]. Of a circle, ArduPlane: 1: the next
# line starts at the exit, 0: at the centre; PX4: 1: exit only towards the next leg. Of LOITER_UNLIMITED: 1: a return.
ACCEPT_RADIUS = 7
SEQ = 8  # mission item of this leg; -1: return to launch after the last one
N_COLUMNS = 9

LEG_NAMES = (
    *("waypoint", "loiter turns", "loiter", "loiter time", "loiter to altitude", "takeoff", "land", "change altitude"),
    *("bank", "glide"),
)
KINDS = {16: WAYPOINT, 17: LOITER_UNLIMITED, 18: LOITER_TURNS, 19: LOITER_TIME, 20: LOITER_UNLIMITED}
KINDS |= {21: LAND, 22: TAKEOFF, 30: CHANGE_ALTITUDE, 31: LOITER_TO_ALT, 82: WAYPOINT, 84: TAKEOFF, 85: LAND}
"""Leg type of each navigation command (MAV_CMD)."""
CIRCLES = (LOITER_TURNS, LOITER_UNLIMITED, LOITER_TIME, LOITER_TO_ALT)
ABSOLUTE, RELATIVE, TERRAIN = (0, 5), (3, 6), (10, 11)  # MAV_FRAME
GLOBAL_FRAMES = ABSOLUTE + RELATIVE + TERRAIN
_MAX_ALTITUDE = 1e5  # higher altitudes are input errors [m]
_MAX_SPEED = 300.0  # higher commanded speeds are input errors [m/s]
_PASS_BY = 1e-3  # smallest distance to pass by, which marks a pass [m]
_LOITER_RADIUS = 60.0  # ArduPlane's default WP_LOITER_RAD [m]


def position_error(item: Item) -> str:
    """Describe the error in a position; empty for a valid one. A nan fails every comparison."""
    if not abs(item.lat_e7) <= 9e8:
        return f"latitude {item.lat_e7} (1e-7 deg), expected within 90 deg"
    if not abs(item.lon_e7) <= 1.8e9:
        return f"longitude {item.lon_e7} (1e-7 deg), expected within 180 deg"
    if not abs(item.alt_m) <= _MAX_ALTITUDE:
        return f"altitude {item.alt_m}, expected within {_MAX_ALTITUDE:.0f} m"
    if item.frame not in GLOBAL_FRAMES:
        return f"frame {item.frame}, expected one of {GLOBAL_FRAMES}"
    return ""


def is_zero_position(item: Item) -> bool:
    """Return whether latitude and longitude are zero: no position, or the current one."""
    return item.lat_e7 == 0 and item.lon_e7 == 0


def finite(value: float, default: float = 0.0) -> float:
    """Return a finite value, else the default."""
    return value if isfinite(value) else default


def commanded_airspeed(item: Item, params: Mapping[str, float], *, home_first: bool) -> tuple[float | None, str]:
    """Return the airspeed that DO_CHANGE_SPEED commands, 0: cruise, None: unchanged [m/s]; and its problem.

    ArduPlane ignores airspeeds beyond its limits, and takes a ground speed as a lower limit; PX4 does not distinguish.

    Args:
        item: DO_CHANGE_SPEED
        params: autopilot parameters
        home_first: item 0 of the mission is home, as of ArduPilot
    """
    speed = item.param2
    if speed == -2:  # MAVLink: return to the default
        return 0.0, ""
    if not (isfinite(speed) and speed > 0):
        return None, ""
    low, high = _limit(params, ("AIRSPEED_MIN", "ARSPD_FBW_MIN")), _limit(params, ("AIRSPEED_MAX", "ARSPD_FBW_MAX"))
    if speed > _MAX_SPEED:
        problem = f"found a speed of {speed:g} m/s, expected at most {_MAX_SPEED:.0f}"
        return None, f"{problem}; used the previous speed, correct it"
    if item.param1 == 1:
        used = "ignored" if home_first else "used as airspeed"
        return None if home_first else speed, f"found a ground speed, expected an airspeed; {used}, set type 0"
    if home_first and (speed < low or speed > high):  # false for nan
        problem = f"found a speed of {speed:g} m/s, expected {low:g} to {high:g} (AIRSPEED_MIN, AIRSPEED_MAX)"
        return None, f"{problem}; used the previous speed as the autopilot does, correct it"
    return speed, ""


def _limit(params: Mapping[str, float], names: tuple[str, str]) -> float:
    """Return a limit by its current or older name; nan if it is unknown."""
    return next((params[name] for name in names if name in params), nan)


def make_leg(
    item: Item, target: np.ndarray, speed: float, params: Mapping[str, float], *, home_first: bool
) -> np.ndarray:
    """Return the leg of a navigation item, (N_COLUMNS,).

    Args:
        item: navigation item, its command in `KINDS`
        target: position, NED, (3,) [m]
        speed: commanded airspeed, 0: cruise [m/s]
        params: autopilot parameters
        home_first: item 0 of the mission is home, as of ArduPilot
    """
    kind, leg = KINDS[item.command], np.zeros(N_COLUMNS)
    leg[KIND], leg[P_N : P_D + 1], leg[VA_C], leg[SEQ] = kind, target, speed, item.seq
    if kind == WAYPOINT:
        accept, pass_by = max(finite(item.param2), 0.0), finite(item.param3)
        leg[ACCEPT_RADIUS] = min(accept - pass_by, -_PASS_BY) if pass_by > 0 else accept
    elif kind in (LOITER_TURNS, LOITER_TIME, CHANGE_ALTITUDE):
        leg[TURNS] = max(finite(item.param1), 0.0)
    if kind in CIRCLES:
        leg[RADIUS] = _radius(item, params, home_first)
    if home_first and kind in (LOITER_TURNS, LOITER_TIME, LOITER_TO_ALT):
        leg[ACCEPT_RADIUS] = float(finite(item.param4) > 0)
    elif not home_first and kind in (LOITER_TIME, LOITER_TO_ALT):
        heading = item.param2 if kind == LOITER_TIME else item.param1
        leg[ACCEPT_RADIUS] = float(finite(heading) > 0)
    return leg


def _radius(item: Item, params: Mapping[str, float], home_first: bool) -> float:
    """Return the signed radius of a circle; 0: the autopilot's own radius and direction [m].

    ArduPlane reads only the direction of LOITER_TIME, and takes a radius of up to 1 m as none. Without a radius,
    a negative sign turns left at WP_LOITER_RAD, which itself turns left if it is negative.
    """
    kind = KINDS[item.command]
    radius = finite(item.param2 if kind == LOITER_TO_ALT else item.param3)
    if not home_first:
        return radius
    if kind != LOITER_TIME and abs(radius) > 1.0:
        return radius
    return -_default_radius(params) if radius < 0 else 0.0


def _default_radius(params: Mapping[str, float]) -> float:
    """Return the size of WP_LOITER_RAD; up to 1 m it is not used [m]."""
    radius = abs(finite(params.get("WP_LOITER_RAD", _LOITER_RADIUS), _LOITER_RADIUS))
    return radius if radius > 1.0 else _LOITER_RADIUS


def line_starts_at_target(leg: np.ndarray | None, *, home_first: bool) -> bool:
    """Return whether the line after a leg starts at its target, and not where the aircraft left the leg.

    Args:
        leg: (N_COLUMNS,); None: no leg was flown, and no line starts at home
        home_first: item 0 of the mission is home, as of ArduPilot
    """
    if leg is None:
        return False
    from_centre = int(leg[KIND]) in (LOITER_TURNS, LOITER_TIME, LOITER_TO_ALT) and leg[ACCEPT_RADIUS] == 0.0
    return int(leg[KIND]) in (WAYPOINT, LAND) or (home_first and from_centre)
