"""Compiled row arbitration: assign fleet times, and skip late, repeated and lower-ranked rows."""

from math import inf, isnan

import numba as nb
import numpy as np

from fleet.contract import COLUMNS
from fleet.telemetry.tables import clock as c

FIELDS = tuple(COLUMNS)
YIELD_S = 3.0  # silence of a source after which a lower-ranked source is used [s]
SLOWER = 1.5  # a source with a longer relative period is skipped in favour of a faster one
SMOOTH = 0.1  # weight of the newest interval in the mean period of a source
RANKS = 4  # number of ranks
# state columns: newest accepted time; by rank: newest time, mean period
LAST, HEARD, EVERY = 0, 1, 1 + RANKS
NO_FIELD = -1
KEPT, PASSED_OVER, REFUSED = range(3)


def new_memory() -> np.ndarray:
    """Return the initial state of one aircraft, (fields, SOURCE_PERIOD + RANK_COUNT)."""
    return np.tile([-inf] * (1 + RANKS) + [inf] * RANKS, (len(FIELDS), 1))


@nb.njit(cache=True, nogil=True)
def settle(clocks, memory, owner, ticks, raw_s, arrival, field, rank, given, t, fate, jumped, advanced):
    """Arbitrate rows in order of reception.

    Args:
        clocks, state: of all aircraft, changed in place, (m, 3, STATE_SIZE) and (m, fields, SOURCE_PERIOD + RANK_COUNT)
        owner: number of the aircraft, (n,)
        ticks: time source, (n,)
        raw_s: message time stamps [s], arrival: fleet times [s since 1970], (n,)
        field: numbers in `FIELDS`, rank: rank of the source, (n,)
        requires: number in `FIELDS` of the required active field, or NO_FIELD, (n,)
        t: filled with fleet times, nan while a jump is suspected [s since 1970]
        decision: filled with ACCEPTED, SKIPPED or REJECTED
        jumped: arrival of the last row at which a clock jump was detected, by aircraft, (m,) [s since 1970]
        advanced: filled with the forward re-anchoring step of the clock at this row, mostly 0, (n,) [s]
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
    """Return the decision for one row; a repeated time is no error for messages without time stamp."""
    heard, every = memory[HEARD:EVERY], memory[EVERY:]
    step = t - heard[rank]
    repeated = step <= 0
    if step >= YIELD_S:
        every[rank] = inf  # known after its next row
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
    """Return the highest active rank: received recently, at a period comparable to the fastest source."""
    busiest = inf
    for rank in range(RANKS):
        if t < heard[rank] + YIELD_S:
            busiest = min(busiest, every[rank])
    for rank in range(RANKS - 1, -1, -1):
        if t < heard[rank] + YIELD_S and every[rank] <= SLOWER * busiest:
            return rank
    return 0
