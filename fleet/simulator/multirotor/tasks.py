"""Mission of a simulated multirotor: item by item to flight tasks, with speed changes, jumps and delays.

Source: MAVLink mission protocol; ArduCopter and PX4 mission command lists.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite

import numpy as np

from fleet.contract import Item
from fleet.frames import Origin, to_ned

TAKEOFF, WAYPOINT, TURNS, DELAY, RETURN, LAND, HOLD = (
    "take-off",
    "waypoint",
    "turns",
    "delay",
    "return",
    "land",
    "hold",
)
_WAYPOINT, _UNLIMITED, _TURNS, _TIME, _RETURN, _LAND, _TAKEOFF, _DELAY, _JUMP, _SPEED = (
    *(16, 17, 18, 19, 20, 21, 22, 93, 177, 178),
)
_KINDS = {
    _WAYPOINT: WAYPOINT,
    _UNLIMITED: HOLD,
    _TURNS: TURNS,
    _TIME: WAYPOINT,
    _RETURN: RETURN,
    _LAND: LAND,
    _TAKEOFF: TAKEOFF,
    _DELAY: DELAY,
}


@dataclass(frozen=True)
class Task:
    """One thing to fly.

    Attributes:
        kind: one of the names above
        seq: mission item
        target: destination or centre, NED from home, (3,) [m]
        hold_s: time to wait there [s]
        turns, radius: of a circle, radius positive clockwise [-, m]
        speed: horizontal speed commanded by the mission; 0: none [m/s]
    """

    kind: str
    seq: int
    target: np.ndarray
    hold_s: float = 0.0
    turns: float = 0.0
    radius: float = 0.0
    speed: float = 0.0

    @property
    def passes(self) -> bool:
        """Return whether the aircraft may fly through without a stop."""
        return self.kind == WAYPOINT and self.hold_s <= 0


class TaskSequence:
    """Traversal of a mission; `advance` moves to the next task, `following` looks at it."""

    def __init__(self, items: Sequence[Item], origin: Origin, first: int):
        """Start before the first item to fly, `first`."""
        self._items = {item.seq: item for item in items}
        self._origin, self._first = origin, first
        self.restart()

    def restart(self) -> None:
        """Start the mission again."""
        self._seq, self._speed, self._jumps = self._first, 0.0, {}  # type: tuple[int, float, dict[int, int]]
        self._target = np.zeros(3)

    def set_items(self, items: Sequence[Item]) -> None:
        """Replace the mission; the next item to fly keeps its number."""
        self._items, self._jumps = {item.seq: item for item in items}, {}

    def set_current(self, seq: int) -> None:
        """Continue with item `seq`."""
        self._seq, self._jumps = seq, {}

    def set_speed(self, speed: float) -> None:
        """Fly at a commanded speed until the mission changes it; 0: the default [m/s]."""
        self._speed = speed

    def advance(self) -> Task | None:
        """Move on to the next task; None: the mission is complete."""
        step = self._find()
        if step is None:
            return None
        task, self._seq, self._speed, self._jumps = step
        self._target = task.target
        return task

    def following(self, *, with_position: bool = False) -> Task | None:
        """Return the task after the current one, or the next one with a position, without moving on."""
        step = self._find(with_position)
        return None if step is None else step[0]

    def _find(self, with_position: bool = False) -> tuple[Task, int, float, dict[int, int]] | None:
        seq, speed, jumps = self._seq, self._speed, dict(self._jumps)
        for _ in range(4 * len(self._items) + 4):
            item = self._items.get(seq)
            if item is None:
                return None
            if item.command == _JUMP:
                limit = item.param2
                if limit < 0 or jumps.get(seq, 0) < limit:
                    jumps[seq] = jumps.get(seq, 0) + 1
                    seq = int(item.param1)
                    continue
                jumps.pop(seq, None)
            elif item.command == _SPEED:
                speed = item.param2 if item.param2 > 0 else speed
            elif item.command in _KINDS and not (with_position and item.command in (_DELAY, _RETURN)):
                return self._task(item, speed), seq + 1, speed, jumps
            seq += 1
        return None

    def _task(self, item: Item, speed: float) -> Task:
        target = self._target.copy()
        if item.lat_e7 or item.lon_e7:
            alt_mm = 1e3 * item.alt_m + (0 if item.frame in (0, 5) else self._origin.alt_mm)
            target = to_ned(self._origin, *(np.array([x], float) for x in (item.lat_e7, item.lon_e7, alt_mm)))[0]
        elif item.command == _TAKEOFF:
            target[2] = -item.alt_m
        kind = _KINDS[item.command]
        hold = item.param1 if item.command in (_WAYPOINT, _TIME, _DELAY) and isfinite(item.param1) else 0.0
        return Task(kind, item.seq, target, max(hold, 0.0), item.param1, item.param3, speed)
