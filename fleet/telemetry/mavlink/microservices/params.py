"""Collect autopilot parameters from PARAM_VALUE, requested by any station."""

import struct
import sys
from math import isfinite
from typing import Any

from fleet.contract import Params

UNSOLICITED = 65535  # index of an unsolicited value
HASH_NAME = "_HASH_CHECK"  # not a parameter: hash over all parameters
MAX_PARAMS = 5_000  # maximum number of parameters of one aircraft
PUBLISH_PERIOD_S = 1.0  # minimum time between two publications [s]
_INTEGER_LAYOUT = {1: "<Bxxx", 2: "<bxxx", 3: "<Hxx", 4: "<hxx", 5: "<I", 6: "<i"}  # MAV_PARAM_TYPE


class ParamCollector:
    """Parameters of one aircraft: values by name, and missing indices."""

    def __init__(self, uav: int) -> None:
        self.uav = uav
        self.values: dict[str, float] = {}
        self.rejected = 0
        self.last_arrival = float("-inf")  # arrival of the last PARAM_VALUE
        self.count = 0  # number of parameters reported by the aircraft, 0 if unknown
        self.hash: float | None = None  # hash over all parameters reported by PX4
        self._indices: set[int] = set()
        self._rejected_names: dict[str, None] = {}
        self._changed = False
        self._published_t = float("-inf")

    def process(self, message: Any, autopilot: str, now: float) -> None:
        """Process one PARAM_VALUE."""
        name, value = message.param_id, as_number(message, autopilot)
        self.last_arrival = now
        if name == HASH_NAME:
            self.hash = value
            return
        has_index = message.param_index != UNSOLICITED
        if message.param_count <= MAX_PARAMS and (has_index or not self.count):
            if message.param_count != self.count:
                self.count = message.param_count
                self._changed = True
            if has_index and message.param_index < self.count:
                self._indices.add(message.param_index)
        self.set_value(name, value)

    def set_value(self, name: str, value: float) -> None:
        """Set one parameter by name."""
        if not name or not name.isprintable() or (len(self.values) >= MAX_PARAMS and name not in self.values):
            self.rejected += 1
        elif not isfinite(value):
            self.rejected += 1
            self._changed = self._changed or name not in self._rejected_names
            self._rejected_names[name] = None
            self.values.pop(name, None)
        elif self.values.get(name) != value:
            self.values[sys.intern(name)] = value  # all aircraft share the name strings
            self._rejected_names.pop(name, None)
            self._changed = True

    def restore(self, values: dict[str, float], count: int) -> None:
        """Restore all parameters from a verified cache."""
        self.values, self.count, self._indices, self._changed = dict(values), count, set(range(count)), True

    @property
    def complete(self) -> bool:
        """Return whether every index was received."""
        return self.count > 0 and len(self._indices) >= self.count

    def missing(self) -> list[int] | None:
        """Return the missing indices; None if the number of parameters is unknown."""
        if not self.count:
            return None
        return [index for index in range(self.count) if index not in self._indices]

    def take_update(self, now: float) -> Params | None:
        """Return changed parameters, at most once per second."""
        if not self._changed or now - self._published_t < PUBLISH_PERIOD_S:
            return None
        self._changed, self._published_t, sentence = False, now, ""
        if self._rejected_names:
            names = ", ".join(list(self._rejected_names)[:5])
            sentence = f"uav-{self.uav}: parameter {names} is not a number and was ignored; set it on the autopilot"
        return Params(uav=self.uav, t=now, values=dict(self.values), complete=self.complete, sentence=sentence)


def as_number(message: Any, autopilot: str) -> float:
    """Return the numeric value: PX4 sends integer bytes in the float field, other autopilots convert."""
    layout = _INTEGER_LAYOUT.get(message.param_type)
    if autopilot != "px4" or layout is None:
        return float(message.param_value)
    return float(struct.unpack(layout, struct.pack("<f", message.param_value))[0])
