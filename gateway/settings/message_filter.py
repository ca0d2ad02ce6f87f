"""Message filter of a link: by message, system and component."""

from typing import NamedTuple

import numpy as np

from fleet.telemetry.mavlink.parsing.decode import IDS
from fleet.telemetry.mavlink.parsing.scan import COMPONENT, ID, SYSTEM

COLUMNS = {"messages": ID, "systems": SYSTEM, "components": COMPONENT}
"""Setting of a link -> column of a frame that it tests; the prefix `no-` inverts it."""
NO = "no-"
SETTINGS = (*COLUMNS, *(NO + name for name in COLUMNS))
_HIGHEST = {"messages": 0xFF_FFFF, "systems": 255, "components": 255}


class Sieve(NamedTuple):
    """Filter of frames: a frame must satisfy every rule."""

    rules: tuple[tuple[int, bool, tuple[int, ...]], ...] = ()  # column, include (True) or exclude, numbers

    def keep(self, at: np.ndarray) -> np.ndarray:
        """Return whether each frame passes, (n,) bool; `frames` is `Frames.at`, (n, 8)."""
        kept = np.ones(len(at), bool)
        for column, these, numbers in self.rules:
            kept &= np.isin(at[:, column], numbers) == these
        return kept


def read_sieve(settings: dict[str, str]) -> Sieve:
    """Parse and remove filter rules from the settings of a link, e.g. `no-messages=STATUSTEXT,30&systems=1-50`.

    Raises:
        ValueError: when a name or a number is invalid.
    """
    rules = []
    for name in SETTINGS:
        if name in settings:
            plain = name.removeprefix(NO)
            rules.append((COLUMNS[plain], plain == name, _numbers(plain, settings.pop(name))))
    return Sieve(tuple(rules))


def _numbers(name: str, text: str) -> tuple[int, ...]:
    found: set[int] = set()
    for word in text.split(","):
        low, _, high = word.partition("-")
        if name == "messages" and word.upper() in IDS:
            found.add(IDS[word.upper()])
        elif low.isdecimal() and (high or low).isdecimal() and int(low) <= int(high or low) <= _HIGHEST[name]:
            found.update(range(int(low), int(high or low) + 1))
        else:
            names = "names or " if name == "messages" else ""
            raise ValueError(
                f"{name}: found {word!r}, expected {names}numbers up to {_HIGHEST[name]} with commas; correct the link"
            )
    return tuple(sorted(found))
