"""Wanted message rates, and the share of them that fits a link."""

from collections.abc import Collection

import numpy as np

from fleet.telemetry.mavlink.aircraft_link import AircraftLink
from fleet.telemetry.mavlink.parsing.decode import layout
from gateway.record.tape import format_size, read_size
from gateway.settings.link_spec import LinkSpec

WANTED_HZ: dict[str, float] = {  # [Hz]
    "ATTITUDE": 25,
    "SERVO_OUTPUT_RAW": 20,
    "GLOBAL_POSITION_INT": 10,
    "VFR_HUD": 10,
    "NAV_CONTROLLER_OUTPUT": 5,
    "MISSION_CURRENT": 1,
}
MIN_SHARE = 0.1  # minimum share of the wanted rates: lower rates are not useful
DEFAULT_BUDGET = "1M"  # default rate that the aircraft of one link may send together [bytes/s]
_FRAME_BYTES = 12  # bytes of a frame without payload
_SERIAL_SHARE = 0.7  # share of a serial line that telemetry may fill
_HYSTERESIS = 0.15  # smaller relative changes of the share are ignored


def budget_of(spec: LinkSpec, text: str = "") -> float:
    """Return the rate that aircraft may send on a link [bytes/s]: as specified, or the default of its kind.

    Raises:
        ValueError: when `text` is not a size.
    """
    if text or spec.kind != "serial":
        return float(read_size(text or DEFAULT_BUDGET, "--budget"))
    return _SERIAL_SHARE * spec.port / 10  # ten bits per byte


def size_of(name: str) -> int:
    """Return the length of a message on the wire without truncation [bytes]."""
    return _FRAME_BYTES + layout(name).itemsize


WANTED_BYTES_S = sum(hz * size_of(name) for name, hz in WANTED_HZ.items())
"""Data rate of the wanted messages of one aircraft [bytes/s]."""


class RateShare:
    """Share of the wanted rates that fits a link, the same for all of its aircraft.

    Args:
        budget: rate that they may send together [bytes/s]
    """

    def __init__(self, budget: float) -> None:
        self.value = 1.0
        self.sentence = ""
        self._budget = budget

    def update(self, all_aircraft: Collection[AircraftLink]) -> float:
        """Return the share for these aircraft; messages that were not requested use part of the budget."""
        unrequested = sum(
            hz * size_of(name)
            for aircraft in all_aircraft
            for name, hz in aircraft.rates.items()
            if name not in WANTED_HZ
        )
        wanted = WANTED_BYTES_S * len(all_aircraft)
        fitting = float(np.clip((self._budget - unrequested) / wanted, MIN_SHARE, 1.0)) if all_aircraft else 1.0
        if abs(fitting - self.value) > _HYSTERESIS * self.value or (fitting == 1.0) != (self.value == 1.0):
            self.value = fitting
        self.sentence = ""
        if self.value < 1.0:
            required = format_size(wanted + unrequested)
            self.sentence = (
                f"{len(all_aircraft)} aircraft would send {required}/s, the budget is {format_size(self._budget)}/s: "
                f"{self.value:.0%} of the wanted rates are requested; raise --budget if the link has more capacity"
            )
        return self.value
