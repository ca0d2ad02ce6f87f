"""Multirotor route as straight segments, with take-off, circles, landing and return."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import atan2, ceil, cos, hypot, inf, pi, sin

import msgspec
import numpy as np

from fleet import mission as m
from fleet.autopilots import copter
from fleet.autopilots.copter import Limits
from fleet.contract import Item
from fleet.frames import Origin

STOP = 1e-3  # minimal wait that marks a stop [s]
_NUDGE_E7 = 108  # 1.2 m north [1e-7 deg]
_LEGS = 24  # maximum legs of the route
_ROWS = 90  # maximum segments
_CORNERS = 12  # segments of one circle
_LOW_M = 10.0  # height below which a landing is slow [m]
_RETURN, _JUMP = 20, 177  # MAV_CMD
_RTL_M = 15.0  # ArduCopter's default RTL_ALT [m]
_CIRCLE_M, _CIRCLE_RATE = 10.0, 20.0  # ArduCopter's default CIRCLE_RADIUS and CIRCLE_RATE [m, deg/s]


@dataclass
class _Laid:
    """Builder of route segments."""

    at: np.ndarray  # (3,) NED [m]
    rows: list[np.ndarray]

    def to(self, b: np.ndarray, seq: float, hold: float = 0.0, speed: float = 0.0) -> None:
        """Add a segment to `b`; skip a segment of zero length without a wait."""
        if np.linalg.norm(b - self.at) < 0.3 and not hold:
            return
        row = np.zeros(copter.N_SEGMENT)
        row[copter.A_N : copter.A_N + 3], row[copter.B_N : copter.B_N + 3] = self.at, b
        row[copter.SPEED], row[copter.HOLD], row[copter.SEQ] = speed, hold, seq
        self.rows.append(row)
        self.at = np.array(b, float)


def numbered_from_one(items: Sequence[Item], home: Origin) -> tuple[Item, ...]:
    """Insert home as item 0 of a PX4 mission, as ArduPilot does; increment every item number."""
    first = Item(seq=0, command=16, frame=0, lat_e7=home.lat_e7, lon_e7=home.lon_e7, alt_m=home.alt_mm * 1e-3)
    moved = [
        msgspec.structs.replace(i, seq=i.seq + 1, param1=i.param1 + (i.command == _JUMP)) for i in items if i.seq >= 0
    ]
    return (first, *moved)


def lay(
    items: Sequence[Item], seq: int, origin: Origin, p: np.ndarray, params: Mapping[str, float]
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Convert the route from item `seq` on to segments with the commanded speed, 0 if there is none.

    Args:
        items: mission, item 0 is home
        seq: current item
        origin: origin of the twin's NED frame
        p: position of the aircraft, NED, (3,) [m]
        params: autopilot parameters
    Returns:
        segments (n, N_SEGMENT), and the problems of the mission
    """
    way = m.route(_apart(items), seq=seq, origin=origin, params=params, limit=_LEGS)
    if len(way.legs) and int(way.legs[0, m.KIND]) == m.LAND and np.isfinite(way.start).all():
        way.start[2] = p[2]  # approach at the present height
    waits = {item.seq: item.param1 for item in items if item.command in (16, 82) and 0 < item.param1 < 1e5}
    returns = {item.seq for item in items if item.command == _RETURN}
    laid = _Laid(way.start if np.isfinite(way.start).all() else np.array(p, float), [])
    home = _home(items, origin)
    for leg in way.legs:
        if leg[m.SEQ] < 0 or len(laid.rows) > _ROWS:
            break  # a multirotor holds position after the last item
        if int(leg[m.SEQ]) in returns:
            _go_home(laid, home, params, leg[m.SEQ])
        else:
            _lay_leg(laid, leg, waits.get(int(leg[m.SEQ]), 0.0), home[2], params)
    if laid.rows:
        laid.rows[-1][copter.HOLD] = inf
    # multirotor speeds are ground speeds
    said = tuple(s for s in way.sentences if "ground speed" not in s)
    return np.array(laid.rows).reshape(-1, copter.N_SEGMENT), said


def _apart(items: Sequence[Item]) -> list[Item]:
    """Offset a waypoint directly above the previous one: a leg for a multirotor, none for a fixed wing."""
    out: list[Item] = []
    for item in sorted(items, key=lambda i: i.seq):
        last = out[-1] if out else None
        above = last is not None and (last.lat_e7, last.lon_e7, last.frame) == (item.lat_e7, item.lon_e7, item.frame)
        if above and item.command == 16 and last is not None and abs(item.alt_m - last.alt_m) > 1.0:
            item = msgspec.structs.replace(item, lat_e7=item.lat_e7 + _NUDGE_E7)
        out.append(item)
    return out


def _home(items: Sequence[Item], origin: Origin) -> np.ndarray:
    way = m.route(
        [*(i for i in items if i.seq == 0), Item(seq=1, command=_RETURN)], seq=1, origin=origin, params={"RTL_ALT": 0}
    )
    home = way.legs[0, m.P_N : m.P_D + 1].copy() if len(way.legs) else np.zeros(3)
    home[2] += 100.0  # `fleet.mission.route` returns 100 m above home
    return home


