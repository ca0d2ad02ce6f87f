"""Route: convert MAVLink mission items to the legs that a compiled controller reads.

The columns and types of legs are those of `fleet.mission_legs`.

Item 0 is home (ArduPilot), or the first to fly (PX4, whose mission does not contain home). MAVLink does not report how
often a DO_JUMP was already taken; `fleet.mission_jumps` counts it from the reported items.
Source: MAVLink mission protocol, MAV_CMD and MAV_FRAME; ArduPlane mission command list. Every command and how it is
flown is listed in `docs/mission-commands.md`.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import hypot

import numpy as np

from fleet.contract import MAX_ITEMS, Item, Mission
from fleet.frames import Origin, to_ned
from fleet.mission_jumps import JUMPS, jump_target, nearest_landing, repetitions, resets_counters
from fleet.mission_legs import (  # noqa: F401 - also for users of routes
    ABSOLUTE,
    ACCEPT_RADIUS,
    CHANGE_ALTITUDE,
    CONSTANT_BANK,
    GLIDE,
    GLOBAL_FRAMES,
    KIND,
    KINDS,
    LAND,
    LEG_NAMES,
    LOITER_TIME,
    LOITER_TO_ALT,
    LOITER_TURNS,
    LOITER_UNLIMITED,
    N_COLUMNS,
    P_D,
    P_E,
    P_N,
    RADIUS,
    SEQ,
    TAKEOFF,
    TERRAIN,
    TURNS,
    VA_C,
    WAYPOINT,
    commanded_airspeed,
    finite,
    is_zero_position,
    line_starts_at_target,
    make_leg,
    position_error,
)

# MAV_CMD: RETURN_TO_LAUNCH, NAV_CONTINUE_AND_CHANGE_ALT, NAV_DELAY, NAV_LAST, DO_CHANGE_SPEED, DO_SET_HOME
_RETURN, _CHANGE_ALTITUDE, _DELAY, _LAST_NAV, SPEED, _SET_HOME = 20, 30, 93, 95, 178, 179
_MIN_LEG = 1.0  # a shorter leg has no usable direction [m]
FIRST_ITEM = {"px4": 0}  # number of the first item to fly, by autopilot; 1 elsewhere
ROUTE_PARAMS = (
    *("RTL_ALTITUDE", "ALT_HOLD_RTL", "RTL_RADIUS", "RTL_AUTOLAND", "WP_LOITER_RAD", "MIS_OPTIONS"),
    *("AIRSPEED_MIN", "ARSPD_FBW_MIN", "AIRSPEED_MAX", "ARSPD_FBW_MAX"),
)
"""Autopilot parameters that shape a route."""
_UNKNOWN = -1  # command of the item after the last known one
_MAX_REMARKS = 3  # remarks reported of one mission
_MAX_LEG = 500e3  # a longer leg is an input error, and flat earth does not give its direction [m]
_RTL_ALTITUDE = 100.0  # ArduPlane's default RTL_ALTITUDE [m]


@dataclass(frozen=True)
class Route:
    """Legs that an aircraft is going to fly."""

    origin: Origin
    legs: np.ndarray  # (n, 9) float64, columns above, NED [m]
    start: np.ndarray  # (3,) the navigation point before legs[0], NED [m]; nan: start at the aircraft's position
    sentences: tuple[str, ...] = ()  # errors in the mission and their handling

    @property
    def summary(self) -> str:
        """Return the first remarks and the number of further ones; empty for a mission without errors."""
        return join_remarks(self.sentences)

    def __str__(self) -> str:
        kinds = Counter(LEG_NAMES[int(kind)] for kind in self.legs[:, KIND])
        legs_text = ", ".join(f"{n} {name}" for name, n in kinds.items()) or "nothing to fly"
        first = f" from item {int(self.legs[0, SEQ])}" if len(self.legs) else ""
        return f"route of {len(self.legs)} legs{first}: {legs_text}; {len(self.sentences)} remarks"


@dataclass
class _RouteBuilder:
    """State of the traversal of the mission items."""

    items: dict[int, Item]
    first: int  # number of the first item to fly; item 0 before it is home
    last: int  # highest sequence number
    origin: Origin
    params: Mapping[str, float]
    home: np.ndarray  # (3,) NED [m]
    last_point: np.ndarray  # (3,) the last navigation point passed, NED [m]
    positions: dict[int, np.ndarray] = field(default_factory=dict)  # of every item, NED except the height, (3,) [m]
    last_leg: np.ndarray | None = None  # the leg that ended there; None: no line starts at home
    return_from: np.ndarray = field(default_factory=lambda: np.zeros(3))  # start of the last return, NED (3,) [m]
    speed: float = 0.0  # commanded airspeed; 0: cruise [m/s]
    jumps_left: dict[int, float] = field(default_factory=dict)  # jumps left at each DO_JUMP
    jumps_taken: set[int] = field(default_factory=set)  # jumps taken since the last leg
    legs: list[np.ndarray] = field(default_factory=list)
    sentences: dict[str, None] = field(default_factory=dict)  # an ordered set

    def remark(self, sentence: str) -> None:
        """Add a remark, once."""
        self.sentences.setdefault(sentence)


def join_remarks(sentences: Sequence[str]) -> str:
    """Join the first remarks, and state the number of further ones."""
    n_more = len(sentences) - _MAX_REMARKS
    return " ".join([*sentences[:_MAX_REMARKS], *([f"and {n_more} more remarks on the mission"] if n_more > 0 else [])])


def route_items(mission: Mission | None) -> tuple[Item, ...]:
    """Return the items of a mission; an incomplete one ends in an item that `unroll_route` treats as unknown."""
    if mission is None or mission.complete or not mission.items:
        return mission.items if mission else ()
    next_seq = max(item.seq for item in mission.items) + 1
    return (*mission.items, Item(seq=next_seq, command=_UNKNOWN)) if 0 < next_seq < MAX_ITEMS else mission.items


def extends(items: Sequence[Item], known: Sequence[Item]) -> bool:
    """Return whether `items` contain all `known` ones unchanged: more of the same mission has arrived."""
    by_seq = {item.seq: item for item in items}
    return bool(known) and all(by_seq.get(item.seq) == item for item in known)


def unroll_route(
    items: Sequence[Item],
    *,
    seq: int,
    origin: Origin,
    params: Mapping[str, float],
    limit: int = 64,
    first: int = 1,
    jumps_taken: Mapping[int, int] | None = None,
) -> Route:
    """Unroll the legs from item `seq` on: jumps, speeds and altitude frames resolved. Never raises on a bad mission.

    Args:
        items: mission as downloaded, in any order
        seq: current item
        origin: of the NED frame of the legs
        params: autopilot parameters, of which those in `ROUTE_PARAMS` are used
        limit: maximum number of legs
        first: 1 where item 0 is home, 0 where it is the first to fly; home is the origin then. See `FIRST_ITEM`
        jumps_taken: jumps taken so far at each jump, as of `fleet.mission_jumps`; unknown jumps: the fewest
    Returns:
        legs, the point before them, and one remark per error
    """
    builder = _make_builder(items, origin, params, first)
    item_seq = _advance_to(builder, _first_seq(builder, seq))
    for number, count in (jumps_taken or {}).items():
        times = repetitions(builder.items[number]) if number in builder.items else 0.0
        builder.jumps_left[number] = max(times - count, 0.0) if times > 0 else times
    on_line = line_starts_at_target(builder.last_leg, home_first=first > 0)
    start = builder.last_point.copy() if on_line else np.full(3, np.nan)
    builder.legs = []
    if builder.last >= builder.first and builder.items:
        _append_legs(builder, item_seq, limit)
    legs = np.array(builder.legs[:limit]) if builder.legs[:limit] else np.empty((0, N_COLUMNS))
    return Route(origin, legs, start, tuple(builder.sentences))


def _make_builder(items: Sequence[Item], origin: Origin, params: Mapping[str, float], first: int) -> _RouteBuilder:
    by_seq = {item.seq: item for item in items if 0 <= item.seq < MAX_ITEMS}
    builder = _RouteBuilder(by_seq, first, max(by_seq, default=0), origin, params, np.zeros(3), np.zeros(3))
    if any(not 0 <= item.seq < MAX_ITEMS for item in items):
        builder.remark(f"mission: found {len(items)} items, expected at most {MAX_ITEMS}; used the first, shorten it")
    if builder.last < first or not by_seq:
        expected = "home and at least one more" if first else "at least one"
        builder.remark(f"mission: found {len(items)} items, expected {expected}; nothing to fly, upload a mission")
        return builder
    n_missing = builder.last + 1 - len(by_seq)
    if n_missing:
        builder.remark(f"mission: found {len(by_seq)} of {builder.last + 1} items; download the mission again")
    builder.home = builder.last_point = _home(builder) if first else np.zeros(3)
    lat, lon = (np.array([getattr(item, name) for item in by_seq.values()], float) for name in ("lat_e7", "lon_e7"))
    builder.positions = dict(zip(by_seq, to_ned(origin, lat, lon, np.zeros(len(lat))), strict=True))
    return builder


def _home(builder: _RouteBuilder) -> np.ndarray:
    item = builder.items.get(0)
    if item is None or position_error(item) or is_zero_position(item):
        builder.remark(
            "mission item 0: found no usable position, expected home; used the origin, set home and upload again"
        )
        return np.zeros(3)
    return _ned(builder.origin, item, item.alt_m)


def _ned(origin: Origin, item: Item, altitude: float) -> np.ndarray:
    return to_ned(origin, np.array([item.lat_e7]), np.array([item.lon_e7]), np.array([altitude * 1e3]))[0]


def _first_seq(builder: _RouteBuilder, seq: int) -> int:
    if builder.last >= builder.first and not 0 <= seq <= builder.last:
        fallback = f"started at {builder.first}, request MISSION_CURRENT"
        builder.remark(f"mission: found current item {seq}, expected 0..{builder.last}; {fallback}")
        return builder.first
    return max(seq, builder.first)


def _advance_to(builder: _RouteBuilder, seq: int) -> int:
    """Advance to `seq` on the shortest path, to obtain the active speed, the previous point and the used jumps."""
    item_seq = builder.first
    while item_seq < seq:
        item = builder.items.get(item_seq)
        if item is not None and item.command in JUMPS:
            target = _jump_target(builder, item)
            count = repetitions(item)
            if item_seq < target <= seq and count != 0:
                builder.jumps_left[item_seq] = count - 1 if count > 0 else count
                item_seq = target
                continue
            if count > 0 and not resets_counters(builder.params, builder.first):
                builder.jumps_left[item_seq] = 0.0  # the aircraft has passed it
        elif item is not None:
            _apply_item(builder, item)
        else:
            builder.last_leg = None  # the line to the next item starts at an unknown point
        item_seq += 1
    return item_seq


def _append_legs(builder: _RouteBuilder, item_seq: int, limit: int) -> None:
    """Append the legs from item `item_seq` on; return to launch follows the last item, a circle the last known one."""
    while item_seq <= builder.last and len(builder.legs) < limit:
        item = builder.items.get(item_seq)
        if item is None and not builder.legs:  # the current item itself is missing: the next known one is flown to
            item_seq += 1
            continue
        if item is None or item.command == _UNKNOWN:
            _append_hold(builder, item_seq)
            return
        is_jump = item.command in JUMPS
        if not is_jump:
            _apply_item(builder, item)
        item_seq = _seq_after_jump(builder, item) if is_jump else item_seq + 1
        if item_seq > builder.last and not _is_final(builder):
            builder.legs.append(_return_leg(builder))
        if item_seq > builder.last or item.command == _RETURN:
            item_seq = _seq_after_return(builder)


def _append_hold(builder: _RouteBuilder, item_seq: int) -> None:
    """Append a circle at the last known point: no one knows what follows."""
    builder.remark(
        f"mission item {item_seq}: not received, expected every item; predicted up to the one before, "
        "download the mission again"
    )
    if builder.legs and not _is_final(builder):
        leg = np.zeros(N_COLUMNS)
        leg[KIND], leg[SEQ], leg[P_N : P_D + 1] = LOITER_UNLIMITED, -1, builder.last_point
        builder.legs.append(leg)


def _is_final(builder: _RouteBuilder) -> bool:
    """Return whether the last leg is one without automatic successor."""
    return bool(builder.legs) and int(builder.legs[-1][KIND]) in (LAND, LOITER_UNLIMITED)


def _seq_after_return(builder: _RouteBuilder) -> int:
    """Return the item that follows the return in the last leg: the nearest landing sequence, if RTL_AUTOLAND asks."""
    after_end = builder.last + 1
    leg = builder.legs[-1] if builder.legs else None
    if leg is None or int(leg[KIND]) != LOITER_UNLIMITED or leg[TURNS] <= 0.0:
        return after_end
    landing = nearest_landing(builder.items, builder.positions, builder.return_from, builder.first)
    if landing < 0:
        leg[TURNS] = 0.0
        return after_end
    builder.speed = 0.0  # a change of mode clears the commanded airspeed
    return landing + 1


def _jump_target(builder: _RouteBuilder, item: Item) -> int:
    """Return the target item of a jump; -1 when it is invalid."""
    target = jump_target(builder.items, item, builder.first, builder.last)
    if target >= 0:
        return target
    expected = f"expected {builder.first}..{builder.last}"
    builder.remark(f"mission item {item.seq}: found jump to {item.param1}, {expected}; skipped, upload again")
    return -1


def _seq_after_jump(builder: _RouteBuilder, item: Item) -> int:
    """Take a jump while jumps remain, and return the next sequence number."""
    target = _jump_target(builder, item)
    remaining = builder.jumps_left.get(item.seq, repetitions(item))
    if target < 0 or remaining == 0:
        if resets_counters(builder.params, builder.first):
            builder.jumps_left.pop(item.seq, None)
        return item.seq + 1
    if item.seq in builder.jumps_taken:
        builder.remark(
            f"mission item {item.seq}: found a jump loop without a leg; left the loop, add a waypoint inside it"
        )
        return item.seq + 1
    builder.jumps_taken.add(item.seq)
    builder.jumps_left[item.seq] = remaining - 1 if remaining > 0 else remaining
    return target


def _apply_item(builder: _RouteBuilder, item: Item) -> None:
    """Apply one item other than DO_JUMP: change the speed, add a leg, or add a remark."""
    if item.command == SPEED:
        _change_speed(builder, item)
    elif item.command == _SET_HOME and item.param1 != 1 and not (position_error(item) or is_zero_position(item)):
        builder.home = _item_position(builder, item)
    elif item.command in KINDS and (builder.first or item.command != _CHANGE_ALTITUDE):
        _add_leg(builder, item)
    elif item.command < _LAST_NAV and not (item.command == _DELAY and builder.first):  # ends at once in flight
        builder.remark(f"mission item {item.seq}: found unsupported command {item.command}; skipped, use another item")


def _change_speed(builder: _RouteBuilder, item: Item) -> None:
    speed, problem = commanded_airspeed(item, builder.params, home_first=builder.first > 0)
    if problem:
        builder.remark(f"mission item {item.seq}: {problem}")
    builder.speed = builder.speed if speed is None else speed


def _add_leg(builder: _RouteBuilder, item: Item) -> None:
    """Add the leg of a navigation item, unless it is invalid or of zero length."""
    if item.command == _RETURN:
        builder.legs.append(_return_leg(builder))
        builder.legs[-1][SEQ] = item.seq
        builder.last_point, builder.last_leg = builder.legs[-1][P_N : P_D + 1], builder.legs[-1]
        builder.jumps_taken.clear()
        return
    error = position_error(item)
    if error:
        builder.remark(f"mission item {item.seq}: found {error}; skipped, upload a corrected mission")
        return
    kind = KINDS[item.command]
    target = _item_position(builder, item)
    if kind == CHANGE_ALTITUDE:
        target[:2] = builder.last_point[:2]
    length = hypot(*(target - builder.last_point)[:2])
    if length > _MAX_LEG:
        problem = f"found {length * 1e-3:,.0f} km from the previous point, expected {_MAX_LEG * 1e-3:.0f} km at most"
        builder.remark(f"mission item {item.seq}: {problem}; used as it is, check its position")
    is_short = length < _MIN_LEG
    last_kind = TAKEOFF if builder.last_leg is None else int(builder.last_leg[KIND])
    if is_short and kind == WAYPOINT == last_kind and (builder.legs or not is_zero_position(item)):
        builder.remark(
            f"mission item {item.seq}: found a leg of zero length, expected {_MIN_LEG:.0f} m; skipped, remove it"
        )
        return
    builder.legs.append(make_leg(item, target, builder.speed, builder.params, home_first=builder.first > 0))
    builder.last_point, builder.last_leg = target, builder.legs[-1]
    builder.jumps_taken.clear()


def _item_position(builder: _RouteBuilder, item: Item) -> np.ndarray:
    """Return the position of an item, NED (3,) [m]; zero latitude and longitude mean the current position."""
    if item.frame in TERRAIN:
        builder.remark(
            f"mission item {item.seq}: found altitude above terrain; used as above home, specify it relative to home"
        )
    absolute = item.frame in ABSOLUTE
    altitude = item.alt_m + (0.0 if absolute else builder.origin.alt_mm * 1e-3 - builder.home[2])
    point = builder.positions[item.seq].copy()
    point[2] = builder.origin.alt_mm * 1e-3 - altitude
    if is_zero_position(item):
        point[:2] = builder.last_point[:2]
    return point


def _return_leg(builder: _RouteBuilder) -> np.ndarray:
    """Return the leg after the last item: ArduPlane circles over home at RTL_ALTITUDE, PX4 at its position."""
    leg = np.zeros(N_COLUMNS)
    leg[KIND], leg[SEQ], leg[ACCEPT_RADIUS] = LOITER_UNLIMITED, -1, float(builder.first > 0)
    builder.return_from = builder.last_point
    if not builder.first:
        leg[P_N : P_D + 1] = builder.last_point
        return leg
    height = builder.params.get("RTL_ALTITUDE", builder.params.get("ALT_HOLD_RTL", 100.0 * _RTL_ALTITUDE) / 100.0)
    height = finite(height, _RTL_ALTITUDE)
    leg[P_N : P_D + 1] = builder.home
    leg[P_D] = builder.home[2] - height if height >= 0 else builder.last_point[2]  # negative: stay at this altitude
    leg[RADIUS] = finite(builder.params.get("RTL_RADIUS", 0.0))
    autoland = finite(builder.params.get("RTL_AUTOLAND", 0.0))
    leg[TURNS] = autoland if autoland in (1.0, 2.0) else 0.0
    return leg
