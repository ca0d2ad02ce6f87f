"""Rows of many aircraft awaiting publication, in time order, released by arrival time."""

import numba as nb
import numpy as np

from fleet.telemetry.mavlink.arrays.pack import FIELDS, MAX_ROWS, Packed, pack_samples

MAX_COLUMNS = 8  # columns of the widest field without extra columns
WITH_EXTRA = 16  # columns of all rows while extra columns are in use


class PendingRows:
    """Pending rows by aircraft and field."""

    def __init__(self) -> None:
        self.uavs = np.empty(0, np.int64)  # UAV ids, by number of the aircraft
        self.dropped = np.empty(0, np.int64)  # rows beyond `MAX_ROWS`, by aircraft
        self._row_keys = np.empty(0, np.int64)  # aircraft and field of each row, sorted
        self._arrival, self._t, self._x = np.empty(0), np.empty(0), np.empty((0, MAX_COLUMNS))
        self._start = self._end = np.empty((0, len(FIELDS)), np.int64)  # range of the pending rows
        self._next_arrival = np.inf  # arrival of the next pending row [s since 1970]

    def add_aircraft(self, uav: int) -> None:
        """Add one aircraft."""
        self.uavs, self.dropped = np.append(self.uavs, uav), np.append(self.dropped, 0)
        empty = np.full((1, len(FIELDS)), len(self._row_keys))
        self._start, self._end = np.concatenate([self._start, empty]), np.concatenate([self._end, empty])

    def add_rows(self, key: np.ndarray, arrival: np.ndarray, t: np.ndarray, x: np.ndarray) -> None:
        """Add rows.

        Args:
            key: number of the aircraft * number of fields + number of the field, (n,)
            arrival: arrival times, non-decreasing within a key, (n,) [s since 1970]
            t: fleet time, increasing within a key and later than all earlier rows, (n,) [s since 1970]
            x: values, (n, `MAX_COLUMNS`) or (n, `WITH_EXTRA`); columns beyond those of the field are ignored
        """
        if len(self._row_keys):
            x, self._x = same_width(x, self._x)
            remaining = _remaining_rows(self._start, self._end, len(self._row_keys))
            key = np.concatenate([self._row_keys[remaining], key])
            arrival = np.concatenate([self._arrival[remaining], arrival])
            t, x = np.concatenate([self._t[remaining], t]), np.concatenate([self._x[remaining], x])
        order = np.argsort(key, kind="stable")
        self._row_keys, self._arrival, self._t, self._x = key[order], arrival[order], t[order], x[order]
        edges = np.searchsorted(self._row_keys, np.arange(len(self.uavs) * len(FIELDS) + 1))
        self._start, self._end = (edge.reshape(-1, len(FIELDS)).copy() for edge in (edges[:-1], edges[1:]))
        self._next_arrival = float(arrival.min()) if len(key) else np.inf

    def take_samples(self, now: float) -> list[Packed]:
        """Return the pending rows received up to `now`, encoded as samples."""
        if self._next_arrival > now:
            return []
        stop, limited = np.empty_like(self._start), np.empty_like(self._start)
        self._next_arrival = _find_arrived(self._start, self._end, self._arrival, now, stop, limited, self.dropped)
        start, self._start = self._start, stop
        packed = pack_samples(self.uavs, start, limited, self._t, self._x)
        if self._next_arrival == np.inf:
            self._row_keys, self._arrival = self._row_keys[:0], self._arrival[:0]
            self._t, self._x = self._t[:0], self._x[:0]
            self._start, self._end = np.zeros_like(stop), np.zeros_like(stop)
        return packed


def same_width(*parts: np.ndarray) -> list[np.ndarray]:
    """Return arrays (n, k) with the columns of the widest; added columns are 0."""
    width = max(x.shape[1] for x in parts)
    return [x if x.shape[1] == width else np.pad(x, ((0, 0), (0, width - x.shape[1]))) for x in parts]


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
