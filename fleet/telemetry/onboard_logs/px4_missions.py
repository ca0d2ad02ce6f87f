"""Mission of a PX4 log: from logged items, else the points known so far from the position set points.

PX4 logs no mission list. `navigator_mission_item` is published whenever an item becomes the current one: together these
rows are the list, without items that were never flown. Without that topic the set points of MISSION mode (previous,
current, next) become a list that grows while it is flown: nothing is known there before the autopilot knew it.
Source: PX4 msg/navigator_mission_item.msg, mission_result.msg, position_setpoint.msg; docs, "Mission Mode".
"""

from typing import Any, NamedTuple

import numpy as np

from fleet.contract import MAX_ITEMS, Item
from fleet.telemetry.mavlink.microservices.learned import LearnedMission
from fleet.telemetry.mavlink.onboard_log import OnboardEvent
from fleet.telemetry.onboard_logs.topic import Topic

_ABSOLUTE, _RELATIVE = 0, 3  # MAV_FRAME
_WAYPOINT, _LOITER, _LOITER_TIME, _LOITER_TO_ALT, _LAND, _TAKEOFF = 16, 17, 19, 31, 21, 22  # MAV_CMD
_SPEED = 178  # MAV_CMD_DO_CHANGE_SPEED
_COMMAND_OF_TYPE = {0: _WAYPOINT, 2: _LOITER, 3: _TAKEOFF, 4: _LAND}  # position_setpoint.type
_MISSION_STATE = 3  # vehicle_status.nav_state
_CONFIRM_S = 0.3  # a set point that is replaced sooner is a transition between two items [s]
_SAME_M = 1.0  # set points closer than this are the same point [m]
_TOLERANCE = np.array([0.5, 0.5, 1e-5, 1e-5, 0.01, 0.5, 0.5, 0.01])  # of each column of a set point; 1e-5 deg: 1 m
_MAX_RUNS = 4000  # maximum set points of a log
_LAST_NAV = 95  # MAV_CMD_NAV_LAST

Series = tuple[np.ndarray, np.ndarray]  # times (n,), values (n, k)


class MissionRecord(NamedTuple):
    """What a log reveals of its missions.

    Attributes:
        events: missions, complete or not, and home
        leg: rows of the current item, where the items are numbered here
        notes: assumptions
    """

    events: list[OnboardEvent]
    leg: Series | None = None
    notes: tuple[str, ...] = ()


def read_missions(topics: dict[str, Topic], leg: Series | None) -> MissionRecord:
    """Return the missions of a PX4 log.

    Args:
        topics: topics by name
        leg: rows of the current item as logged, None without
    """
    home = _home_events(topics)
    try:
        if all(hasattr(topics.get("navigator_mission_item"), name) for name in _ITEM_FIELDS[:5]):
            events, note = _logged_items(topics["navigator_mission_item"], topics)
            return MissionRecord(home + events, None, (note,) if note else ())
        if "position_setpoint_triplet" in topics and "vehicle_status" in topics:
            return _mission_of_set_points(topics["position_setpoint_triplet"], topics["vehicle_status"], leg, home)
    except AttributeError:  # fields of another PX4 release
        return MissionRecord(home, None, ("mission: its topics have other fields than in PX4 1.6 to 1.16; not read",))
    return MissionRecord(home)


def _home_events(topics: dict[str, Topic]) -> list[OnboardEvent]:
    home = topics.get("home_position")
    if home is None or not hasattr(home, "alt"):
        return []
    valid = home.valid_alt != 0 if hasattr(home, "valid_alt") else np.ones(len(home), bool)
    place = np.stack([getattr(home, name, np.full(len(home), np.nan)) for name in ("lat", "lon", "alt")], axis=-1)
    if hasattr(home, "valid_hpos"):
        place[home.valid_hpos == 0, :2] = np.nan
    rows = zip(home.t[valid].tolist(), place[valid].tolist(), strict=True)
    return [OnboardEvent(t, "home", tuple(row)) for t, row in list(rows)[:_MAX_RUNS] if np.isfinite(row[2])]


# --- logged items ----------------------------------------------------------------------------------------------------


def _logged_items(rows: Topic, topics: dict[str, Topic]) -> tuple[list[OnboardEvent], str]:
    """Collect the items of each mission; a mission starts where its instance count first appears."""
    instance = rows.instance_count if hasattr(rows, "instance_count") else np.zeros(len(rows))
    events, n_items, n_total = [], 0, 0
    for number in list(dict.fromkeys(instance[np.isfinite(instance)].tolist()))[:_MAX_RUNS]:
        selected = np.flatnonzero(instance == number)
        learned = LearnedMission()
        for item in map(_logged_item, _records(rows, selected)):
            if item is not None:
                learned.add(item)
        ordered = learned.items
        start, total = _mission_start(topics, number, float(rows.t[selected[0]]))
        if ordered:
            events.append(OnboardEvent(start, "partial mission", (ordered, total)))
            n_items, n_total = n_items + len(ordered), n_total + total
    if not events:
        return [], ""
    known = f"{n_items} of {n_total} items" if n_total else f"{n_items} items"
    return events, f"mission: assembled from {known} logged as they were flown; items never flown are unknown"


