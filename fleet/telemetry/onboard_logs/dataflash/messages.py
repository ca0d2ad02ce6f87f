"""Extract events of a DataFlash log: modes, arming, parameters, missions, texts."""

import math
import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.contract import MAX_ITEMS, Item
from fleet.telemetry.mavlink.heartbeat import FIXED_WING, HELICOPTER, MULTIROTOR, QUADPLANE
from fleet.telemetry.mavlink.onboard_log import Said
from fleet.telemetry.onboard_logs.dataflash.records import Records

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


class Talk:
    """Extract the events of one pass, block by block."""

    def __init__(self, vehicle: str) -> None:
        self._modes: dict[int, str] = mavutil.mode_mapping_bynumber(_MAV_TYPE.get(vehicle, -1)) or {}
        self._mode = ""
        self._armed: bool | None = None
        self._mission = _Mission()
        self._tellers: dict[str, Callable[[Records], Iterator[Said]]] = {
            "MODE": self._tell_modes,
            "ARM": self._tell_arming,
            "STAT": self._tell_arming,
            "EV": _tell_events,
            "ERR": _tell_errors,
            "MSG": _tell_texts,
            "PARM": _tell_parameters,
            "CMD": self._mission.tell,
        }

    def take(self, block: list[Records], last: bool = False) -> list[Said]:
        """Return the events of a block in time order."""
        said = [s for r in block if (tell := self._tellers.get(r.form.name)) is not None for s in _heard(tell, r)]
        if last:
            said += self._mission.end()
        return [s for s in sorted(said, key=lambda s: s.t) if self._is_news(s)]

    def carried_out(self, records: Records) -> Records:
        """Return the CMD messages of executed items, without mission lists."""
        return records.taken(self._mission.carried_out(records))

    def _is_news(self, said: Said) -> bool:
        if said.what == "armed":
            known, self._armed = self._armed, said.value
            return known is not said.value
        if said.what == "mode":
            before, self._mode = self._mode, said.value
            return before != said.value
        return True

    def _tell_modes(self, r: Records) -> Iterator[Said]:
        words = r.texts("Mode") if r.has("Mode") else [""] * len(r)
        numbers = r.ModeNum if r.has("ModeNum") else r.Mode
        for t, word, number in zip(r.t, words, numbers, strict=True):
            named = bool(word) and not word.lstrip("-").isdigit()
            if named or math.isfinite(number):
                name = word if named else self._modes.get(int(number), f"Mode({int(number)})")
                yield Said(float(t), "mode", name.upper() if named else name)

    def _tell_arming(self, r: Records) -> Iterator[Said]:
        states = r.ArmState if r.has("ArmState") else r.Armed
        for t, state in zip(r.t, states, strict=True):
            if state in (0, 1):
                yield Said(float(t), "armed", bool(state))


def _heard(tell: Callable[[Records], Iterator[Said]], records: Records) -> list[Said]:
    try:
        return list(tell(records))
    except (AttributeError, ValueError):  # columns of another ArduPilot release
        return []


def _tell_events(r: Records) -> Iterator[Said]:
    for t, event in zip(r.t, r.Id, strict=True):
        if event in (_ARMED, _DISARMED):
            yield Said(float(t), "armed", bool(event == _ARMED))
        if math.isfinite(event):
            words = _EVENTS.get(int(event), "of unknown meaning")
            yield Said(float(t), "text", (SEVERITY_TEXT, f"EV {int(event)} {words}"))


def _tell_errors(r: Records) -> Iterator[Said]:
    for t, subsystem, code in zip(r.t, r.Subsys, r.ECode, strict=True):
        if math.isfinite(subsystem) and math.isfinite(code):
            words = _SUBSYSTEMS.get(int(subsystem), "unknown")
            text = f"ERR subsystem {int(subsystem)} code {int(code)} ({words})"
            yield Said(float(t), "text", (SEVERITY_ERROR, text))


def _tell_texts(r: Records) -> Iterator[Said]:
    for t, text in zip(r.t, r.texts("Message"), strict=True):
        if text.startswith(("Throttle armed", "Throttle disarmed", "Arming motors", "Disarming motors")):
            yield Said(float(t), "armed", "disarm" not in text.lower())
        if text:
            yield Said(float(t), "text", (SEVERITY_TEXT, text))


def _tell_parameters(r: Records) -> Iterator[Said]:
    for t, name, value in zip(r.t, r.texts("Name"), r.Value, strict=True):
        if _NAME.fullmatch(name) and math.isfinite(value):
            yield Said(float(t), "param", (name, float(value)))


class _Mission:
    """Evaluate CMD: a sequence from item 0 (home) to the end is a mission list; any other CMD is an executed item."""

    def __init__(self) -> None:
        self._items: dict[int, Item] = {}
        self._next: int | None = None  # next item of the list in progress
        self._t = 0.0
        self._last: tuple[Item, ...] = ()
        self._listed: dict[int, np.ndarray] = {}  # by id of this block's records: mask of list items

    def tell(self, r: Records) -> Iterator[Said]:
        self._listed = {id(r): np.zeros(len(r), bool)}
        total = r.CTot
        for i, (t, item) in enumerate(zip(r.t, _items(r), strict=True)):
            if item is None:
                continue
            if item.seq == 0:
                yield from self.end()
                self._next = 0
            if item.seq != self._next:
                continue
            self._listed[id(r)][i] = True
            self._items[item.seq] = item
            self._next, self._t = item.seq + 1, float(t)
            if self._next >= total[i] or self._next >= MAX_ITEMS:
                yield from self.end()

    def carried_out(self, r: Records) -> np.ndarray:
        return ~self._listed.get(id(r), np.zeros(len(r), bool))

    def end(self) -> Iterator[Said]:
        items, self._items, self._next = tuple(self._items.values()), {}, None
        if items and items != self._last:
            self._last = items
            yield Said(self._t, "mission", items)


def _items(r: Records) -> Iterator[Item | None]:
    names = ("CNum", "CId", "Prm1", "Prm2", "Prm3", "Prm4", "Lat", "Lng", "Alt", "Frame")
    n = len(r)
    columns = [getattr(r, name).tolist() if r.has(name) else [None] * n for name in names]
    for values in zip(*columns, strict=True):
        yield _item(values)


def _item(values: tuple[Any, ...]) -> Item | None:
    if not all(v is None or math.isfinite(v) for v in values[:2] + values[6:]):
        return None
    seq, command, *params, lat, lon, alt, frame = values
    if not 0 <= seq < MAX_ITEMS or abs(lat) > 90 or abs(lon) > 180:
        return None
    if frame is None:  # not logged before 2016: home is absolute, other items are relative
        frame = _ABSOLUTE if seq == 0 else _RELATIVE
    p1, p2, p3, p4 = (0.0 if p is None or not math.isfinite(p) else p for p in params)
    return Item(
        seq=int(seq),
        command=int(command),
        frame=int(frame),
        param1=p1,
        param2=p2,
        param3=p3,
        param4=p4,
        lat_e7=round(lat * 1e7),
        lon_e7=round(lon * 1e7),
        alt_m=alt,
    )
