"""Routes of the modes that an autopilot flies by itself without a mission: one table per autopilot.

    mode_route("arduplane", "RTL", situation, params)  ->  Route, or None for a mode flown by hand or unknown

ArduPlane                                         PX4 fixed wing
    RTL       circle over home at RTL_ALTITUDE        RTL      climb, fly home, descend, circle
    LOITER    circle where the mode was entered       LOITER   (Hold) circle where the mode was entered
    GUIDED    circle about the commanded point        TAKEOFF  circle at the end of the take-off
    TAKEOFF   circle at the end of the take-off
    CIRCLE    a third of the bank limit
    CRUISE    the height of the entry; the course 0.5 s after it, once the wings are level

A reported guidance target (POSITION_TARGET_GLOBAL_INT) replaces the assumed centre. Assumptions: home is no rally
point, no terrain is followed, RTL_CLIMB_MIN is 0, and the pilot does not move the sticks.
Source: ArduPlane flight modes, PX4 user guide (fixed-wing flight modes), and the parameter references of both.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import cos, hypot, isfinite, radians, sin

import msgspec
import numpy as np

from fleet.contract import Item
from fleet.frames import Origin, to_ned, wrap
from fleet.mission import (
    CONSTANT_BANK,
    GLIDE,
    KIND,
    LOITER_TO_ALT,
    LOITER_UNLIMITED,
    N_COLUMNS,
    P_D,
    P_N,
    RADIUS,
    SEQ,
    TURNS,
    VA_C,
    WAYPOINT,
    Route,
    unroll_route,
)
from fleet.mission_jumps import nearest_landing

NO_ITEM = -1.0  # mission item of a leg that belongs to no mission
_HOLD_LEG_M = 1e5  # length of the line of a heading-hold mode [m]
_TARGET_TOLERANCE_M = 5.0  # distance at which two points are the same [m]
_PX4_BY_MISSION, _PX4_ANY_LANDING = (2, 4, 5), (1, 3)  # RTL_TYPE: not directly home; not if the mission lands
_PX4_LANDINGS = (21, 85, 189)  # MAV_CMD: NAV_LAND, NAV_VTOL_LAND, DO_LAND_START
_STEERED_M, _STEERED_RAD = 50.0, radians(10.0)  # off the line or off its course by more: the pilot has steered
_STEERING_BANK = radians(10.0)  # a steered aircraft with more bank is still being steered [rad]
_SHORT_GLIDE = 2  # FS_SHORT_ACTN


class ModeEntry(msgspec.Struct, frozen=True):
    """Where a mode was entered.

    Attributes:
        t: time [s since 1970]
        position: latitude, longitude, height above mean sea level [1e-7 deg, 1e-7 deg, mm]
        course: over ground [rad]
        locked: position and course are those that a heading-hold mode has locked
    """

    t: float
    position: tuple[float, float, float]
    course: float
    locked: bool = False

    def ned(self, origin: Origin) -> np.ndarray:
        """Return the position, NED, (3,) [m]."""
        return to_ned(origin, *(np.array([x]) for x in self.position))[0]


@dataclass(frozen=True)
class ModeSituation:
    """What the route of a mode depends on beside parameters.

    Attributes:
        origin: of the NED frame
        entry: position at the mode change, NED, (3,) [m]
        course: over ground at the mode change [rad]
        position: present position, NED, (3,) [m]
        home: NED, (3,) [m]; None: unknown
        target: reported guidance target, NED, (3,) [m]; None: not reported since the mode change
        items: mission on board
    """

    origin: Origin
    entry: np.ndarray
    course: float
    position: np.ndarray
    home: np.ndarray | None = None
    target: np.ndarray | None = None
    items: tuple[Item, ...] = ()


_Rule = Callable[[ModeSituation, Mapping[str, float]], Route]


def _parameter(params: Mapping[str, float], names: Sequence[tuple[str, float]], default: float) -> float:
    """Return the first finite parameter of `names` (name, unit in SI), else the default in SI."""
    values = (params[name] * unit for name, unit in names if isfinite(params.get(name, float("nan"))))
    return next(values, default)


def make_leg(kind: int, point: np.ndarray, **columns: float) -> np.ndarray:
    """Return a leg that belongs to no mission item, (N_COLUMNS,); `columns`: radius [m], turns."""
    leg = np.zeros(N_COLUMNS)
    leg[KIND], leg[P_N : P_D + 1], leg[SEQ] = kind, point, NO_ITEM
    leg[RADIUS], leg[TURNS] = columns.get("radius", 0.0), columns.get("turns", 0.0)
    return leg


def _route(situation: ModeSituation, *legs: np.ndarray, remark: str = "") -> Route:
    rows = np.array(legs) if legs else np.empty((0, N_COLUMNS))
    return Route(situation.origin, rows, np.full(3, np.nan), (remark,) if remark else ())


def _circle_at_target(situation: ModeSituation, params: Mapping[str, float]) -> Route:
    """Circle about the reported target, else about the point where the mode was entered."""
    centre = situation.entry if situation.target is None else situation.target
    return _route(situation, make_leg(LOITER_UNLIMITED, centre))


def _no_home(situation: ModeSituation) -> Route:
    return _route(situation, remark="home position unknown: no prediction of the return; request HOME_POSITION")


def _arduplane_return(situation: ModeSituation, params: Mapping[str, float]) -> Route:
    """Fly to home or to the reported target, then circle; with RTL_AUTOLAND the landing sequence follows.

    RTL_AUTOLAND 1: at home; 2: at once.
    """
    centre = situation.target
    if centre is None:
        if situation.home is None:
            return _no_home(situation)
        height = _parameter(params, (("RTL_ALTITUDE", 1.0), ("ALT_HOLD_RTL", 0.01)), 100.0)
        centre = situation.home.copy()
        centre[2] = situation.home[2] - height if height >= 0 else situation.entry[2]
    radius = _parameter(params, (("RTL_RADIUS", 1.0),), 0.0)
    autoland = params.get("RTL_AUTOLAND", 0)
    near = situation.entry if autoland == 2 else centre
    landing = _landing_legs(situation, params, near) if autoland in (1, 2) else ()
    if autoland == 2 and len(landing):
        return _route(situation, *landing)
    # a return, which proceeds as soon as it circles near its altitude, without regard to the direction of the landing
    circle = make_leg(LOITER_UNLIMITED, centre, radius=radius, turns=float(len(landing) > 0))
    return _route(situation, circle, *landing)


def _landing_legs(situation: ModeSituation, params: Mapping[str, float], near: np.ndarray) -> np.ndarray:
    """Return the legs from the DO_LAND_START on that is nearest to a point, NED, (3,) [m]; (k, N_COLUMNS)."""
    items = {item.seq: item for item in situation.items}
    lat_lon = np.array([(item.lat_e7, item.lon_e7) for item in situation.items], float).reshape(-1, 2)
    positions = to_ned(situation.origin, lat_lon[:, 0], lat_lon[:, 1], np.zeros(len(lat_lon)))
    start = nearest_landing(items, dict(zip(items, positions, strict=True)), near, 0)
    if start < 0:
        return np.empty((0, N_COLUMNS))
    return unroll_route(situation.items, seq=start, origin=situation.origin, params=params).legs


def _arduplane_takeoff(situation: ModeSituation, params: Mapping[str, float]) -> Route:
    """Circle at TKOFF_DIST ahead of the take-off point, TKOFF_ALT above it."""
    if situation.target is not None:
        return _route(situation, make_leg(LOITER_UNLIMITED, situation.target))
    distance, height = (_parameter(params, ((name, 1.0),), x) for name, x in (("TKOFF_DIST", 200), ("TKOFF_ALT", 50)))
    ahead = [distance * cos(situation.course), distance * sin(situation.course), -height]
    return _route(situation, make_leg(LOITER_UNLIMITED, situation.entry + ahead))


def _arduplane_circle(situation: ModeSituation, params: Mapping[str, float]) -> Route:
    """Hold a third of the bank limit, at the height of the entry."""
    limit = _parameter(params, (("ROLL_LIMIT_DEG", 1.0), ("LIM_ROLL_CD", 0.01)), 45.0)
    return _route(situation, make_leg(CONSTANT_BANK, situation.entry, turns=radians(limit / 3.0)))


def _hold_course(situation: ModeSituation, params: Mapping[str, float]) -> Route:
    """Fly the course of the entry: the line through the entry."""
    ahead = np.array([cos(situation.course), sin(situation.course), 0.0])
    route = _route(situation, make_leg(WAYPOINT, situation.entry + _HOLD_LEG_M * ahead))
    return Route(route.origin, route.legs, situation.entry, route.sentences)


def after_steering(situation: ModeSituation, course: float, bank: float, height_error: float) -> ModeSituation | None:
    """Return the situation of a heading-hold mode after stick inputs: the pilot may select another course and height.

    Args:
        situation: of the mode change
        course, bank: present [rad]
        height_error: reported set-point minus height; nan: not reported [m]
    Returns:
        situation with the course and height that are held; None while the pilot steers
    """
    offset = situation.position - situation.entry
    crosstrack = offset[1] * cos(situation.course) - offset[0] * sin(situation.course)
    steered = abs(crosstrack) > _STEERED_M or abs(wrap(course - situation.course)) > _STEERED_RAD
    if steered and abs(bank) > _STEERING_BANK:
        return None
    entry = (situation.position if steered else situation.entry).copy()
    if isfinite(height_error):
        entry[2] = situation.position[2] - height_error
    return replace(situation, entry=entry, course=course if steered else situation.course)


def _px4_return(situation: ModeSituation, params: Mapping[str, float]) -> Route:
    """Climb to RTL_RETURN_ALT in a circle, fly home, descend to RTL_DESCEND_ALT in a circle, and stay there."""
    home, here = situation.home, situation.entry
    kind = int(_parameter(params, (("RTL_TYPE", 1.0),), 0.0))
    lands = any(item.command in _PX4_LANDINGS for item in situation.items)
    if kind in _PX4_BY_MISSION or (kind in _PX4_ANY_LANDING and lands):
        return _route(
            situation, remark=f"RTL_TYPE {kind}: the return by the mission or to its landing is not predicted"
        )
    if home is None:
        target = situation.target
        return _no_home(situation) if target is None else _route(situation, make_leg(LOITER_UNLIMITED, target))
    radius = _parameter(params, (("RTL_LOITER_RAD", 1.0),), 80.0)
    cruise_d = min(home[2] - _parameter(params, (("RTL_RETURN_ALT", 1.0),), 60.0), situation.entry[2])
    circle = home.copy()
    circle[2] = home[2] - _parameter(params, (("RTL_DESCEND_ALT", 1.0),), 30.0)
    legs = [make_leg(LOITER_UNLIMITED, circle, radius=radius)]
    if hypot(*(here - home)[:2]) > 2.0 * abs(radius):
        legs.insert(0, make_leg(WAYPOINT, np.array([*home[:2], cruise_d])))
        climbs = here[2] - cruise_d > _parameter(params, (("NAV_FW_ALT_RAD", 1.0),), 10.0)
        at_home = situation.target is not None and hypot(*(situation.target - home)[:2]) < _TARGET_TOLERANCE_M
        if climbs and not at_home:
            centre = situation.entry if situation.target is None else situation.target
            legs.insert(0, make_leg(LOITER_TO_ALT, np.array([*centre[:2], cruise_d])))
    stays = _parameter(params, (("RTL_LAND_DELAY", 1.0),), -1.0) < 0
    return _route(situation, *legs, remark="" if stays else "the landing after the return is not predicted")


def hold_bank(situation: ModeSituation, bank: float) -> Route:
    """Hold a bank [rad] at the height of the entry."""
    return _route(situation, make_leg(CONSTANT_BANK, situation.entry, turns=bank))


def _level_flight(situation: ModeSituation, params: Mapping[str, float]) -> Route:
    """Fly wings level at the height of the entry and at minimum airspeed: FBWB without remote control."""
    route = hold_bank(situation, 0.0)
    route.legs[0, VA_C] = _parameter(params, (("AIRSPEED_MIN", 1.0), ("ARSPD_FBW_MIN", 1.0)), 9.0)
    return route


def _glide(situation: ModeSituation, params: Mapping[str, float]) -> Route:
    """Glide wings level at idle: FBWA without remote control.

    The pitch is 0 where the short action is this glide, else neutral sticks and idle: nose down by STAB_PITCH_DOWN.
    """
    demands_glide = params.get("FS_SHORT_ACTN") == _SHORT_GLIDE and params.get("THR_FAILSAFE") == 1
    pitch = 0.0 if demands_glide else -radians(_parameter(params, (("STAB_PITCH_DOWN", 1.0),), 2.0))
    return _route(situation, make_leg(GLIDE, situation.entry, radius=pitch))


FAILSAFE_MODES: dict[str, dict[str, _Rule]] = {"arduplane": {"FBWA": _glide, "FBWB": _level_flight}}
"""Further rules of modes that are flown by hand, where a failsafe selects them."""
MODES: dict[str, dict[str, _Rule]] = {
    "arduplane": {
        "RTL": _arduplane_return,
        "LOITER": _circle_at_target,
        "GUIDED": _circle_at_target,
        "AVOID_ADSB": _circle_at_target,
        "TAKEOFF": _arduplane_takeoff,
        "CIRCLE": _arduplane_circle,
        "CRUISE": _hold_course,
    },
    "px4": {
        "LOITER": _circle_at_target,
        "RTL": _px4_return,
        "TAKEOFF": _circle_at_target,
    },
}
"""Rules by law, as in `fleet.autopilots.laws.LAWS`, and mode, as in `Status.mode`."""
HEADING_HOLD_MODES = ("CRUISE",)
"""Modes that hold course and height until the pilot steers."""
COURSE_LOCK_S = 0.5
"""Time with level wings after which ArduPlane locks the course of a heading-hold mode [s]."""
TARGET_MODES = ("RTL", "LOITER", "GUIDED", "AVOID_ADSB", "TAKEOFF")
"""Modes whose reported guidance target is the point they fly to."""


def mode_route(
    law: str, mode: str, situation: ModeSituation, params: Mapping[str, float], *, failsafe: bool = False
) -> Route | None:
    """Return the route of a mode without mission; None for a mode that is flown by hand or not known.

    Args:
        law: name in `MODES`
        mode: as in `Status.mode`
        situation: where the mode was entered, and what is reported
        params: autopilot parameters in the autopilot's names and units
        failsafe: selected by a failsafe, without remote control
    Returns:
        route without mission items; without legs and with a remark where something is missing
    """
    rule = (FAILSAFE_MODES.get(law, {}).get(mode) if failsafe else None) or MODES.get(law, {}).get(mode)
    return None if rule is None else rule(situation, params)
