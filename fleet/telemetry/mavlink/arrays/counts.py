"""Message counters of many aircraft up to a given time: messages of each kind, lost messages. Compiled."""

from collections.abc import Sequence

import numba as nb
import numpy as np

SMOOTH = 0.4  # weight of the newest interval in a rate
LEAST_HZ = 0.005  # lower rates are not published [Hz]
NOBODY = -1.0  # sequence number before any message

HEARD, SPOKE, RECEIVED, MISSED, MISSING, SEQ, COLUMNS = range(7)
"""Columns per aircraft: arrival of the newest message; arrival of the newest counted message; counted messages; lost
messages up to the counted one; lost messages up to the newest one; its sequence number."""


_NEW = np.array([[-np.inf, -np.inf, 0.0, 0.0, 0.0, NOBODY]])


class Counts:
    """Message counters of many aircraft.

    Args:
        names: message names
    """

    def __init__(self, names: Sequence[str] = ()) -> None:
        self.state = np.empty((0, COLUMNS))  # a row per aircraft
        self._kinds = np.empty((0, len(names)), np.int64)  # since the last `rates`
        self._hz = np.empty((0, len(names)))  # smoothed rate of each kind; nan: never received
        self._number = {name: k for k, name in enumerate(names)}
        self._names = list(names)
        self._waiting = (np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0), np.empty(0))

    def add(self) -> None:
        """Add one aircraft."""
        self.state = np.concatenate([self.state, _NEW])
        self._kinds = np.concatenate([self._kinds, np.zeros((1, len(self._number)), np.int64)])
        self._hz = np.concatenate([self._hz, np.full((1, len(self._number)), np.nan)])

    def reset(self, number: int) -> None:
        """Reset the counters of one aircraft."""
        self.state[number] = _NEW
        self._kinds[number], self._hz[number] = 0, np.nan

    def numbers(self, names: Sequence[str]) -> np.ndarray:
        """Return the indices of message names, adding new names, (n,)."""
        found = np.array([self._number.setdefault(name, len(self._number)) for name in names], np.int64)
        more = ((0, 0), (0, len(self._number) - self._kinds.shape[1]))
        self._kinds, self._hz = np.pad(self._kinds, more), np.pad(self._hz, more, constant_values=np.nan)
        self._names = list(self._number)
        return found

    def note(self, owner: np.ndarray, kind: np.ndarray, arrival: np.ndarray, seq: np.ndarray | None) -> None:
        """Add messages in order of arrival.

        Args:
            owner: number of the aircraft, (n,)
            kind: index of the message name, (n,)
            arrival: fleet times, non-decreasing, (n,) [s since 1970]
            seq: sequence numbers, (n,); None without sequence numbers: no losses are counted
        """
        missing = np.empty(len(owner))
        _gaps(self.state, owner, arrival, np.empty(0, np.int64) if seq is None else seq, missing)
        new = owner, kind, arrival, missing
        self._waiting = tuple(map(np.concatenate, zip(self._waiting, new, strict=True)))  # type: ignore[assignment]

    def upto(self, now: float) -> None:
        """Count the messages that arrived up to `now` [s since 1970]."""
        if len(self._waiting[0]) and (done := _count(self.state, self._kinds, *self._waiting, now)):
            self._waiting = tuple(one[done:] for one in self._waiting)  # type: ignore[assignment]

    def rates(self, number: int, passed: float) -> dict[str, float]:
        """Return the smoothed message rates of one aircraft [Hz]; `elapsed` since the last call [s]."""
        found, hz = _smooth(self._kinds[number], self._hz[number], passed)
        return dict(zip(map(self._names.__getitem__, found.tolist()), hz.tolist(), strict=True))


@nb.njit(cache=True, nogil=True)
def _smooth(kinds, hz, passed):
    """Update rates from counts if `elapsed` is positive; return the kinds to publish and their rates."""
    for k in range(len(kinds)):
        if 0 < passed < np.inf and (kinds[k] or not np.isnan(hz[k])):
            new = kinds[k] / passed
            hz[k] = new if np.isnan(hz[k]) else (1 - SMOOTH) * hz[k] + SMOOTH * new
        kinds[k] = 0
    found = np.flatnonzero(hz > LEAST_HZ)
    return found, np.round(hz[found], 2)


@nb.njit(cache=True, nogil=True)
def _gaps(state, owner, arrival, seq, missing):
    """Fill `missed` with the number of messages lost up to each message."""
    for i in range(len(owner)):
        mine = state[owner[i]]
        if len(seq):
            gap = (seq[i] - nb.int64(mine[SEQ]) - 1) & 0xFF if mine[SEQ] >= 0 else 0
            if gap < 128:  # else a late message, not a loss
                mine[MISSING] += gap
            mine[SEQ] = seq[i]
        mine[HEARD] = arrival[i]
        missing[i] = mine[MISSING]


@nb.njit(cache=True, nogil=True)
def _count(state, kinds, owner, kind, arrival, missing, now):
    """Count messages up to `now`; return their number."""
    i = 0
    while i < len(owner) and arrival[i] <= now:
        mine = state[owner[i]]
        mine[RECEIVED] += 1
        mine[SPOKE], mine[MISSED] = arrival[i], missing[i]
        kinds[owner[i], kind[i]] += 1
        i += 1
    return i
