"""Wanted message rates, and the share of them that fits a link."""

from collections.abc import Collection

import numpy as np

from fleet.telemetry.mavlink.aircraft_link import Craft
from fleet.telemetry.mavlink.parsing.decode import layout
from gateway.record.size import in_words, read_size
from gateway.settings.link_spec import Spec

WANTED_HZ: dict[str, float] = {  # [Hz]
    "ATTITUDE": 25,
    "SERVO_OUTPUT_RAW": 20,
    "GLOBAL_POSITION_INT": 10,
    "VFR_HUD": 10,
    "NAV_CONTROLLER_OUTPUT": 5,
    "MISSION_CURRENT": 1,
}
LEAST = 0.1  # minimum share of the wanted rates: lower rates are not useful
BUDGET = "1M"  # default rate that the aircraft of one link may send together [bytes/s]
_FRAME = 12  # bytes of a frame without payload
_RADIO = 0.7  # share of a serial line that telemetry may fill
_STEADY = 0.15  # smaller relative changes of the share are ignored


def budget_of(spec: Spec, text: str = "") -> float:
    """Return the rate that aircraft may send on a link [bytes/s]: as specified, or the default of its kind.

    Raises:
        ValueError: when `text` is not a size.
    """
    if text or spec.kind != "serial":
        return float(read_size(text or BUDGET, "--budget"))
    return _RADIO * spec.port / 10  # ten bits per byte


def size_of(name: str) -> int:
    """Return the length of a message on the wire without truncation [bytes]."""
    return _FRAME + layout(name).itemsize


WANTED_BYTES_S = sum(hz * size_of(name) for name, hz in WANTED_HZ.items())
"""Data rate of the wanted messages of one aircraft [bytes/s]."""


class Share:
    """Share of the wanted rates that fits a link, the same for all of its aircraft.

    Args:
        budget: rate that they may send together [bytes/s]
    """

    def __init__(self, budget: float) -> None:
        self.now = 1.0
        self.sentence = ""
        self._budget = budget

    def weigh(self, crafts: Collection[Craft]) -> float:
        """Return the share for these aircraft; messages that were not requested use part of the budget."""
        unasked = sum(
            hz * size_of(name) for craft in crafts for name, hz in craft.rates.items() if name not in WANTED_HZ
        )
        wanted = WANTED_BYTES_S * len(crafts)
        fits = float(np.clip((self._budget - unasked) / wanted, LEAST, 1.0)) if crafts else 1.0
        if abs(fits - self.now) > _STEADY * self.now or (fits == 1.0) != (self.now == 1.0):
            self.now = fits
        self.sentence = ""
        if self.now < 1.0:
            need = in_words(wanted + unasked)
            self.sentence = (
                f"{len(crafts)} aircraft would send {need}/s, the budget is {in_words(self._budget)}/s: "
                f"{self.now:.0%} of the wanted rates are requested; raise --budget if the link has more capacity"
            )
        return self.now
