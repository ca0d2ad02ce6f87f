"""Route: convert MAVLink mission items to the legs that a compiled controller reads.

A leg is one row of float64; the columns are named below, the first one is the leg type:

    WAYPOINT         fly the line from the previous point to here, then continue
    LOITER_TURNS     circle `TURNS` times, exit towards the next leg
    LOITER_UNLIMITED circle indefinitely
    LOITER_TIME      circle for `TURNS` seconds
    LOITER_TO_ALT    circle until the altitude is reached
    TAKEOFF          climb wings level to the altitude
    LAND             fly to the point; no leg follows automatically

Item 0 is home (ArduPilot), or the first to fly (PX4, whose mission does not contain home). MAVLink does not report how
often a DO_JUMP was already taken: the count starts at zero.
Source: MAVLink mission protocol, MAV_CMD and MAV_FRAME; ArduPlane mission command list.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import hypot, isfinite

import numpy as np

from fleet.contract import MAX_ITEMS, Item
from fleet.frames import Origin, to_ned

WAYPOINT, LOITER_TURNS, LOITER_UNLIMITED, LOITER_TIME, LOITER_TO_ALT, TAKEOFF, LAND = range(7)
KIND = 0  # leg type, one of the seven above
P_N, P_E, P_D = 1, 2, 3  # target, or centre of the circle, NED from the route's origin [m]
RADIUS = 4  # radius of the circle, positive clockwise; 0: the autopilot's WP_LOITER_RAD [m]
TURNS = 5  # turns; seconds for LOITER_TIME
VA_C = 6  # commanded airspeed; <= 0: cruise [m/s]
ACCEPT = 7  # acceptance radius; 0: from the parameters; negative: pass by at that distance [m]; of a circle: 1: exit
# only towards the next leg (PX4; ArduPlane always does)
SEQ = 8  # mission item of this leg; -1: return to launch after the last one
N_COLUMNS = 9

NAMES = ("waypoint", "loiter turns", "loiter", "loiter time", "loiter to altitude", "takeoff", "land")
_KINDS = {16: WAYPOINT, 17: LOITER_UNLIMITED, 18: LOITER_TURNS, 19: LOITER_TIME, 20: LOITER_UNLIMITED}
_KINDS |= {21: LAND, 22: TAKEOFF, 31: LOITER_TO_ALT, 82: WAYPOINT, 84: TAKEOFF, 85: LAND}
_RETURN, _LAST_NAV, _JUMP, SPEED = 20, 95, 177, 178  # MAV_CMD: RETURN_TO_LAUNCH, NAV_LAST, DO_JUMP, DO_CHANGE_SPEED
_ABSOLUTE, _RELATIVE, _TERRAIN = (0, 5), (3, 6), (10, 11)  # MAV_FRAME
GLOBAL_FRAMES = _ABSOLUTE + _RELATIVE + _TERRAIN
_SHORTEST = 1.0  # a shorter leg has no usable direction [m]
FIRST = {"px4": 0}  # number of the first item to fly, by autopilot; 1 elsewhere
READ = ("RTL_ALTITUDE", "ALT_HOLD_RTL", "RTL_RADIUS", "WP_LOITER_RAD")
"""Autopilot parameters that shape a route."""
_SAID = 3  # remarks reported of one mission
_FAR = 500e3  # a longer leg is an input error, and flat earth does not give its direction [m]
_FASTEST = 300.0  # higher commanded speeds are input errors [m/s]
_HIGHEST = 1e5  # higher altitudes are input errors [m]
_RTL_ALTITUDE = 100.0  # ArduPlane's default RTL_ALTITUDE [m]


@dataclass(frozen=True)
class Route:
    """Legs that an aircraft is going to fly."""

    origin: Origin
    legs: np.ndarray  # (n, 9) float64, columns above, NED [m]
    start: np.ndarray  # (3,) the navigation point before legs[0], NED [m]; nan: start at the aircraft's position
    sentences: tuple[str, ...] = ()  # errors in the mission and their handling

    @property
    def said(self) -> str:
        """Return the first remarks and the number of further ones; empty for a mission without errors."""
        return few(self.sentences)

    def __str__(self) -> str:
        kinds = Counter(NAMES[int(kind)] for kind in self.legs[:, KIND])
        what = ", ".join(f"{n} {name}" for name, n in kinds.items()) or "nothing to fly"
        first = f" from item {int(self.legs[0, SEQ])}" if len(self.legs) else ""
        return f"route of {len(self.legs)} legs{first}: {what}; {len(self.sentences)} remarks"


@dataclass
class _Walk:
    """State of the traversal of the mission items."""

    items: dict[int, Item]
    first: int  # number of the first item to fly; item 0 before it is home
    last: int  # highest sequence number
    origin: Origin
    params: Mapping[str, float]
    home: np.ndarray  # (3,) NED [m]
    point: np.ndarray  # (3,) the last navigation point passed, NED [m]
    places: dict[int, np.ndarray] = field(default_factory=dict)  # of every item, NED except the height, (3,) [m]
    kind: int = TAKEOFF  # type of the leg that ended there; no line starts at home
    speed: float = 0.0  # commanded airspeed; 0: cruise [m/s]
    left: dict[int, float] = field(default_factory=dict)  # jumps left at each DO_JUMP
    taken: set[int] = field(default_factory=set)  # jumps taken since the last leg
    legs: list[np.ndarray] = field(default_factory=list)
    sentences: dict[str, None] = field(default_factory=dict)  # an ordered set

    def say(self, sentence: str) -> None:
        """Add a remark, once."""
        self.sentences.setdefault(sentence)


def few(sentences: Sequence[str]) -> str:
    """Join the first remarks, and state the number of further ones."""
    more = len(sentences) - _SAID
    return " ".join([*sentences[:_SAID], *([f"and {more} more remarks on the mission"] if more > 0 else [])])


def route(
    items: Sequence[Item], *, seq: int, origin: Origin, params: Mapping[str, float], limit: int = 64, first: int = 1
) -> Route:
    """Unroll the legs from item `seq` on: jumps, speeds and altitude frames resolved. Never raises on a bad mission.

    Args:
        items: mission as downloaded, in any order
        seq: current item
        origin: of the NED frame of the legs
        params: autopilot parameters, of which those in `ROUTE_PARAMS` are used
        limit: maximum number of legs
        first: 1 where item 0 is home, 0 where it is the first to fly; home is the origin then. See `FIRST_ITEM`
    Returns:
        legs, the point before them, and one remark per error
    """
    walk = _begin(items, origin, params, first)
    at = _arrive(walk, _first(walk, seq))
    # after a circle or a takeoff ArduPlane starts the line at the aircraft's position
    start = walk.point.copy() if walk.kind in (WAYPOINT, LAND) else np.full(3, np.nan)
    walk.legs = []
    if walk.last >= walk.first and walk.items:
        _unroll(walk, at, limit)
    legs = np.array(walk.legs[:limit]) if walk.legs[:limit] else np.empty((0, N_COLUMNS))
    return Route(origin, legs, start, tuple(walk.sentences))


def _begin(items: Sequence[Item], origin: Origin, params: Mapping[str, float], first: int) -> _Walk:
    kept = {item.seq: item for item in items if 0 <= item.seq < MAX_ITEMS}
    walk = _Walk(kept, first, max(kept, default=0), origin, params, np.zeros(3), np.zeros(3))
    if any(not 0 <= item.seq < MAX_ITEMS for item in items):
        walk.say(f"mission: found {len(items)} items, expected at most {MAX_ITEMS}; used the first, shorten it")
    if walk.last < first or not kept:
        wanted = "home and at least one more" if first else "at least one"
        walk.say(f"mission: found {len(items)} items, expected {wanted}; nothing to fly, upload a mission")
        return walk
    lost = walk.last + 1 - len(kept)
    if lost:
        walk.say(f"mission: found {len(kept)} of {walk.last + 1} items; skipped {lost}, download the mission again")
    walk.home = walk.point = _home(walk) if first else np.zeros(3)
    lat, lon = (np.array([getattr(item, name) for item in kept.values()], float) for name in ("lat_e7", "lon_e7"))
    walk.places = dict(zip(kept, to_ned(origin, lat, lon, np.zeros(len(lat))), strict=True))
    return walk


def _home(walk: _Walk) -> np.ndarray:
    item = walk.items.get(0)
    if item is None or _fault(item) or _nowhere(item):
        walk.say("mission item 0: found no usable position, expected home; used the origin, set home and upload again")
        return np.zeros(3)
    return _ned(walk.origin, item, item.alt_m)


def _ned(origin: Origin, item: Item, altitude: float) -> np.ndarray:
    return to_ned(origin, np.array([item.lat_e7]), np.array([item.lon_e7]), np.array([altitude * 1e3]))[0]


def _fault(item: Item) -> str:
    """Describe the error in a position; empty for a valid one. A nan fails every comparison."""
    if not abs(item.lat_e7) <= 9e8:
        return f"latitude {item.lat_e7} (1e-7 deg), expected within 90 deg"
    if not abs(item.lon_e7) <= 1.8e9:
        return f"longitude {item.lon_e7} (1e-7 deg), expected within 180 deg"
    if not abs(item.alt_m) <= _HIGHEST:
        return f"altitude {item.alt_m}, expected within {_HIGHEST:.0f} m"
    if item.frame not in GLOBAL_FRAMES:
        return f"frame {item.frame}, expected one of {GLOBAL_FRAMES}"
    return ""


def _nowhere(item: Item) -> bool:
    return item.lat_e7 == 0 and item.lon_e7 == 0


def _number(value: float, otherwise: float = 0.0) -> float:
    return value if isfinite(value) else otherwise


def _first(walk: _Walk, seq: int) -> int:
    if walk.last >= walk.first and not 0 <= seq <= walk.last:
        began = f"started at {walk.first}, request MISSION_CURRENT"
        walk.say(f"mission: found current item {seq}, expected 0..{walk.last}; {began}")
        return walk.first
    return max(seq, walk.first)


def _arrive(walk: _Walk, seq: int) -> int:
    """Advance to `seq` on the shortest path, to obtain the active speed, the previous point and the used jumps."""
    at = walk.first
    while at < seq:
        item = walk.items.get(at)
        if item is not None and item.command == _JUMP:
            target = _target(walk, item)
            count = _number(item.param2)
            if at < target <= seq and count != 0:
                walk.left[at] = count - 1 if count > 0 else count
                at = target
                continue
            if count > 0:
                walk.left[at] = 0.0  # the aircraft has passed it
        elif item is not None:
            _visit(walk, item)
        at += 1
    return at


def _unroll(walk: _Walk, at: int, limit: int) -> None:
    """Append the legs from item `item_seq` on; return to launch follows the last item."""
    while at <= walk.last and len(walk.legs) < limit:
        item = walk.items.get(at)
        jump = item is not None and item.command == _JUMP
        if item is not None and not jump:
            _visit(walk, item)
        at = _jump(walk, item) if item is not None and jump else at + 1
    if len(walk.legs) < limit and not _ends(walk):
        walk.legs.append(_return(walk))


def _ends(walk: _Walk) -> bool:
    """Return whether the last leg is one without automatic successor."""
    return bool(walk.legs) and int(walk.legs[-1][KIND]) in (LAND, LOITER_UNLIMITED)


def _target(walk: _Walk, item: Item) -> int:
    """Return the target item of a DO_JUMP; -1 when it is invalid."""
    if walk.first <= item.param1 <= walk.last:
        return int(item.param1)
    expected = f"expected {walk.first}..{walk.last}"
    walk.say(f"mission item {item.seq}: found jump to {item.param1}, {expected}; skipped, upload again")
    return -1


def _jump(walk: _Walk, item: Item) -> int:
    """Take a DO_JUMP while jumps remain, and return the next sequence number."""
    target = _target(walk, item)
    left = walk.left.get(item.seq, _number(item.param2))
    if target < 0 or left == 0:
        return item.seq + 1
    if item.seq in walk.taken:
        walk.say(f"mission item {item.seq}: found a jump loop without a leg; left the loop, add a waypoint inside it")
        return item.seq + 1
    walk.taken.add(item.seq)
    walk.left[item.seq] = left - 1 if left > 0 else left
    return target


def _visit(walk: _Walk, item: Item) -> None:
    """Apply one item other than DO_JUMP: change the speed, add a leg, or add a remark."""
    if item.command == SPEED:
        _change_speed(walk, item)
    elif item.command in _KINDS:
        _add(walk, item)
    elif item.command < _LAST_NAV:
        walk.say(f"mission item {item.seq}: found unsupported command {item.command}; skipped, use another item")


def _change_speed(walk: _Walk, item: Item) -> None:
    if item.param2 == -2:  # MAVLink: return to the default
        walk.speed = 0.0
    if not (isfinite(item.param2) and item.param2 > 0):
        return
    if item.param2 > _FASTEST:
        found = f"found a speed of {item.param2:g} m/s, expected at most {_FASTEST:.0f}"
        walk.say(f"mission item {item.seq}: {found}; used the previous speed, correct it")
        return
    walk.speed = item.param2
    if item.param1 == 1:
        walk.say(f"mission item {item.seq}: found a ground speed, expected an airspeed; used as airspeed, set type 0")


def _add(walk: _Walk, item: Item) -> None:
    """Add the leg of a navigation item, unless it is invalid or of zero length."""
    if item.command == _RETURN:
        walk.legs.append(_return(walk))
        walk.legs[-1][SEQ] = item.seq
        walk.point, walk.kind = walk.legs[-1][P_N : P_D + 1], LOITER_UNLIMITED
        walk.taken.clear()
        return
    fault = _fault(item)
    if fault:
        walk.say(f"mission item {item.seq}: found {fault}; skipped, upload a corrected mission")
        return
    kind = _KINDS[item.command]
    target = _point(walk, item)
    length = hypot(*(target - walk.point)[:2])
    if length > _FAR:
        found = f"found {length * 1e-3:,.0f} km from the previous point, expected {_FAR * 1e-3:.0f} km at most"
        walk.say(f"mission item {item.seq}: {found}; used as it is, check its position")
    near = length < _SHORTEST
    if near and kind == WAYPOINT == walk.kind and (walk.legs or not _nowhere(item)):
        walk.say(f"mission item {item.seq}: found a leg of zero length, expected {_SHORTEST:.0f} m; skipped, remove it")
        return
    walk.legs.append(_leg(walk, item, kind, target))
    walk.point, walk.kind = target, kind
    walk.taken.clear()


def _point(walk: _Walk, item: Item) -> np.ndarray:
    """Return the position of an item, NED (3,) [m]; zero latitude and longitude mean the current position."""
    if item.frame in _TERRAIN:
        walk.say(
            f"mission item {item.seq}: found altitude above terrain; used as above home, specify it relative to home"
        )
    absolute = item.frame in _ABSOLUTE
    altitude = item.alt_m + (0.0 if absolute else walk.origin.alt_mm * 1e-3 - walk.home[2])
    point = walk.places[item.seq].copy()
    point[2] = walk.origin.alt_mm * 1e-3 - altitude
    if _nowhere(item):
        point[:2] = walk.point[:2]
    return point


def _leg(walk: _Walk, item: Item, kind: int, target: np.ndarray) -> np.ndarray:
    leg = np.zeros(N_COLUMNS)
    leg[KIND], leg[P_N : P_D + 1], leg[VA_C], leg[SEQ] = kind, target, walk.speed, item.seq
    if kind == WAYPOINT:
        past = _number(item.param3)
        leg[ACCEPT] = -past if past > 0 else max(_number(item.param2), 0.0)
    elif kind in (LOITER_TURNS, LOITER_TIME):
        leg[TURNS] = max(_number(item.param1), 0.0)
    if kind in (LOITER_TURNS, LOITER_UNLIMITED):
        leg[RADIUS] = _number(item.param3)
    elif kind == LOITER_TO_ALT:
        leg[RADIUS] = _number(item.param2)
    elif kind == LOITER_TIME and not walk.first:
        leg[RADIUS] = _number(item.param3)
    elif kind == LOITER_TIME and _number(item.param3) < 0:  # ArduPlane reads the direction only
        leg[RADIUS] = -abs(_number(walk.params.get("WP_LOITER_RAD", 60.0), 60.0))
    if not walk.first and kind in (LOITER_TIME, LOITER_TO_ALT):
        heading = item.param2 if kind == LOITER_TIME else item.param1
        leg[ACCEPT] = float(_number(heading) > 0)
    return leg


def _return(walk: _Walk) -> np.ndarray:
    """Return the leg after the last item: ArduPlane circles over home at RTL_ALTITUDE, PX4 at its position."""
    leg = np.zeros(N_COLUMNS)
    if not walk.first:
        leg[KIND], leg[SEQ], leg[P_N : P_D + 1] = LOITER_UNLIMITED, -1, walk.point
        return leg
    height = walk.params.get("RTL_ALTITUDE", walk.params.get("ALT_HOLD_RTL", 100.0 * _RTL_ALTITUDE) / 100.0)
    height = _number(height, _RTL_ALTITUDE)
    leg[KIND], leg[SEQ] = LOITER_UNLIMITED, -1
    leg[P_N : P_D + 1] = walk.home
    leg[P_D] = walk.home[2] - height if height >= 0 else walk.point[2]  # negative: stay at this altitude
    leg[RADIUS] = _number(walk.params.get("RTL_RADIUS", 0.0))
    return leg