def _mission_start(topics: dict[str, Topic], instance: float, first_t: float) -> tuple[float, int]:
    """Return when the mission with this instance count was stored, and its number of items, 0 if not logged."""
    result = topics.get("mission_result")
    if result is None or not hasattr(result, "seq_total") or not hasattr(result, "instance_count"):
        return first_t, 0
    rows = np.flatnonzero(result.instance_count == instance)
    if not len(rows):
        return first_t, 0
    total = float(result.seq_total[rows].max())
    return min(float(result.t[rows[0]]), first_t), int(total) if 0 < total <= MAX_ITEMS else 0


_ITEM_FIELDS = (
    *("sequence_current", "nav_cmd", "latitude", "longitude", "altitude"),
    *("altitude_is_relative", "time_inside", "acceptance_radius", "loiter_radius", "force_heading"),
)


def _records(rows: Topic, selected: np.ndarray) -> list[tuple[float, ...]]:
    required, optional = _ITEM_FIELDS[:5], _ITEM_FIELDS[5:]
    columns = [getattr(rows, name)[selected] for name in required]
    columns += [getattr(rows, name)[selected] if hasattr(rows, name) else np.zeros(len(selected)) for name in optional]
    return [tuple(row) for row in np.stack(columns, axis=-1).tolist()]


def _logged_item(values: tuple[float, ...]) -> Item | None:
    seq, command, lat, lon, alt, relative, *extra = values
    inside, accept, radius, heading = (value if np.isfinite(value) else 0.0 for value in extra)
    if not np.isfinite([seq, command, lat, lon, alt]).all() or not 0 <= seq < MAX_ITEMS or not 0 < command < 65536:
        return None
    if abs(lat) > 90 or abs(lon) > 180 or (command <= _LAST_NAV and command != 20 and lat == lon == 0):
        return None
    parameters = {
        _WAYPOINT: (inside, accept, 0.0),
        _LOITER: (0.0, 0.0, radius),
        _LOITER_TIME: (inside, heading, radius),
        _LOITER_TO_ALT: (heading, radius, 0.0),
    }.get(int(command), (0.0, 0.0, 0.0))
    frame = _RELATIVE if relative else _ABSOLUTE
    return Item.at((lat, lon, alt), seq=int(seq), command=int(command), frame=frame, params=parameters)


# --- set points ------------------------------------------------------------------------------------------------------


_VALID, _KIND, _LAT, _LON, _ALT, _RADIUS, _ACCEPTANCE, _SPEED_C = range(8)
"""Columns of a set point; radius positive clockwise [m], speed 0 without command [m/s]."""


class _GrowingList:
    """Mission items known so far, numbered as reported, else as they appear."""

    def __init__(self) -> None:
        self.items: dict[int, Item] = {}
        self._guessed: int | None = None  # number given to the next point before it became current
        self._speed = 0.0
        self._current: tuple[int, np.ndarray] | None = None  # number and set point

    def set_current(self, point: np.ndarray, reported: int | None) -> int:
        """Add the current point; return its number. The same place at the same speed is the same item."""
        if self._guessed is not None:
            self.items.pop(self._guessed, None)
            self._guessed = None
        seq = len(self.items) if reported is None else reported
        is_known = self._current is not None and not _differs(self._current[1], point)[[_LAT, _LON, _SPEED_C]].any()
        if reported is None and is_known and self._current is not None:
            seq = self._current[0]
        elif reported is None and point[_SPEED_C] > 0 and point[_SPEED_C] != self._speed:
            self.items[seq] = Item(seq=seq, command=_SPEED, param2=float(point[_SPEED_C]))
            self._speed, seq = float(point[_SPEED_C]), seq + 1
        self.items[seq], self._current = _point_item(seq, point), (seq, point)
        return seq

    def set_next(self, seq: int, point: np.ndarray) -> None:
        """Add the point after the current one, unless an item with its number is known."""
        if point[_VALID] and int(point[_KIND]) in _COMMAND_OF_TYPE and seq + 1 not in self.items:
            self.items[seq + 1], self._guessed = _point_item(seq + 1, point), seq + 1


def _point_item(seq: int, point: np.ndarray) -> Item:
    command = _COMMAND_OF_TYPE[int(point[_KIND])]
    parameters = {_WAYPOINT: (0.0, float(point[_ACCEPTANCE]), 0.0), _LOITER: (0.0, 0.0, float(point[_RADIUS]))}
    lat, lon, alt = point[_LAT : _ALT + 1].tolist()
    params = parameters.get(command, ())
    return Item.at((lat, lon, alt), seq=seq, command=command, frame=_ABSOLUTE, params=params)


