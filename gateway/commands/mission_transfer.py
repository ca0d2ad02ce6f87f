"""Transfers of missions from and to an autopilot, as state machines in data time.

Reading: MISSION_REQUEST_LIST, MISSION_COUNT, then MISSION_REQUEST_INT and MISSION_ITEM_INT of each item, MISSION_ACK.
Writing: MISSION_COUNT, then MISSION_REQUEST(_INT) of the autopilot and MISSION_ITEM_INT of each item, MISSION_ACK.
PX4 stores a received mission only when it is complete. ArduPilot writes each item in place: an upload that ends early
leaves a mixture, which only a read afterwards detects.
Source: MAVLink services, "Mission Protocol"; ArduPilot `MissionItemProtocol`; PX4 `MavlinkMissionManager`.
"""

from collections import deque
from collections.abc import Sequence
from math import isnan
from typing import Any, NamedTuple

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.contract import MAX_ITEMS, Item
from gateway.onboard import SYSTEM
from gateway.onboard.questions import RETRY_S as ITEM_RETRY_S

Target = tuple[int, int]
"""MAVLink system and component id of an autopilot."""
RETRY_S = 1.0  # between two equal commands [s]
STALLED_S = 10.0  # silence after which a transfer has failed; ArduPilot waits 8 s, PX4 5 s [s]
FINAL_S = 4.0  # wait for the acknowledgement of a completely sent mission; the autopilot may request an item again [s]
_FRAMES = {5: 0, 6: 3, 11: 10}  # MAV_FRAME: with integer coordinates -> the same frame
_ALTITUDE_STEP_M = 0.011  # ArduPilot stores altitudes in whole centimetres [m]
_PARAM_STEP = 0.5  # ArduPilot stores several parameters as whole numbers
_MAX_NUMBER = 1e9  # largest parameter or altitude; larger ones, and those that are not finite, are errors


def enum_words(enum: str, prefix: str) -> dict[int, str]:
    """Return the values of a MAVLink enum as words, without the prefix of their names."""
    entries = dialect.enums[enum].items()
    return {value: entry.name.removeprefix(prefix).lower().replace("_", " ") for value, entry in entries}


_RESULT_NAMES = enum_words("MAV_MISSION_RESULT", "MAV_MISSION_")


class RawItem(NamedTuple):
    """Mission item as on the wire of MAVLink, without the conversions of `Item`; `param4` may be nan."""

    frame: int
    command: int
    params: tuple[float, float, float, float]
    x: int  # latitude [1e-7 deg]
    y: int  # longitude [1e-7 deg]
    z: float  # altitude in its frame [m]

    @classmethod
    def from_message(cls, message: Any) -> "RawItem":
        """Return the item of MISSION_ITEM_INT or MISSION_ITEM."""
        scale = 1 if message.get_type() == "MISSION_ITEM_INT" else 1e7
        params = (message.param1, message.param2, message.param3, message.param4)
        return cls(
            message.frame, message.command, params, round(message.x * scale), round(message.y * scale), message.z
        )

    @classmethod
    def from_item(cls, item: Item, param4: float) -> "RawItem":
        """Return an item of the contract with another `param4`: the contract has 0 where an autopilot has nan."""
        params = (item.param1, item.param2, item.param3, param4)
        return cls(item.frame, item.command, params, item.lat_e7, item.lon_e7, item.alt_m)

    def to_message(self, target: Target, seq: int, is_current: bool) -> Any:
        """Return MISSION_ITEM_INT."""
        head = (*target, seq, self.frame, self.command, int(is_current), 1)
        return dialect.MAVLink_mission_item_int_message(*head, *self.params, self.x, self.y, self.z)

    def is_stored_as(self, other: "RawItem") -> bool:
        """Return whether an autopilot stores this item as `other`, within its rounding."""
        same_place = abs(self.x - other.x) <= 1 and abs(self.y - other.y) <= 1
        frames = {_FRAMES.get(item.frame, item.frame) for item in (self, other)}
        if self.command != other.command or not same_place or len(frames) != 1:
            return False
        params = zip(self.params[:3], other.params[:3], strict=True)
        return abs(self.z - other.z) <= _ALTITUDE_STEP_M and all(_is_rounded(a, b) for a, b in params)


def _is_rounded(a: float, b: float) -> bool:
    return abs(a - b) <= _PARAM_STEP or (isnan(a) and (isnan(b) or b == 0.0))


def same_missions(sent: Sequence[RawItem], stored: Sequence[RawItem], has_home: bool) -> bool:
    """Return whether a stored mission is the sent one; item 0 of ArduPilot is home, which an upload does not change."""
    first = 1 if has_home else 0
    pairs = zip(sent[first:], stored[first:], strict=False)
    return len(sent) == len(stored) and all(a.is_stored_as(b) for a, b in pairs)


def is_for_us(message: Any) -> bool:
    """Return whether a message is addressed to this gateway, or to all."""
    return getattr(message, "target_system", 0) in (0, SYSTEM) and getattr(message, "mission_type", 0) == 0


