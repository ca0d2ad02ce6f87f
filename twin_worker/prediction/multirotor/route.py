"""Multirotor route as straight segments, with take-off, circles, landing and return."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import atan2, ceil, cos, hypot, inf, pi, sin

import msgspec
import numpy as np

from fleet import mission as m
from fleet.autopilots import copter, copter_legs
from fleet.autopilots.copter import Limits
from fleet.contract import Item
from fleet.frames import Origin, to_ned

STOP_WAIT_S = 1e-3  # minimal wait that marks a stop [s]
_NUDGE_E7 = 108  # 1.2 m north [1e-7 deg]
MAX_LEGS = 24  # maximum legs of the route
_SEGMENTS_PER_LEG = 4  # maximum segments of the route over its maximum legs
_CIRCLE_SEGMENTS = 12  # segments of one circle
_SLOW_LANDING_M = 10.0  # height below which a landing is slow [m]
_RETURN, _JUMP, _DELAY = 20, 177, 93  # MAV_CMD
_RTL_M = 15.0  # ArduCopter's default RTL_ALT [m]
_LOITER_S = 5.0  # ArduCopter's default RTL_LOIT_TIME [s]
_MIN_SLOPE = 0.5  # smallest RTL_CONE_SLOPE that limits the height
_PLACE_M = 0.005  # shorter than the rounding of a place [m]
_EDGE_M = 3.0  # ArduCopter circles at once when nearer to the circle [m]
_CIRCLE_M, _CIRCLE_RATE = 10.0, 20.0  # ArduCopter's default CIRCLE_RADIUS and CIRCLE_RATE [m, deg/s]


@dataclass
class _SegmentBuilder:
    """Builder of route segments; `arcs`: a circle is one segment instead of many straight ones."""

    end: np.ndarray  # (3,) NED [m]
    rows: list[np.ndarray]
    arcs: bool = False

    def add(self, b: np.ndarray, seq: float, hold: float = 0.0, speed: float = 0.0, *, shortest: float = 0.3) -> None:
        """Add a segment to `b`; skip a segment shorter than `shortest` [m] without a wait."""
        if np.linalg.norm(b - self.end) < shortest and not hold:
            return
        row = np.zeros(copter_legs.N_COLUMNS if self.arcs else copter.N_SEGMENT)
        row[copter.A_N : copter.A_N + 3], row[copter.B_N : copter.B_N + 3] = self.end, b
        row[copter.SPEED], row[copter.HOLD], row[copter.SEQ] = speed, hold, seq
        self.rows.append(row)
        self.end = np.array(b, float)

    def stop(self) -> None:
        """Let the aircraft stop at the end of the last segment."""
        if self.arcs and self.rows:
            self.rows[-1][copter.HOLD] = max(self.rows[-1][copter.HOLD], STOP_WAIT_S)

    @property
    def array(self) -> np.ndarray:
        """Return all segments."""
        return np.array(self.rows).reshape(-1, copter_legs.N_COLUMNS if self.arcs else copter.N_SEGMENT)


def numbered_from_one(items: Sequence[Item], home: Origin) -> tuple[Item, ...]:
    """Insert home as item 0 of a PX4 mission, as ArduPilot does; increment every item number."""
    first = Item(seq=0, command=16, frame=0, lat_e7=home.lat_e7, lon_e7=home.lon_e7, alt_m=home.alt_mm * 1e-3)
    renumbered = [
        msgspec.structs.replace(i, seq=i.seq + 1, param1=i.param1 + (i.command == _JUMP)) for i in items if i.seq >= 0
    ]
    return (first, *renumbered)


def segments_from_mission(
    items: Sequence[Item],
    seq: int,
    origin: Origin,
    p: np.ndarray,
    params: Mapping[str, float],
    *,
    arcs: bool = False,
    speed: float = 0.0,
    jumps_taken: Mapping[int, int] | None = None,
    max_legs: int = MAX_LEGS,
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Convert the route from item `seq` on to segments with the commanded speed, 0 if there is none.

    Args:
        items: mission, item 0 is home
        seq: current item
        origin: origin of the twin's NED frame
        p: position of the aircraft, NED, (3,) [m]
        params: autopilot parameters
        arcs: a circle is one segment with the columns of `copter_legs`
        speed: commanded before the current item, for all but landing and return; 0 if none [m/s]
        jumps_taken: jumps taken so far at each jump, as for `unroll_route`
        max_legs: maximum legs of the route
    Returns:
        segments (n, N_SEGMENT), and the problems of the mission
    """
    separated = _separate_vertical(items)
    mission_route = m.unroll_route(
        separated, seq=seq, origin=origin, params=params, limit=max_legs, jumps_taken=jumps_taken
    )
    if (
        len(mission_route.legs)
        and int(mission_route.legs[0, m.KIND]) == m.LAND
        and np.isfinite(mission_route.start).all()
    ):
        mission_route.start[2] = p[2]  # approach at the present height
    wait_times = {item.seq: item.param1 for item in items if item.command in (16, 82, _DELAY) and 0 < item.param1 < 1e5}
    delays = {item.seq for item in items if item.command == _DELAY}
    returns = {item.seq for item in items if item.command == _RETURN}
    start = mission_route.start if np.isfinite(mission_route.start).all() else np.array(p, float)
    builder = _SegmentBuilder(start, [], arcs)
    home = home_position(items, origin)
    for leg in mission_route.legs:
        if leg[m.SEQ] < 0 or len(builder.rows) > _SEGMENTS_PER_LEG * max_legs:
            break  # a multirotor holds position after the last item
        if int(leg[m.KIND]) != m.LAND:
            leg[m.VA_C] = leg[m.VA_C] or speed
        if int(leg[m.SEQ]) in delays:
            builder.add(builder.end, leg[m.SEQ], wait_times.get(int(leg[m.SEQ]), STOP_WAIT_S))
        elif int(leg[m.SEQ]) in returns:
            builder.stop()
            _add_return(builder, home, params, leg[m.SEQ])
        else:
            _add_leg(builder, leg, wait_times.get(int(leg[m.SEQ]), 0.0), home[2], params)
    if builder.rows:
        builder.rows[-1][copter.HOLD] = inf
    # multirotor speeds are ground speeds
    problems = tuple(s for s in mission_route.sentences if "ground speed" not in s)
    return builder.array, problems


