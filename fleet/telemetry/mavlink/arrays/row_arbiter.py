"""The compiled judge of aircraft's rows: each gets its fleet time; late, repeated and second-best ones go."""

from math import inf, isnan

import numba as nb
import numpy as np

from fleet.contract import COLUMNS
from fleet.telemetry.tables import clock as c

FIELDS = tuple(COLUMNS)
YIELD_S = 3.0  # a lower-ranked source speaks again after this silence of the better one [s]
SLOWER = 1.5  # a source with intervals this much longer than another's trickles: the other is heard
SMOOTH = 0.1  # weight of the newest interval in a source's usual one
RANKS = 4  # ranks are below this
LAST, HEARD, EVERY = 0, 1, 1 + RANKS  # columns of the memory: newest time kept; by rank: newest time, usual interval
NO_FIELD = -1
KEPT, PASSED_OVER, REFUSED = range(3)


def new_memory() -> np.ndarray:
    """Make what has to be remembered of one aircraft between two batches, (fields, EVERY + RANKS)."""
    return np.tile([-inf] * (1 + RANKS) + [inf] * RANKS, (len(FIELDS), 1))


@nb.njit(cache=True, nogil=True)
def settle(clocks, memory, owner, ticks, raw_s, arrival, field, rank, given, t, fate, jumped, advanced):
    """Judge rows in the order they were heard.

    Args:
        clocks, memory: of all aircraft, changed in place, (m, 3, LENGTH) and (m, fields, EVERY + RANKS)
        owner: number of the aircraft, (n,)
        ticks: clock each time comes from, (n,)
        raw_s: own times [s], arrival: fleet times [s since 1970], (n,)
        field: numbers in `FIELDS`, rank: of the source, (n,)
        given: number in `FIELDS` of what must flow for the row to count, or NO_FIELD, (n,)
        t: filled with fleet times, nan while a jump is suspected [s since 1970]
        fate: filled with KEPT, PASSED_OVER or REFUSED
        jumped: arrival of the last row at which a jump of the clock was noticed, by aircraft, (m,) [s since 1970]
        advanced: filled with the step by which a clock was re-anchored forward at this row, mostly 0, (n,) [s]
    """
    for i in range(len(t)):
        mine, fields = clocks[owner[i]], memory[owner[i]]
        known, ahead = _jumps(mine), _advance(mine)
        t[i] = c.tell(mine, ticks[i], raw_s[i], arrival[i])
        if _jumps(mine) != known:
            jumped[owner[i]] = arrival[i]
        advanced[i] = _advance(mine) - ahead
        if isnan(t[i]):
            fate[i] = REFUSED
        elif given[i] != NO_FIELD and t[i] > fields[given[i], LAST] + YIELD_S:
            fate[i] = PASSED_OVER
        else:
            fate[i] = _judge(fields[field[i]], rank[i], t[i], ticks[i] == c.NONE)


@nb.njit(cache=True, nogil=True)
def _jumps(clocks):
    return max(clocks[c.BOOT, c.JUMPS], clocks[c.USEC, c.JUMPS], clocks[c.USEC32, c.JUMPS])


@nb.njit(cache=True, nogil=True)
def _advance(clocks):
    return max(clocks[c.BOOT, c.ADVANCE], clocks[c.USEC, c.ADVANCE], clocks[c.USEC32, c.ADVANCE])


@nb.njit(cache=True)
def _judge(memory, rank, t, timeless):
    """Tell a row's fate; without a time of its own a message may well repeat one: no fault."""
    heard, every = memory[HEARD:EVERY], memory[EVERY:]
    step = t - heard[rank]
    repeated = step <= 0
    if step >= YIELD_S:
        every[rank] = inf  # only its next row tells
    elif not repeated:
        every[rank] = step if every[rank] == inf else every[rank] + SMOOTH * (step - every[rank])
    heard[rank] = max(heard[rank], t)
    if rank != _speaker(heard, every, t):
        return PASSED_OVER
    if t > memory[LAST]:
        memory[LAST] = t
        return KEPT
    return REFUSED if repeated and not timeless else PASSED_OVER


@nb.njit(cache=True)
def _speaker(heard, every, t):
    """Return the highest rank that flows: it spoke of late, and not much less often than any other that did."""
    busiest = inf
    for rank in range(RANKS):
        if t < heard[rank] + YIELD_S:
            busiest = min(busiest, every[rank])
    for rank in range(RANKS - 1, -1, -1):
        if t < heard[rank] + YIELD_S and every[rank] <= SLOWER * busiest:
            return rank
    return 0
