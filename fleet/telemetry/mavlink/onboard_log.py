"""Common output format of the onboard log readers (DataFlash, ULog)."""

from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol

import numpy as np

FieldRows = dict[str, tuple[np.ndarray, np.ndarray]]
"""`Sample` field -> (times (n,) [s], rising; values (n, k) in the units of `contract.COLUMNS`)."""


class OnboardEvent(NamedTuple):
    """Log entry that is not a telemetry row."""

    t: float  # log time [s]
    kind: str  # one of those below
    value: Any
    """Of mode: name · armed: bool · param: (name, value) · text: (severity, text) · mission: tuple[Item, ...] ·
    home: (latitude, longitude [deg], altitude above sea level [m]), latitude and longitude nan where unknown ·
    partial mission: (tuple[Item, ...], number of items on board, 0 unknown)"""


class Chunk(NamedTuple):
    """A time range of a log; consecutive chunks may overlap by about 1 s."""

    rows: FieldRows
    events: list[OnboardEvent]  # in time order
    counts: dict[str, int]  # messages of each name


class OnboardLog(Protocol):
    """Opened log of one aircraft: its identity, and its content in log time."""

    name: str  # file name for texts
    system: int  # MAVLink system id, 1 if not in the log
    autopilot: str  # as `Status.autopilot`
    vehicle: str  # as `Status.vehicle`
    firmware: str  # as in the log, or empty
    epoch_s: float | None  # fleet time minus log time [s]; None without GNSS time
    skipped: list[str]  # unreadable parts and their positions, filled while reading

    def chunks(self) -> Iterator[Chunk]:
        """Return the log from its beginning; may be called again."""