def _separate_vertical(items: Sequence[Item]) -> list[Item]:
    """Offset a waypoint directly above the previous one: a leg for a multirotor, none for a fixed wing."""
    out: list[Item] = []
    for item in sorted(items, key=lambda i: i.seq):
        if item.command == m.SPEED:  # a ground speed is a multirotor's own kind of speed
            item = msgspec.structs.replace(item, param1=0.0)
        previous = out[-1] if out else None
        above = previous is not None and (previous.lat_e7, previous.lon_e7, previous.frame) == (
            item.lat_e7,
            item.lon_e7,
            item.frame,
        )
        if above and item.command == 16 and previous is not None and abs(item.alt_m - previous.alt_m) > 1.0:
            item = msgspec.structs.replace(item, lat_e7=item.lat_e7 + _NUDGE_E7)
        if item.command == _DELAY:
            item = _wait_item(item, next((i for i in reversed(out) if i.lat_e7 or i.lon_e7), None))
        out.append(item)
    return out


def _wait_item(item: Item, previous: Item | None) -> Item:
    """Return a delay as a waypoint beside the previous one: a wing flies on, a multirotor waits."""
    if previous is None:
        return item
    place = {"lat_e7": previous.lat_e7 + _NUDGE_E7, "lon_e7": previous.lon_e7, "alt_m": previous.alt_m}
    return msgspec.structs.replace(item, command=16, frame=previous.frame, **place)


def home_position(items: Sequence[Item], origin: Origin) -> np.ndarray:
    """Return the position of home, NED, (3,) [m]."""
    return_route = m.unroll_route(
        [*(i for i in items if i.seq == 0), Item(seq=1, command=_RETURN)], seq=1, origin=origin, params={"RTL_ALT": 0}
    )
    home = return_route.legs[0, m.P_N : m.P_D + 1].copy() if len(return_route.legs) else np.zeros(3)
    home[2] += 100.0  # `fleet.mission.route` returns 100 m above home
    return home


def _add_leg(
    builder: _SegmentBuilder, leg: np.ndarray, wait_s: float, ground: float, params: Mapping[str, float]
) -> None:
    kind, seq, b = int(leg[m.KIND]), leg[m.SEQ], leg[m.P_N : m.P_D + 1]
    if kind == m.TAKEOFF:
        builder.add(np.array([*builder.end[:2], b[2]]), seq, STOP_WAIT_S)
    elif kind == m.LAND:
        builder.stop()
        builder.add(np.array([*b[:2], builder.end[2]]), seq, STOP_WAIT_S, leg[m.VA_C])
        if builder.rows:  # the quadplane decelerates more gently than it accelerates
            builder.rows[-1][copter.ACC] = max(params.get("Q_TRANS_DECEL", 0.0), 0.0)
        _add_descent(builder, ground, seq)
    elif kind == m.LOITER_TURNS:
        _add_circle(builder, leg, params)
    else:
        hold = {m.LOITER_UNLIMITED: inf, m.LOITER_TIME: max(leg[m.TURNS], STOP_WAIT_S)}.get(kind, wait_s)
        builder.add(b, seq, hold, leg[m.VA_C])


