"""Extract events of a DataFlash log: modes, arming, parameters, missions, texts."""

import math
import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.contract import MAX_ITEMS, Item
from fleet.telemetry.mavlink.microservices.learned import LearnedMission
from fleet.telemetry.mavlink.onboard_log import OnboardEvent
from fleet.telemetry.onboard_logs.dataflash.records import Records
from fleet.vehicles import FIXED_WING, HELICOPTER, MULTIROTOR, QUADPLANE

SEVERITY_TEXT, SEVERITY_ERROR = 6, 3  # as in STATUSTEXT: information, error
_MAV_TYPE = {FIXED_WING: dialect.MAV_TYPE_FIXED_WING, QUADPLANE: dialect.MAV_TYPE_FIXED_WING}
_MAV_TYPE |= {MULTIROTOR: dialect.MAV_TYPE_QUADROTOR, HELICOPTER: dialect.MAV_TYPE_HELICOPTER}
_NAME = re.compile(r"[A-Z][A-Z0-9_]{0,15}")
_ARMED, _DISARMED = 10, 11
_EVENTS = {
    7: "autopilot state",
    9: "simple bearing set",
    _ARMED: "armed",
    _DISARMED: "disarmed",
    15: "auto armed",
    16: "takeoff",
    17: "land complete, maybe",
    18: "land complete",
    19: "lost GPS",
    21: "flip start",
    22: "flip end",
    25: "home set",
    28: "not landed",
    30: "autotune initialised",
    33: "autotune success",
    34: "autotune failed",
    41: "fence enabled",
    42: "fence disabled",
    49: "parachute disabled",
    50: "parachute enabled",
    51: "parachute released",
    54: "motors emergency stopped",
    55: "motors emergency stop cleared",
    56: "motor interlock disabled",
    57: "motor interlock enabled",
    60: "EKF altitude reset",
    61: "landing cancelled by pilot",
    62: "EKF yaw reset",
}
"""Source: ArduPilot AP_Logger.h, enum LogEvent."""
_SUBSYSTEMS = {
    2: "radio",
    3: "compass",
    5: "radio failsafe",
    6: "battery failsafe",
    8: "ground station failsafe",
    9: "fence failsafe",
    10: "flight mode",
    11: "GPS",
    12: "crash check",
    13: "flip",
    15: "parachute",
    16: "EKF check",
    17: "EKF failsafe",
    18: "barometer",
    19: "processor",
    20: "ADS-B failsafe",
    21: "terrain",
    22: "navigation",
    23: "terrain failsafe",
    24: "EKF primary",
    25: "thrust loss",
}
"""Source: ArduPilot AP_Logger.h, enum class LogErrorSubsystem."""
_ABSOLUTE, _RELATIVE = 0, 3  # MAV_FRAME
_LIST_GAP_S = 5.0  # a list that is not continued for this time is incomplete [s]


class EventExtractor:
    """Extract the events of one pass, block by block."""

    def __init__(self, vehicle: str) -> None:
        self._modes: dict[int, str] = mavutil.mode_mapping_bynumber(_MAV_TYPE.get(vehicle, -1)) or {}
        self._mode = ""
        self._armed: bool | None = None
        self._mission = _MissionExtractor()
        self._extractors: dict[str, Callable[[Records], Iterator[OnboardEvent]]] = {
            "MODE": self._mode_events,
            "ARM": self._arming_events,
            "STAT": self._arming_events,
            "EV": _flight_events,
            "ERR": _error_events,
            "MSG": _text_events,
            "PARM": _parameter_events,
            "CMD": self._mission.events,
        }

    def extract(self, block: list[Records], last: bool = False) -> list[OnboardEvent]:
        """Return the events of a block in time order."""
        events = [
            event
            for records in block
            if (extractor := self._extractors.get(records.format_.name)) is not None
            for event in _extract(extractor, records)
        ]
        if last:
            events += self._mission.finish()
        return [s for s in sorted(events, key=lambda s: s.t) if self._is_change(s)]

    def executed_items(self, records: Records) -> Records:
        """Return the CMD messages of executed items, without mission lists."""
        return records.select(self._mission.executed_mask(records))

    def _is_change(self, event: OnboardEvent) -> bool:
        if event.kind == "armed":
            previous, self._armed = self._armed, event.value
            return previous is not event.value
        if event.kind == "mode":
            previous_mode, self._mode = self._mode, event.value
            return previous_mode != event.value
        return True

    def _mode_events(self, records: Records) -> Iterator[OnboardEvent]:
        names = records.texts("Mode") if records.has("Mode") else [""] * len(records)
        numbers = records.ModeNum if records.has("ModeNum") else records.Mode
        for t, logged_name, number in zip(records.t, names, numbers, strict=True):
            has_name = bool(logged_name) and not logged_name.lstrip("-").isdigit()
            if has_name or math.isfinite(number):
                name = logged_name if has_name else self._modes.get(int(number), f"Mode({int(number)})")
                yield OnboardEvent(float(t), "mode", name.upper() if has_name else name)

    def _arming_events(self, records: Records) -> Iterator[OnboardEvent]:
        states = records.ArmState if records.has("ArmState") else records.Armed
        for t, state in zip(records.t, states, strict=True):
            if state in (0, 1):
                yield OnboardEvent(float(t), "armed", bool(state))


def _extract(extractor: Callable[[Records], Iterator[OnboardEvent]], records: Records) -> list[OnboardEvent]:
    try:
        return list(extractor(records))
    except (AttributeError, ValueError):  # columns of another ArduPilot release
        return []