class MissionRead:
    """Read the mission on board.

    Args:
        target: the autopilot
        now: fleet time [s since 1970]
    """

    def __init__(self, target: Target, now: float) -> None:
        self.result: str | None = None  # empty: complete; otherwise the error; None: in progress
        self._target, self._count = target, -1
        self._items: dict[int, RawItem] = {}
        self._progress_t, self._sent_t = now, float("-inf")
        self._ends = False

    @property
    def items(self) -> tuple[RawItem, ...]:
        """Return the items received so far, in order."""
        return tuple(self._items[seq] for seq in sorted(self._items))

    def receive(self, message: Any, now: float) -> None:
        """Process one message of the autopilot."""
        name = message.get_type()
        if self.result is not None or not is_for_us(message):
            return
        if name == "MISSION_COUNT" and self._count < 0:
            self._count = message.count
            if self._count > MAX_ITEMS:
                self.result = f"found {self._count} items on board, expected at most {MAX_ITEMS}"
        elif name in ("MISSION_ITEM_INT", "MISSION_ITEM") and message.seq == len(self._items) < self._count:
            self._items[message.seq] = RawItem.from_message(message)
        else:
            return
        self._progress_t, self._sent_t = now, float("-inf")
        if len(self._items) == self._count:
            self.result, self._ends = "", True

    def messages(self, now: float) -> list[Any]:
        """Return the messages to send now."""
        if self._ends:
            self._ends = False
            return [dialect.MAVLink_mission_ack_message(*self._target, dialect.MAV_MISSION_ACCEPTED)]
        if self.result is None and now - self._progress_t > STALLED_S:
            self.result = f"no answer to a request for the mission for {STALLED_S:.0f} s"
        if self.result is not None or now - self._sent_t < ITEM_RETRY_S:
            return []
        self._sent_t = now
        if self._count < 0:
            return [dialect.MAVLink_mission_request_list_message(*self._target)]
        return [dialect.MAVLink_mission_request_int_message(*self._target, len(self._items))]


class MissionWrite:
    """Write a mission; only a read afterwards shows what the autopilot has stored.

    Args:
        target: the autopilot
        items: the mission
        current: item to fly to, which PX4 takes from the items
        now: fleet time [s since 1970]
    """

    def __init__(self, target: Target, items: Sequence[RawItem], current: int, now: float) -> None:
        self.result: str | None = None  # empty: acknowledged; otherwise the error; None: in progress
        self._target, self._items, self._current = target, items, current
        self._requested: deque[int] = deque()
        self._sent: set[int] = set()  # items sent at least once
        self._progress_t, self._count_t = now, float("-inf")
        self._has_begun = False

    def receive(self, message: Any, now: float) -> None:
        """Process one message of the autopilot."""
        name = message.get_type()
        if self.result is not None or not is_for_us(message):
            return
        if name in ("MISSION_REQUEST_INT", "MISSION_REQUEST") and message.seq < len(self._items):
            self._has_begun, self._progress_t = True, now
            if message.seq not in self._requested:
                self._requested.append(message.seq)
        elif name == "MISSION_ACK" and message.type == dialect.MAV_MISSION_ACCEPTED:
            if len(self._sent) == len(self._items):
                self.result = ""
        elif name == "MISSION_ACK" and message.type != dialect.MAV_MISSION_INVALID_SEQUENCE:  # that one: a duplicate
            self.result = f"the autopilot answered {_RESULT_NAMES.get(message.type, message.type)}"

    def messages(self, now: float) -> list[Any]:
        """Return the messages to send now."""
        limit = FINAL_S if len(self._sent) == len(self._items) else STALLED_S
        if self.result is None and now - self._progress_t > limit:
            self.result = f"no answer to the mission for {limit:.0f} s"
        if self.result is not None:
            return []
        if not self._has_begun:
            if now - self._count_t < RETRY_S:
                return []
            self._count_t = now
            return [dialect.MAVLink_mission_count_message(*self._target, len(self._items))]
        out = [self._items[seq].to_message(self._target, seq, seq == self._current) for seq in self._requested]
        self._sent.update(self._requested)
        self._requested.clear()
        return out


def check_items(items: Sequence[Item]) -> str:
    """Return why a proposed mission must not be sent; empty: it may."""
    if not 0 < len(items) <= MAX_ITEMS:
        return f"found a mission of {len(items)} items, expected 1 to {MAX_ITEMS}"
    for seq, item in enumerate(items):
        numbers = (item.param1, item.param2, item.param3, item.param4, item.alt_m)
        in_range = abs(item.lat_e7) <= 900_000_000 and abs(item.lon_e7) <= 1_800_000_000
        if item.seq != seq or not in_range or not all(abs(x) <= _MAX_NUMBER for x in numbers):
            return f"found item {item.seq} at place {seq} of the mission, expected it numbered, finite and on earth"
        if not (0 <= item.command <= 0xFFFF and 0 <= item.frame <= 0xFF):
            return f"found command {item.command} in frame {item.frame} of item {seq}, expected a command of MAVLink"
    return ""


def planned_items(
    items: Sequence[Item], former: Sequence[RawItem], reported: Sequence[Item], is_px4: bool
) -> tuple[RawItem, ...]:
    """Return a proposed mission as it is sent: items that are on board already go back exactly as they were read.

    Others take `param4` (heading) from the item on board at the same position, else nan on PX4: its default heading.

    Args:
        items: the proposed mission
        former: the mission on board as read
        reported: the same as published, from which the proposal was computed, same length
        is_px4: the autopilot is PX4
    """
    unnumbered = [msgspec.structs.replace(item, seq=0) for item in reported]
    positions = {(raw.command, raw.x, raw.y): raw.params[3] for raw in reversed(former)}
    out = []
    for item in items:
        same = msgspec.structs.replace(item, seq=0)
        if same in unnumbered and len(former) == len(reported):
            out.append(former[unnumbered.index(same)])
            continue
        heading = item.param4
        if not heading:
            heading = positions.get((item.command, item.lat_e7, item.lon_e7), float("nan") if is_px4 else 0.0)
        out.append(RawItem.from_item(item, heading))
    return tuple(out)
