"""Compiled row arbitration: assign fleet times, and skip late, repeated and lower-ranked rows."""

from math import inf, isnan

import numba as nb
import numpy as np

from fleet.contract import COLUMNS
from fleet.telemetry.tables import clock as c

FIELDS = tuple(COLUMNS)
SOURCE_TIMEOUT_S = 3.0  # silence of a source after which a lower-ranked source is used [s]
MAX_PERIOD_RATIO = 1.5  # a source with a longer relative period is skipped in favour of a faster one
SMOOTHING = 0.1  # weight of the newest interval in the mean period of a source
RANK_COUNT = 4  # number of ranks
# state columns: newest accepted time; by rank: newest time, mean period
ACCEPTED_T, SOURCE_T, SOURCE_PERIOD = 0, 1, 1 + RANK_COUNT
NO_FIELD = -1
ACCEPTED, SKIPPED, REJECTED = range(3)


def new_arbiter_state() -> np.ndarray:
    """Return the initial state of one aircraft, (fields, SOURCE_PERIOD + RANK_COUNT)."""
    return np.tile([-inf] * (1 + RANK_COUNT) + [inf] * RANK_COUNT, (len(FIELDS), 1))


@nb.njit(cache=True, nogil=True)
def arbitrate_rows(clocks, state, owner, ticks, raw_s, arrival, field, rank, requires, t, decision, jumped, advanced):
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
        aircraft_clocks, field_states = clocks[owner[i]], state[owner[i]]
        jumps_before, advance_before = _jumps(aircraft_clocks), _advance(aircraft_clocks)
        t[i] = c.message_time(aircraft_clocks, ticks[i], raw_s[i], arrival[i])
        if _jumps(aircraft_clocks) != jumps_before:
            jumped[owner[i]] = arrival[i]
        advanced[i] = _advance(aircraft_clocks) - advance_before
        if isnan(t[i]):
            decision[i] = REJECTED
        elif requires[i] != NO_FIELD and t[i] > field_states[requires[i], ACCEPTED_T] + SOURCE_TIMEOUT_S:
            decision[i] = SKIPPED
        else:
            decision[i] = _decide(field_states[field[i]], rank[i], t[i], ticks[i] == c.NONE)


@nb.njit(cache=True, nogil=True)
def _jumps(aircraft_clocks):
    return max(aircraft_clocks[c.BOOT, c.JUMPS], aircraft_clocks[c.USEC, c.JUMPS], aircraft_clocks[c.USEC32, c.JUMPS])


@nb.njit(cache=True, nogil=True)
def _advance(aircraft_clocks):
    return max(
        aircraft_clocks[c.BOOT, c.ADVANCE], aircraft_clocks[c.USEC, c.ADVANCE], aircraft_clocks[c.USEC32, c.ADVANCE]
    )


@nb.njit(cache=True)
def _decide(state, rank, t, timeless):
    """Return the decision for one row; a repeated time is no error for messages without time stamp."""
    newest, period = state[SOURCE_T:SOURCE_PERIOD], state[SOURCE_PERIOD:]
    step = t - newest[rank]
    repeated = step <= 0
    if step >= SOURCE_TIMEOUT_S:
        period[rank] = inf  # known after its next row
    elif not repeated:
        period[rank] = step if period[rank] == inf else period[rank] + SMOOTHING * (step - period[rank])
    newest[rank] = max(newest[rank], t)
    if rank != _preferred_rank(newest, period, t):
        return SKIPPED
    if t > state[ACCEPTED_T]:
        state[ACCEPTED_T] = t
        return ACCEPTED
    return REJECTED if repeated and not timeless else SKIPPED


@nb.njit(cache=True)
def _preferred_rank(newest, period, t):
    """Return the highest active rank: received recently, at a period comparable to the fastest source."""
    shortest = inf
    for rank in range(RANK_COUNT):
        if t < newest[rank] + SOURCE_TIMEOUT_S:
            shortest = min(shortest, period[rank])
    for rank in range(RANK_COUNT - 1, -1, -1):
        if t < newest[rank] + SOURCE_TIMEOUT_S and period[rank] <= MAX_PERIOD_RATIO * shortest:
            return rank
    return 0
