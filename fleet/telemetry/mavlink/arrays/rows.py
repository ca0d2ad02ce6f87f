"""Rows of many aircraft awaiting publication, in time order, released by arrival time."""

import numba as nb
import numpy as np

from fleet.telemetry.mavlink.arrays.pack import FIELDS, MAX_ROWS, WIDEST, Packed, pack_samples


class PendingRows:
    """Pending rows by aircraft and field."""

    def __init__(self) -> None:
        self.uavs = np.empty(0, np.int64)  # UAV ids, by number of the aircraft
        self.dropped = np.empty(0, np.int64)  # rows beyond `MAX_ROWS`, by aircraft
        self._row_keys = np.empty(0, np.int64)  # aircraft and field of each row, sorted
        self._arrival, self._t, self._at = np.empty(0), np.empty(0), np.empty(0, np.int64)
        self._values = np.empty(0)  # of all rows; those of a row begin at `_at`
        self._start = self._end = np.empty((0, len(FIELDS)), np.int64)  # range of the pending rows
        self._next_arrival = np.inf  # arrival of the next pending row [s since 1970]

    def add_aircraft(self, uav: int) -> None:
        """Add one aircraft."""
        self.uavs, self.dropped = np.append(self.uavs, uav), np.append(self.dropped, 0)
        empty = np.full((1, len(FIELDS)), len(self._row_keys))
        self._start, self._end = np.concatenate([self._start, empty]), np.concatenate([self._end, empty])

    def add_rows(self, key: np.ndarray, arrival: np.ndarray, t: np.ndarray, x: np.ndarray) -> None:
        """Add rows with their values in a matrix.

        Args:
            key, arrival, t: as for `add_values`
            x: values, (n, k); columns beyond those of the field are ignored, missing extra columns are 0
        """
        padded = np.pad(x, ((0, 0), (0, max(int(WIDEST.max()) - x.shape[1], 0))))
        self.add_values(key, arrival, t, padded.ravel(), np.arange(len(x)) * padded.shape[1])

    def add_values(
        self, key: np.ndarray, arrival: np.ndarray, t: np.ndarray, values: np.ndarray, at: np.ndarray
    ) -> None:
        """Add rows.

        Args:
            key: number of the aircraft * number of fields + number of the field, (n,)
            arrival: arrival times, non-decreasing within a key, (n,) [s since 1970]
            t: fleet time, increasing within a key and later than all earlier rows, (n,) [s since 1970]
            values: numbers of all rows, which must not change later, (m,)
            at: position of each row's first value; its `WIDEST` values follow, (n,)
        """
        if len(self._row_keys):
            remaining = np.flatnonzero(_remaining_rows(self._start, self._end, len(self._row_keys)))
            old_key = self._row_keys[remaining]
            old_values, old_at = _collect_values(self._values, self._at[remaining], old_key, WIDEST)
            key, arrival = np.concatenate([old_key, key]), np.concatenate([self._arrival[remaining], arrival])
            t, at = np.concatenate([self._t[remaining], t]), np.concatenate([old_at, at + len(old_values)])
            values = np.concatenate([old_values, values])
        order, edges = sort_numbers(key, len(self.uavs) * len(FIELDS))
        self._row_keys, self._arrival, self._t = key[order], arrival[order], t[order]
        self._at, self._values = at[order], values
        self._start, self._end = (edge.reshape(-1, len(FIELDS)).copy() for edge in (edges[:-1], edges[1:]))
        self._next_arrival = float(arrival.min()) if len(key) else np.inf

    def take_samples(self, now: float) -> list[Packed]:
        """Return the pending rows received up to `now`, encoded as samples."""
        if self._next_arrival > now:
            return []
        stop, limited = np.empty_like(self._start), np.empty_like(self._start)
        self._next_arrival = _find_arrived(self._start, self._end, self._arrival, now, stop, limited, self.dropped)
        start, self._start = self._start, stop
        packed = pack_samples(self.uavs, start, limited, self._t, self._values, at=self._at)
        if self._next_arrival == np.inf:
            self._row_keys, self._arrival = self._row_keys[:0], self._arrival[:0]
            self._t, self._at, self._values = self._t[:0], self._at[:0], self._values[:0]
            self._start, self._end = np.zeros_like(stop), np.zeros_like(stop)
        return packed


@nb.njit(cache=True, nogil=True)
def sort_numbers(numbers, count):
    """Sort numbers below `count`, stable: order, (n,), and start of each number in it, (count + 1,)."""
    start, order = np.zeros(count + 1, np.int64), np.empty(len(numbers), np.int64)
    for number in numbers:
        start[number + 1] += 1
    for number in range(count):
        start[number + 1] += start[number]
    free = start.copy()
    for i in range(len(numbers)):
        order[free[numbers[i]]] = i
        free[numbers[i]] += 1
    return order, start


@nb.njit(cache=True, nogil=True)
def _collect_values(values, at, key, widths):
    """Return the values of some rows, (m,), and the position of each row in them, (n,)."""
    size = 0
    for i in range(len(at)):
        size += widths[key[i] % len(widths)]
    out, new_at, size = np.empty(size), np.empty(len(at), np.int64), 0
    for i in range(len(at)):
        new_at[i] = size
        for k in range(widths[key[i] % len(widths)]):
            out[size] = values[at[i] + k]
            size += 1
    return out, new_at


@nb.njit(cache=True, nogil=True)
def _find_arrived(start, end, arrival, now, stop, limited, dropped):
    """Return the next arrival after `now`.

    Args:
        start, end: range of the pending rows, (m, fields)
        arrival: arrival times, (n,) [s since 1970]
        now: fleet time [s since 1970]
        stop: filled with the end of the rows that arrived up to `now`, (m, fields)
        limited: filled with the same, at most `MAX_ROWS` after `start`, (m, fields)
        dropped: increased by the number of rows beyond `MAX_ROWS`, (m,)
    """
    next_arrival = np.inf
    for owner in range(len(start)):
        for field in range(start.shape[1]):
            row = start[owner, field]
            while row < end[owner, field] and arrival[row] <= now:
                row += 1
            stop[owner, field] = row
            limited[owner, field] = min(row, start[owner, field] + MAX_ROWS)
            dropped[owner] += row - limited[owner, field]
            if row < end[owner, field]:
                next_arrival = min(next_arrival, arrival[row])
    return next_arrival


@nb.njit(cache=True, nogil=True)
def _remaining_rows(start, end, row_count):
    remaining = np.zeros(row_count, np.bool_)
    for owner in range(len(start)):
        for field in range(start.shape[1]):
            remaining[start[owner, field] : end[owner, field]] = True
    return remaining
