"""Rows of many aircraft awaiting publication, in time order, released by arrival time."""

import numba as nb
import numpy as np

from fleet.telemetry.mavlink.arrays.pack import FIELDS, MOST_ROWS, Packed, samples

WIDEST = 8  # columns of the widest field


class Shelves:
    """Pending rows by aircraft and field."""

    def __init__(self) -> None:
        self.uavs = np.empty(0, np.int64)  # UAV ids, by number of the aircraft
        self.refused = np.empty(0, np.int64)  # rows beyond `MAX_ROWS`, by aircraft
        self._key = np.empty(0, np.int64)  # aircraft and field of each row, sorted
        self._arrival, self._t, self._x = np.empty(0), np.empty(0), np.empty((0, WIDEST))
        self._start = self._end = np.empty((0, len(FIELDS)), np.int64)  # range of the pending rows
        self._due = np.inf  # arrival of the next pending row [s since 1970]

    def add(self, uav: int) -> None:
        """Add one aircraft."""
        self.uavs, self.refused = np.append(self.uavs, uav), np.append(self.refused, 0)
        none = np.full((1, len(FIELDS)), len(self._key))
        self._start, self._end = np.concatenate([self._start, none]), np.concatenate([self._end, none])

    def lay(self, key: np.ndarray, arrival: np.ndarray, t: np.ndarray, x: np.ndarray) -> None:
        """Add rows.

        Args:
            key: number of the aircraft * number of fields + number of the field, (n,)
            arrival: arrival times, non-decreasing within a key, (n,) [s since 1970]
            t: fleet time, increasing within a key and later than all earlier rows, (n,) [s since 1970]
            x: values, (n, k); columns beyond those of the field are ignored
        """
        if len(self._key):
            kept = _left(self._start, self._end, len(self._key))
            key, arrival = np.concatenate([self._key[kept], key]), np.concatenate([self._arrival[kept], arrival])
            t, x = np.concatenate([self._t[kept], t]), np.concatenate([self._x[kept], x])
        order = np.argsort(key, kind="stable")
        self._key, self._arrival, self._t, self._x = key[order], arrival[order], t[order], x[order]
        edges = np.searchsorted(self._key, np.arange(len(self.uavs) * len(FIELDS) + 1))
        self._start, self._end = (edge.reshape(-1, len(FIELDS)).copy() for edge in (edges[:-1], edges[1:]))
        self._due = float(arrival.min()) if len(key) else np.inf

    def take(self, now: float) -> list[Packed]:
        """Return the pending rows received up to `now`, encoded as samples."""
        if self._due > now:
            return []
        stop = self._start.copy()
        self._due = _upto(self._start, self._end, self._arrival, now, stop)
        cut = np.minimum(stop, self._start + MOST_ROWS)
        self.refused += (stop - cut).sum(axis=1)
        start, self._start = self._start, stop
        made = samples(self.uavs, start, cut, self._t, self._x)
        if self._due == np.inf:
            self._key, self._arrival, self._t, self._x = self._key[:0], self._arrival[:0], self._t[:0], self._x[:0]
            self._start, self._end = np.zeros_like(stop), np.zeros_like(stop)
        return made


@nb.njit(cache=True, nogil=True)
def _upto(start, end, arrival, now, stop):
    """Fill `stop` with the end of the rows that arrived up to `now`; return the next arrival."""
    due = np.inf
    for owner in range(len(start)):
        for field in range(start.shape[1]):
            at = start[owner, field]
            while at < end[owner, field] and arrival[at] <= now:
                at += 1
            stop[owner, field] = at
            if at < end[owner, field]:
                due = min(due, arrival[at])
    return due


@nb.njit(cache=True, nogil=True)
def _left(start, end, n):
    """Return a mask of the pending rows, (n,) bool."""
    kept = np.zeros(n, np.bool_)
    for owner in range(len(start)):
        for field in range(start.shape[1]):
            kept[start[owner, field] : end[owner, field]] = True
    return kept
