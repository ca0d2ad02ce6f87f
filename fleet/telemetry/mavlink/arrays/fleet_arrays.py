"""Array state of the aircraft of one link or log: clocks, row arbitration, pending rows, counters."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fleet.bus.codec import Wire
from fleet.contract import Sample
from fleet.telemetry.mavlink.arrays.counts import Counts
from fleet.telemetry.mavlink.arrays.pack import FIELDS
from fleet.telemetry.mavlink.arrays.row_arbiter import KEPT, REFUSED, new_memory, settle
from fleet.telemetry.mavlink.arrays.rows import WIDEST, Shelves
from fleet.telemetry.tables import clock


class Laid(NamedTuple):
    """Rows of many aircraft in order of reception."""

    owner: np.ndarray  # number of the aircraft, (n,)
    arrival: np.ndarray  # fleet time, (n,) [s since 1970]
    raw_s: np.ndarray  # time stamp of the message, (n,) [s]
    values: np.ndarray  # columns, padded with zeros, (n, 8)
    tick: np.ndarray  # time source, (n,)
    field: np.ndarray  # number in `FIELDS`, (n,)
    rank: np.ndarray  # rank of the source, (n,)
    given: np.ndarray  # number in `FIELDS` of the required active field, or `NO_FIELD`, (n,)


class Judged(NamedTuple):
    """Result of the arbitration, by aircraft."""

    jumped: np.ndarray  # arrival at the last jump of the clock; nan: none, (m,) [s since 1970]
    refused: np.ndarray  # number of rejected rows, (m,)
    newest: np.ndarray  # arrival of the last row, (m,) [s since 1970]
    advanced: np.ndarray  # by row: forward re-anchoring step of the clock, mostly 0, (n,) [s]


class Flock:
    """State of many aircraft, numbered in order of registration.

    Args:
        names: names of the counted messages
    """

    def __init__(self, names: Sequence[str] = ()) -> None:
        self.counts, self.shelves = Counts(names), Shelves()
        self.clocks = np.empty((0, *clock.new_clocks().shape))
        self.look = np.empty(0)  # latest time of the next messages other than rows, (m,) [s since 1970]
        self._memory = np.empty((0, *new_memory().shape))

    def add(self, uav: int) -> int:
        """Add one aircraft; return its number."""
        self.counts.add()
        self.shelves.add(uav)
        self.look = np.append(self.look, -np.inf)
        self.clocks = np.concatenate([self.clocks, clock.new_clocks()[None]])
        self._memory = np.concatenate([self._memory, new_memory()[None]])
        return len(self.clocks) - 1

    def reset(self, number: int) -> None:
        """Reset one aircraft; it has no messages until data arrive."""
        self.counts.reset(number)
        self.clocks[number], self._memory[number] = clock.new_clocks(), new_memory()
        self.shelves.refused[number] = 0
        self.look[number] = np.inf

    def judge(self, laid: Laid) -> Judged:
        """Assign fleet times to rows and store accepted rows; late, repeated and lower-ranked rows are skipped."""
        n, many = len(laid.owner), len(self.clocks)
        t, fate, jumped = np.empty(n), np.empty(n, np.int8), np.full(many, np.nan)
        advanced = np.empty(n)
        order = (laid.owner, laid.tick, laid.raw_s, laid.arrival, laid.field, laid.rank, laid.given)
        settle(self.clocks, self._memory, *order, t, fate, jumped, advanced)
        kept = np.flatnonzero(fate == KEPT)
        key = laid.owner[kept] * len(FIELDS) + laid.field[kept]
        self.shelves.lay(key, laid.arrival[kept], t[kept], laid.values[kept])
        newest = np.full(many, np.nan)
        newest[laid.owner] = laid.arrival
        return Judged(jumped, np.bincount(laid.owner[fate == REFUSED], minlength=many), newest, advanced)

    def lay(self, number: int, field: str, t: np.ndarray, x: np.ndarray) -> None:
        """Add rows of one field that already have fleet times.

        Args:
            number: number of the aircraft
            field: field of `Sample`
            t: fleet time, increasing and later than all earlier rows, (n,) [s since 1970]
            x: values, (n, k)
        """
        wide = np.pad(x, ((0, 0), (0, WIDEST - x.shape[1])))
        self.shelves.lay(np.full(len(t), number * len(FIELDS) + FIELDS.index(field)), t, t, wide)

    def due(self, now: float) -> list[int]:
        """Return the numbers of aircraft with messages other than rows at `now` [s since 1970]."""
        return np.flatnonzero(self.look <= now).tolist()

    def take(self, now: float) -> dict[int, Wire]:
        """Return the samples of rows received up to `now` [s since 1970], by aircraft number."""
        self.counts.upto(now)
        uavs = self.shelves.uavs
        return {number: Wire(Sample, int(uavs[number]), told, t) for number, told, t in self.shelves.take(now)}
