"""The aircraft of one link, or the one of a log: clocks, judgement of rows, rows that wait, counters."""

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
    """Rows of many aircraft in the order they were heard."""

    owner: np.ndarray  # number of the aircraft, (n,)
    arrival: np.ndarray  # fleet time, (n,) [s since 1970]
    raw_s: np.ndarray  # own time, (n,) [s]
    values: np.ndarray  # columns, zeros where a field has fewer, (n, 8)
    tick: np.ndarray  # clock the own time is of, (n,)
    field: np.ndarray  # number in `FIELDS`, (n,)
    rank: np.ndarray  # of the source, (n,)
    given: np.ndarray  # number in `FIELDS` of what must flow for the row to count, or `settle.NO_FIELD`, (n,)


class Judged(NamedTuple):
    """What came of rows, by aircraft."""

    jumped: np.ndarray  # arrival at the last jump of the clock; nan: none, (m,) [s since 1970]
    refused: np.ndarray  # rows refused, (m,)
    newest: np.ndarray  # arrival of the last row, (m,) [s since 1970]
    advanced: np.ndarray  # by row: step by which the clock was re-anchored forward there, mostly 0, (n,) [s]


class Flock:
    """State of many aircraft, numbered in the order they came.

    Args:
        names: of the kinds of messages that are counted
    """

    def __init__(self, names: Sequence[str] = ()) -> None:
        self.counts, self.shelves = Counts(names), Shelves()
        self.clocks = np.empty((0, *clock.new_clocks().shape))
        self.look = np.empty(0)  # when each has something to tell beside rows, at the latest (m,) [s since 1970]
        self._memory = np.empty((0, *new_memory().shape))

    def add(self, uav: int) -> int:
        """Take in one more aircraft; gives its number."""
        self.counts.add()
        self.shelves.add(uav)
        self.look = np.append(self.look, -np.inf)
        self.clocks = np.concatenate([self.clocks, clock.new_clocks()[None]])
        self._memory = np.concatenate([self._memory, new_memory()[None]])
        return len(self.clocks) - 1

    def reset(self, number: int) -> None:
        """Begin anew for one aircraft, which has nothing to tell until it is heard."""
        self.counts.reset(number)
        self.clocks[number], self._memory[number] = clock.new_clocks(), new_memory()
        self.shelves.refused[number] = 0
        self.look[number] = np.inf

    def judge(self, laid: Laid) -> Judged:
        """Return rows their time, put them in order, leave out the late, the repeated and the second best."""
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
        """Add rows of one kind that have their time already.

        Args:
            number: of the aircraft
            field: of `Sample`
            t: fleet time, rising and newer than what was laid before, (n,) [s since 1970]
            x: values, (n, k)
        """
        wide = np.pad(x, ((0, 0), (0, WIDEST - x.shape[1])))
        self.shelves.lay(np.full(len(t), number * len(FIELDS) + FIELDS.index(field)), t, t, wide)

    def due(self, now: float) -> list[int]:
        """Number the aircraft that have something to tell beside rows, at `now` [s since 1970]."""
        return np.flatnonzero(self.look <= now).tolist()

    def take(self, now: float) -> dict[int, Wire]:
        """Hand over the samples of what was heard up to `now` [s since 1970], by number of the aircraft."""
        self.counts.upto(now)
        uavs = self.shelves.uavs
        return {number: Wire(Sample, int(uavs[number]), told, t) for number, told, t in self.shelves.take(now)}