def _add_descent(builder: _SegmentBuilder, ground: float, seq: float) -> None:
    """Add a descent to the ground, the last ten metres at landing speed."""
    if builder.arcs:
        builder.add(np.array([*builder.end[:2], ground]), seq, inf, -1.0)  # -1: landing speed
        builder.rows[-1][copter_legs.DESCENT] = 1.0
        return
    if builder.end[2] < ground - _SLOW_LANDING_M:
        builder.add(np.array([*builder.end[:2], ground - _SLOW_LANDING_M]), seq)
    builder.add(np.array([*builder.end[:2], ground]), seq, inf, -1.0)


def _add_return(builder: _SegmentBuilder, home: np.ndarray, params: Mapping[str, float], seq: float) -> None:
    height = params.get("RTL_ALT_M", params.get("RTL_RETURN_ALT", params.get("RTL_ALT", 100.0 * _RTL_M) * 0.01))
    height = min(height, 1e3) if height > 0 else 0.0
    if builder.arcs:
        height = _return_height(builder.end, home, params, height)
    top = min(home[2] - height, builder.end[2])
    if builder.arcs:  # it flies through the top of the climb, which has a length even if there is none
        top = min(top, builder.end[2] - _PLACE_M)
        builder.add(np.array([*builder.end[:2], top]), seq, shortest=0.0)
    else:
        builder.add(np.array([*builder.end[:2], top]), seq, STOP_WAIT_S if top < builder.end[2] - 0.3 else 0.0)
    wait_s = params.get("RTL_LAND_DELAY", params.get("RTL_LOIT_TIME", 1e3 * _LOITER_S) * 1e-3)
    builder.add(np.array([*home[:2], top]), seq, wait_s if STOP_WAIT_S < wait_s < 1e3 else STOP_WAIT_S)
    if not params.get("RTL_ALT_FINAL_M", params.get("RTL_ALT_FINAL", 0.0)) > 0:
        _add_descent(builder, home[2], seq)


def _return_height(p: np.ndarray, home: np.ndarray, params: Mapping[str, float], height: float) -> float:
    """Return ArduCopter's height of a return: within the cone above home, and at least RTL_CLIMB_MIN above p [m]."""
    climb = max(params.get("RTL_CLIMB_MIN_M", params.get("RTL_CLIMB_MIN", 0.0) * 0.01), 0.0)
    lowest, slope = home[2] - p[2] + climb, params.get("RTL_CONE_SLOPE", 3.0)
    height = max(height, lowest)
    return float(min(height, max(hypot(*(p - home)[:2]) * slope, lowest)) if slope >= _MIN_SLOPE else height)


def _add_circle(builder: _SegmentBuilder, leg: np.ndarray, params: Mapping[str, float]) -> None:
    """Add a circle as a polygon from its entry point; the speed is from ArduCopter's CIRCLE_RATE."""
    b, turns = leg[m.P_N : m.P_D + 1], min(max(leg[m.TURNS], 1.0), 20.0)
    radius = leg[m.RADIUS] or params.get("CIRCLE_RADIUS_M", params.get("CIRCLE_RADIUS", 100 * _CIRCLE_M) * 0.01)
    direction, abs_radius = (1.0 if radius >= 0 else -1.0), min(max(abs(radius), 1.0), 1e4)
    rate = abs(params.get("CIRCLE_RATE", _CIRCLE_RATE)) * pi / 180
    if builder.arcs:
        _add_arc(builder, leg, direction * abs_radius, rate)
        return
    start_angle = atan2(builder.end[1] - b[1], builder.end[0] - b[0]) if hypot(*(builder.end - b)[:2]) > 0.1 else 0.0
    for k in range(ceil(turns * _CIRCLE_SEGMENTS) + 1):
        angle = start_angle + direction * 2 * pi * k / _CIRCLE_SEGMENTS
        point = np.array([b[0] + abs_radius * cos(angle), b[1] + abs_radius * sin(angle), b[2]])
        builder.add(point, leg[m.SEQ], 0.0, max(min(rate * abs_radius, leg[m.VA_C] or inf), 0.3) if k else leg[m.VA_C])


