"""Message filter of a link: by message, system and component."""

from typing import NamedTuple

import numpy as np

from fleet.telemetry.mavlink.parsing.decode import IDS
from fleet.telemetry.mavlink.parsing.scan import COMPONENT, ID, SYSTEM

COLUMNS = {"messages": ID, "systems": SYSTEM, "components": COMPONENT}
"""Setting of a link -> column of a frame that it tests; the prefix `no-` inverts it."""
EXCLUDE = "no-"
SETTINGS = (*COLUMNS, *(EXCLUDE + name for name in COLUMNS))
_MAX_NUMBER = {"messages": 0xFF_FFFF, "systems": 255, "components": 255}


class MessageFilter(NamedTuple):
    """Filter of frames: a frame must satisfy every rule."""

    rules: tuple[tuple[int, bool, tuple[int, ...]], ...] = ()  # column, include (True) or exclude, numbers

    def passes(self, frames: np.ndarray) -> np.ndarray:
        """Return whether each frame passes, (n,) bool; `frames` is `Frames.at`, (n, 8)."""
        passed = np.ones(len(frames), bool)
        for column, include, numbers in self.rules:
            passed &= np.isin(frames[:, column], numbers) == include
        return passed


def read_filter(settings: dict[str, str]) -> MessageFilter:
    """Parse and remove filter rules from the settings of a link, e.g. `no-messages=STATUSTEXT,30&systems=1-50`.

    Raises:
        ValueError: when a name or a number is invalid.
    """
    rules = []
    for name in SETTINGS:
        if name in settings:
            setting = name.removeprefix(EXCLUDE)
            rules.append((COLUMNS[setting], setting == name, _read_numbers(setting, settings.pop(name))))
    return MessageFilter(tuple(rules))


def _read_numbers(name: str, text: str) -> tuple[int, ...]:
    numbers: set[int] = set()
    for part in text.split(","):
        low, _, high = part.partition("-")
        if name == "messages" and part.upper() in IDS:
            numbers.add(IDS[part.upper()])
        elif low.isdecimal() and (high or low).isdecimal() and int(low) <= int(high or low) <= _MAX_NUMBER[name]:
            numbers.update(range(int(low), int(high or low) + 1))
        else:
            names = "names or " if name == "messages" else ""
            raise ValueError(
                f"{name}: found {part!r}, expected {names}numbers up to {_MAX_NUMBER[name]} with commas; "
                "correct the link"
            )
    return tuple(sorted(numbers))