def _flight_events(records: Records) -> Iterator[OnboardEvent]:
    for t, event_id in zip(records.t, records.Id, strict=True):
        if event_id in (_ARMED, _DISARMED):
            yield OnboardEvent(float(t), "armed", bool(event_id == _ARMED))
        if math.isfinite(event_id):
            meaning = _EVENTS.get(int(event_id), "of unknown meaning")
            yield OnboardEvent(float(t), "text", (SEVERITY_TEXT, f"EV {int(event_id)} {meaning}"))


def _error_events(records: Records) -> Iterator[OnboardEvent]:
    for t, subsystem, code in zip(records.t, records.Subsys, records.ECode, strict=True):
        if math.isfinite(subsystem) and math.isfinite(code):
            name = _SUBSYSTEMS.get(int(subsystem), "unknown")
            text = f"ERR subsystem {int(subsystem)} code {int(code)} ({name})"
            yield OnboardEvent(float(t), "text", (SEVERITY_ERROR, text))


def _text_events(records: Records) -> Iterator[OnboardEvent]:
    for t, text in zip(records.t, records.texts("Message"), strict=True):
        if text.startswith(("Throttle armed", "Throttle disarmed", "Arming motors", "Disarming motors")):
            yield OnboardEvent(float(t), "armed", "disarm" not in text.lower())
        if text:
            yield OnboardEvent(float(t), "text", (SEVERITY_TEXT, text))


def _parameter_events(records: Records) -> Iterator[OnboardEvent]:
    for t, name, value in zip(records.t, records.texts("Name"), records.Value, strict=True):
        if _NAME.fullmatch(name) and math.isfinite(value):
            yield OnboardEvent(float(t), "param", (name, float(value)))


class _MissionExtractor:
    """Evaluate CMD: a sequence from item 0 (home) to the end is a mission list; any other CMD is an executed item.

    An executed item that the list lacks is added to it: a log that starts in flight has no list, others a part of it.
    """

    def __init__(self) -> None:
        self._items: dict[int, Item] = {}
        self._next_seq: int | None = None  # next item of the list in progress
        self._t = 0.0
        self._learned: LearnedMission | None = None  # with the executed items
        self._total = 0  # number of items on board, 0 if unknown
        self._latest: tuple[Item, ...] = ()
        self._listed: dict[int, np.ndarray] = {}  # by id of this block's records: mask of list items

    def events(self, records: Records) -> Iterator[OnboardEvent]:
        self._listed = {id(records): np.zeros(len(records), bool)}
        item_total = records.CTot
        for i, (t, item) in enumerate(zip(records.t, _items(records), strict=True)):
            if item is None:
                continue
            if self._next_seq is not None and t - self._t > _LIST_GAP_S:
                yield from self.finish()  # not continued: incomplete
            if item.seq == 0:
                yield from self.finish()
                self._next_seq = 0
            if item.seq != self._next_seq:
                yield from self._merge(item, float(t), item_total[i])
                continue
            self._listed[id(records)][i] = True
            self._items[item.seq] = item
            self._next_seq, self._t = item.seq + 1, float(t)
            self._total = _total(item_total[i])
            if self._next_seq >= item_total[i] or self._next_seq >= MAX_ITEMS:
                yield from self.finish()

    def executed_mask(self, records: Records) -> np.ndarray:
        return ~self._listed.get(id(records), np.zeros(len(records), bool))

    def finish(self) -> Iterator[OnboardEvent]:
        items, self._items, self._next_seq = tuple(self._items.values()), {}, None
        if items and items != self._latest:
            self._latest, self._learned = items, None
            yield self._event(self._t)

    def _merge(self, executed: Item, t: float, total: float) -> Iterator[OnboardEvent]:
        """Add an executed item that the list lacks; a list still being logged has priority."""
        if self._next_seq is not None:
            return
        if any(item.seq == executed.seq for item in self._latest):
            return
        if self._learned is None:
            self._learned = LearnedMission()
            for item in self._latest:
                self._learned.add_known(item)
        self._learned.add(executed)
        self._total = _total(total)
        self._latest = tuple(item for item in self._learned.items if not self._total or item.seq < self._total)
        yield self._event(t)

    def _event(self, t: float) -> OnboardEvent:
        if len(self._latest) >= self._total > 0:
            return OnboardEvent(t, "mission", self._latest)
        return OnboardEvent(t, "partial mission", (self._latest, self._total))


def _total(value: float) -> int:
    """Return a number of items; 0 for an implausible one."""
    return int(value) if 0 < value <= MAX_ITEMS else 0


def _items(records: Records) -> Iterator[Item | None]:
    names = ("CNum", "CId", "Prm1", "Prm2", "Prm3", "Prm4", "Lat", "Lng", "Alt", "Frame")
    n = len(records)
    columns = [getattr(records, name).tolist() if records.has(name) else [None] * n for name in names]
    for values in zip(*columns, strict=True):
        yield _item(values)


def _item(values: tuple[Any, ...]) -> Item | None:
    if not all(value is None or math.isfinite(value) for value in values[:2] + values[6:]):
        return None
    seq, command, *params, lat, lon, alt, frame = values
    if not 0 <= seq < MAX_ITEMS or abs(lat) > 90 or abs(lon) > 180:
        return None
    if frame is None:  # not logged before 2016: home is absolute, other items are relative
        frame = _ABSOLUTE if seq == 0 else _RELATIVE
    finite = [0.0 if param is None or not math.isfinite(param) else param for param in params]
    return Item.at((lat, lon, alt), seq=int(seq), command=int(command), frame=int(frame), params=finite)
