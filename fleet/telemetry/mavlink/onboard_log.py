"""What an onboard log (DataFlash, ULog) says, whoever wrote it: the form both readers deliver."""

from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol

import numpy as np

Table = dict[str, tuple[np.ndarray, np.ndarray]]
"""`Sample` field -> (times (n,) [s], rising; values (n, k) in the units of `contract.COLUMNS`)."""


class Said(NamedTuple):
    """Something a log says that is no row."""

    t: float  # log time [s]
    what: str  # mode: name · armed: bool · param: (name, value) · mission: tuple[Item, ...] · text: (severity, text)
    value: Any


class Chunk(NamedTuple):
    """A stretch of a log; chunks follow each other in time, return or take a second."""

    rows: Table
    said: list[Said]  # rising in time
    counts: dict[str, int]  # messages of each name


class OnboardLog(Protocol):
    """One aircraft's own log, opened: who it is, and what it says in log time."""

    name: str  # of the file, for sentences
    system: int  # MAVLink system id, 1 where the log does not say
    autopilot: str  # as `Status.autopilot`
    vehicle: str  # as `Status.vehicle`
    firmware: str  # as the log words it, or empty
    epoch_s: float | None  # fleet time minus log time [s]; None where no satellite ever told
    skipped: list[str]  # what could not be read and where, filled while reading

    def chunks(self) -> Iterator[Chunk]:
        """Return the log from its beginning; may be called again."""