def _mission_of_set_points(
    triplet: Topic, status: Topic, leg: Series | None, home: list[OnboardEvent]
) -> MissionRecord:
    """Return the mission as known at each time, from the set points of MISSION mode."""
    t, current, following = triplet.t, _set_points(triplet, "current"), _set_points(triplet, "next")
    state = status.nav_state[np.clip(np.searchsorted(status.t, t, side="right") - 1, 0, None)]
    in_mission = (state == _MISSION_STATE) & (t >= status.t[0])
    usable = in_mission & (current[:, _VALID] != 0) & np.isin(current[:, _KIND], list(_COMMAND_OF_TYPE))
    known, events, leg_rows = _GrowingList(), list[OnboardEvent](), list[tuple[float, int]]()
    for begin, confirmed_t, last_t in _runs(t, current, usable):
        reported = None if leg is None else _reported_item(leg, confirmed_t)
        if len(known.items) >= MAX_ITEMS - 3:
            break
        if leg is not None and reported is None:
            continue
        seq = known.set_current(current[begin], reported)
        known.set_next(seq, following[int(np.searchsorted(t, confirmed_t, side="right")) - 1])
        items = tuple(known.items[number] for number in sorted(known.items))
        if not events or events[-1].value[0] != items:
            events.append(OnboardEvent(confirmed_t, "partial mission", (items, 0)))
        leg_rows += [(confirmed_t, seq), (max(last_t, confirmed_t), seq)]
    if not events:
        return MissionRecord(home)
    note = "mission: no list in the log; it grows by the position set points, from when the autopilot knew them"
    rows = np.array(leg_rows, float)
    rows = rows[np.diff(rows[:, 0], prepend=-np.inf) > 0]
    return MissionRecord(home + events, None if leg is not None else (rows[:, 0], rows[:, 1:]), (note,))


def _differs(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return which columns of set points differ, (..., 8)."""
    return np.abs(a - b) > _TOLERANCE


def _runs(t: np.ndarray, points: np.ndarray, usable: np.ndarray) -> list[tuple[int, float, float]]:
    """Return the runs of equal usable set points: (row with its values, time of confirmation, last time)."""
    change = _differs(points[1:], points[:-1])[:, [_VALID, _KIND, _LAT, _LON, _SPEED_C]].any(axis=1)
    starts = np.concatenate([[0], 1 + np.flatnonzero(change | (usable[1:] != usable[:-1]))])
    runs: list[tuple[int, float, float]] = []
    for first, stop in zip(starts.tolist(), [*starts[1:].tolist(), len(t)], strict=True):
        end_t = float(t[min(stop, len(t) - 1)])
        if usable[first] and end_t - t[first] >= _CONFIRM_S and len(runs) < _MAX_RUNS:
            runs += _settled_runs(t, points[:, _ALT], first, stop - 1)
    return runs


def _settled_runs(t: np.ndarray, altitude: np.ndarray, first: int, last: int) -> list[tuple[int, float, float]]:
    """Split a run where its altitude has settled on another value: PX4 ramps the altitude on the way to a point."""
    confirmed_t = float(t[first]) + _CONFIRM_S
    moving = np.flatnonzero(np.abs(np.diff(altitude[first : last + 1])) > _TOLERANCE[_ALT])
    settled = first + (int(moving[-1]) + 1 if len(moving) else 0)
    settled_t = float(t[settled]) + _CONFIRM_S
    if abs(altitude[settled] - altitude[first]) < _SAME_M or not confirmed_t < settled_t <= t[last]:
        return [(first, confirmed_t, float(t[last]))]
    return [(first, confirmed_t, float(t[settled])), (settled, settled_t, float(t[last]))]


def _set_points(triplet: Topic, name: str) -> np.ndarray:
    """Return one point of the triplet at each row, (n, 8)."""
    nothing = np.zeros(len(triplet))
    if not hasattr(triplet, name):
        return np.zeros((len(triplet), 8))
    part: Any = getattr(triplet, name)
    if hasattr(part, "loiter_direction_counter_clockwise"):  # since 1.13
        direction = np.where(part.loiter_direction_counter_clockwise != 0, -1.0, 1.0)
    else:
        direction = np.sign(part.loiter_direction) if hasattr(part, "loiter_direction") else nothing + 1.0
    radius, acceptance, speed = (
        getattr(part, field) if hasattr(part, field) else nothing
        for field in ("loiter_radius", "acceptance_radius", "cruising_speed")
    )
    place = np.stack([part.lat, part.lon, part.alt], axis=-1)
    with np.errstate(all="ignore"):
        on_earth = (np.abs(place) <= (90, 180, 1e5)).all(axis=-1) & (np.abs(place[:, :2]) > 1e-9).any(axis=-1)
    columns = [(part.valid != 0) & on_earth, part.type, *place.T, np.abs(radius) * direction, acceptance, speed]
    return np.nan_to_num(np.stack(columns, axis=-1), posinf=0.0, neginf=0.0)


def _reported_item(leg: Series, t: float) -> int | None:
    k = int(np.searchsorted(leg[0], t, side="right")) - 1
    seq = float(leg[1][k, 0]) if k >= 0 else -1.0
    return int(seq) if 0 <= seq < MAX_ITEMS - 1 else None
