"""The compiled judge of one aircraft's rows: each gets its fleet time; late, repeated and second-best ones go."""

from math import inf, isnan

import numba as nb
import numpy as np

from fleet.contract import COLUMNS
from fleet.telemetry import clock as c

FIELDS = tuple(COLUMNS)
YIELD_S = 3.0  # a lower-ranked source speaks again after this silence of the better one [s]
LAST, BEST, WHEN = range(3)  # columns of the memory: newest time kept, best rank and when it spoke
KEPT, PASSED_OVER, REFUSED = range(3)


class Memory:
    """What has to be remembered of one aircraft between two batches."""

    def __init__(self) -> None:
        self.clocks = c.new_clocks()
        self.fields = np.tile([-inf, -1.0, -inf], (len(FIELDS), 1))  # LAST, BEST, WHEN of each field


@nb.njit(cache=True)
def settle(clocks, fields, ticks, raw_s, arrival, field, rank, t, fate):
    """Judge rows in the order they were heard.

    Args:
        clocks, fields: of the aircraft's `Memory`, changed in place
        ticks: clock each time comes from, (n,)
        raw_s: own times [s], arrival: fleet times [s since 1970], (n,)
        field: numbers in `FIELDS`, rank: of the source, (n,)
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
        memory = fields[field[i]]
        if isnan(t[i]):
            fate[i] = REFUSED
        elif rank[i] < memory[BEST] and t[i] < memory[WHEN] + YIELD_S:
            fate[i] = PASSED_OVER
        else:
            memory[BEST], memory[WHEN] = rank[i], t[i]
            # without a time of its own a message may well repeat one: no fault
            fate[i] = KEPT if t[i] > memory[LAST] else PASSED_OVER if ticks[i] == c.NONE else REFUSED
            memory[LAST] = max(memory[LAST], t[i])
    return jumped