def _lay_leg(laid: _Laid, leg: np.ndarray, wait: float, ground: float, params: Mapping[str, float]) -> None:
    kind, seq, b = int(leg[m.KIND]), leg[m.SEQ], leg[m.P_N : m.P_D + 1]
    if kind == m.TAKEOFF:
        laid.to(np.array([*laid.at[:2], b[2]]), seq, STOP)
    elif kind == m.LAND:
        laid.to(np.array([*b[:2], laid.at[2]]), seq, STOP, leg[m.VA_C])
        if laid.rows:  # the quadplane decelerates more gently than it accelerates
            laid.rows[-1][copter.ACC] = max(params.get("Q_TRANS_DECEL", 0.0), 0.0)
        _down(laid, ground, seq)
    elif kind == m.LOITER_TURNS:
        _circle(laid, leg, params)
    else:
        hold = {m.LOITER_UNLIMITED: inf, m.LOITER_TIME: max(leg[m.TURNS], STOP)}.get(kind, wait)
        laid.to(b, seq, hold, leg[m.VA_C])


def _down(laid: _Laid, ground: float, seq: float) -> None:
    """Add a descent to the ground, the last ten metres at landing speed."""
    if laid.at[2] < ground - _LOW_M:
        laid.to(np.array([*laid.at[:2], ground - _LOW_M]), seq)
    laid.to(np.array([*laid.at[:2], ground]), seq, inf, -1.0)  # -1: landing speed


def _go_home(laid: _Laid, home: np.ndarray, params: Mapping[str, float], seq: float) -> None:
    height = params.get("RTL_ALT_M", params.get("RTL_ALT", 100.0 * _RTL_M) * 0.01)
    height = min(height, 1e3) if height > 0 else 0.0
    top = min(home[2] - height, laid.at[2])
    laid.to(np.array([*laid.at[:2], top]), seq, STOP if top < laid.at[2] - 0.3 else 0.0)
    laid.to(np.array([*home[:2], top]), seq, STOP)
    if not params.get("RTL_ALT_FINAL", 0.0) > 0:
        _down(laid, home[2], seq)


def _circle(laid: _Laid, leg: np.ndarray, params: Mapping[str, float]) -> None:
    """Add a circle as a polygon from its entry point; the speed is from ArduCopter's CIRCLE_RATE."""
    b, turns = leg[m.P_N : m.P_D + 1], min(max(leg[m.TURNS], 1.0), 20.0)
    radius = leg[m.RADIUS] or params.get("CIRCLE_RADIUS_M", params.get("CIRCLE_RADIUS", 100 * _CIRCLE_M) * 0.01)
    d, wide = (1.0 if radius >= 0 else -1.0), min(max(abs(radius), 1.0), 1e4)
    rate = abs(params.get("CIRCLE_RATE", _CIRCLE_RATE)) * pi / 180
    begin = atan2(laid.at[1] - b[1], laid.at[0] - b[0]) if hypot(*(laid.at - b)[:2]) > 0.1 else 0.0
    for k in range(ceil(turns * _CORNERS) + 1):
        angle = begin + d * 2 * pi * k / _CORNERS
        point = np.array([b[0] + wide * cos(angle), b[1] + wide * sin(angle), b[2]])
        laid.to(point, leg[m.SEQ], 0.0, max(rate * wide, 0.3) if k else leg[m.VA_C])


def home_again(items: Sequence[Item], origin: Origin, p: np.ndarray, params: Mapping[str, float]) -> np.ndarray:
    """Return the segments of a return to launch from `p`, NED (3,) [m]; empty if home is unknown."""
    laid = _Laid(np.array(p, float), [])
    if any(item.seq == 0 for item in items):
        _go_home(laid, _home(items, origin), params, -1.0)
    return np.array(laid.rows).reshape(-1, copter.N_SEGMENT)


def stop_from(p: np.ndarray, v: np.ndarray, limit: Limits) -> np.ndarray:
    """Return the segment of a hold command: straight ahead until stationary."""
    speed = float(np.linalg.norm(v))
    way = speed * speed / (2 * limit.acc) + speed * limit.acc / (2 * limit.jerk) if speed > 0.5 else 0.0
    laid = _Laid(np.array(p, float), [])
    laid.to(p + v / max(speed, 1e-6) * way, -1.0, inf, max(speed, 1.0))
    return np.array(laid.rows)


def paced(laid: np.ndarray, limit: Limits) -> np.ndarray:
    """Apply the limits to the segments: speed, acceleration and end speed of each."""
    out = laid.copy()
    way = out[:, copter.B_N : copter.B_N + 3] - out[:, copter.A_N : copter.A_N + 3]
    length = np.linalg.norm(way, axis=1)
    t = way / np.maximum(length, 1e-6)[:, None]
    for k, row in enumerate(out):
        level = row[copter.SPEED] if row[copter.SPEED] > 0 else limit.speed
        down = limit.land if row[copter.SPEED] < 0 else limit.down
        row[copter.SPEED] = min(copter.along(level, limit.up, down, t[k]), 100.0)
        level = min(limit.acc, row[copter.ACC]) if row[copter.ACC] > 0 else limit.acc
        row[copter.ACC] = min(copter.along(level, limit.acc_z, limit.acc_z, t[k]), 20.0)
    end = 0.0
    for k in range(len(out) - 1, -1, -1):
        row = out[k]
        last = k + 1 == len(out)
        if last or row[copter.HOLD] > 0:
            row[copter.END] = 0.0
        else:
            after = out[k + 1]
            reach = np.sqrt(end * end + 2 * after[copter.ACC] * length[k + 1])
            turn = copter.corner_speed(t[k], t[k + 1], limit)
            row[copter.END] = max(min(turn, row[copter.SPEED], after[copter.SPEED], reach), 0.0)
        end = row[copter.END]
    return out
