"""The compiled judge of one aircraft's rows: each gets its fleet time; late, repeated and second-best ones go."""

from math import inf, isnan

import numba as nb
import numpy as np

from fleet.contract import COLUMNS
from fleet.telemetry import clock as c

FIELDS = tuple(COLUMNS)
YIELD_S = 3.0  # a lower-ranked source speaks again after this silence of the better one [s]
SLOWER = 1.5  # a source with intervals this much longer than another's trickles: the other is heard
SMOOTH = 0.1  # weight of the newest interval in a source's usual one
RANKS = 4  # ranks are below this
LAST, HEARD, EVERY = 0, 1, 1 + RANKS  # columns of the memory: newest time kept; by rank: newest time, usual interval
NO_FIELD = -1
KEPT, PASSED_OVER, REFUSED = range(3)


class Memory:
    """What has to be remembered of one aircraft between two batches."""

    def __init__(self) -> None:
        self.clocks = c.new_clocks()
        self.fields = np.tile([-inf] * (1 + RANKS) + [inf] * RANKS, (len(FIELDS), 1))


@nb.njit(cache=True)
def settle(clocks, fields, ticks, raw_s, arrival, field, rank, given, t, fate):
    """Judge rows in the order they were heard.

    Args:
        clocks, fields: of the aircraft's `Memory`, changed in place
        ticks: clock each time comes from, (n,)
        raw_s: own times [s], arrival: fleet times [s since 1970], (n,)
        field: numbers in `FIELDS`, rank: of the source, (n,)
        given: number in `FIELDS` of what must flow for the row to count, or NO_FIELD, (n,)
        t: filled with fleet times, nan while a jump is suspected [s since 1970]
        fate: filled with KEPT, PASSED_OVER or REFUSED
    Returns:
        index after the last row at which a jump of the clock was noticed, 0 for none
    """
    jumped = 0
    known = clocks[:, c.JUMPS].max()
    for i in range(len(t)):
        t[i] = c.tell(clocks, ticks[i], raw_s[i], arrival[i])
        if clocks[:, c.JUMPS].max() != known:
            known, jumped = clocks[:, c.JUMPS].max(), i + 1
        if isnan(t[i]):
            fate[i] = REFUSED
        elif given[i] != NO_FIELD and t[i] > fields[given[i], LAST] + YIELD_S:
            fate[i] = PASSED_OVER
        else:
            fate[i] = _judge(fields[field[i]], rank[i], t[i], ticks[i] == c.NONE)
    return jumped


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
    """Give the highest rank that flows: it spoke of late, and not much less often than any other that did."""
    busiest = inf
    for rank in range(RANKS):
        if t < heard[rank] + YIELD_S:
            busiest = min(busiest, every[rank])
    for rank in range(RANKS - 1, -1, -1):
        if t < heard[rank] + YIELD_S and every[rank] <= SLOWER * busiest:
            return rank
    return 0