def _add_arc(builder: _SegmentBuilder, leg: np.ndarray, radius: float, rate: float) -> None:
    """Add a leg to the circle, with a stop, and the circle as one segment; radius positive clockwise."""
    centre, seq, turns = leg[m.P_N : m.P_D + 1], leg[m.SEQ], min(max(leg[m.TURNS], 1.0), 20.0)
    offset = (builder.end - centre)[:2]
    distance = hypot(*offset)
    out = offset / distance if distance > 0.1 else np.array([1.0, 0.0])
    edge = np.array([*(centre[:2] + abs(radius) * out), centre[2]])
    builder.stop()
    if np.linalg.norm(edge - builder.end) > _EDGE_M:
        builder.add(edge, seq, STOP_WAIT_S, leg[m.VA_C])
    builder.add(builder.end, seq, STOP_WAIT_S, max(rate * abs(radius), 0.3))
    row = builder.rows[-1]
    row[copter_legs.RADIUS], row[copter_legs.TURN] = abs(radius), 2 * pi * turns * (1 if radius >= 0 else -1)
    row[copter_legs.C_N], row[copter_legs.C_E] = centre[:2]
    row[copter_legs.SPEED_BEFORE] = leg[m.VA_C]


def stop_position(items: Sequence[Item], seq: int, origin: Origin) -> np.ndarray | None:
    """Return where an aircraft waits after item `seq`, NED, (3,) [m]; None if the mission does not tell."""
    home, place = home_position(items, origin), None
    for item in sorted(items, key=lambda i: i.seq):
        if 0 < item.seq <= seq and item.command in (16, 17, 19, 22, 82):
            down = -item.alt_m - origin.alt_mm * -1e-3 if item.frame in m.ABSOLUTE else home[2] - item.alt_m
            north_east = home[:2]
            if item.lat_e7 or item.lon_e7:
                north_east = to_ned(origin, *(np.array([x], float) for x in (item.lat_e7, item.lon_e7, 0.0)))[0, :2]
            place = np.array([*north_east, down])
    return place


def return_segments(
    items: Sequence[Item], origin: Origin, p: np.ndarray, params: Mapping[str, float], *, arcs: bool = False
) -> np.ndarray:
    """Return the segments of a return to launch from `p`, NED (3,) [m]; empty if home is unknown."""
    builder = _SegmentBuilder(np.array(p, float), [], arcs)
    if any(item.seq == 0 for item in items):
        _add_return(builder, home_position(items, origin), params, -1.0)
    return builder.array


def stopping_segment(p: np.ndarray, v: np.ndarray, limit: Limits) -> np.ndarray:
    """Return the segment of a hold command: straight ahead until stationary."""
    speed = float(np.linalg.norm(v))
    distance = speed * speed / (2 * limit.acc) + speed * limit.acc / (2 * limit.jerk) if speed > 0.5 else 0.0
    builder = _SegmentBuilder(np.array(p, float), [])
    builder.add(p + v / max(speed, 1e-6) * distance, -1.0, inf, max(speed, 1.0))
    return np.array(builder.rows)


def limit_speeds(segments: np.ndarray, limit: Limits) -> np.ndarray:
    """Apply the limits to the segments: speed, acceleration and end speed of each."""
    out = segments.copy()
    displacement = out[:, copter.B_N : copter.B_N + 3] - out[:, copter.A_N : copter.A_N + 3]
    length = np.linalg.norm(displacement, axis=1)
    t = displacement / np.maximum(length, 1e-6)[:, None]
    for k, row in enumerate(out):
        horizontal = row[copter.SPEED] if row[copter.SPEED] > 0 else limit.speed
        down = limit.land if row[copter.SPEED] < 0 else limit.down
        row[copter.SPEED] = min(copter.limit_along(horizontal, limit.up, down, t[k]), 100.0)
        horizontal = min(limit.acc, row[copter.ACC]) if row[copter.ACC] > 0 else limit.acc
        row[copter.ACC] = min(copter.limit_along(horizontal, limit.acc_z, limit.acc_z, t[k]), 20.0)
        if out.shape[1] > copter_legs.TURN and row[copter_legs.TURN]:
            row[copter.SPEED] = min(segments[k, copter.SPEED], limit.speed)
    end_speed = 0.0
    for k in range(len(out) - 1, -1, -1):
        row = out[k]
        is_last = k + 1 == len(out)
        if is_last or row[copter.HOLD] > 0:
            row[copter.END] = 0.0
        else:
            next_row = out[k + 1]
            reachable = np.sqrt(end_speed * end_speed + 2 * next_row[copter.ACC] * length[k + 1])
            corner = copter.corner_speed(t[k], t[k + 1], limit)
            row[copter.END] = max(min(corner, row[copter.SPEED], next_row[copter.SPEED], reachable), 0.0)
        end_speed = row[copter.END]
    return out
