"""Messages of many aircraft, counted as far as time has come: how many of each kind, how many missed. Compiled."""

from collections.abc import Sequence

import numba as nb
import numpy as np

SMOOTH = 0.4  # weight of the newest stretch in a rate
LEAST_HZ = 0.005  # slower is not told [Hz]
NOBODY = -1.0  # sequence number before any message

HEARD, SPOKE, RECEIVED, MISSED, MISSING, SEQ, COLUMNS = range(7)
"""Per aircraft: arrival of the newest message; of the newest counted; messages counted; missed up to there; missed up
to the newest; its sequence number."""


_NEW = np.array([[-np.inf, -np.inf, 0.0, 0.0, 0.0, NOBODY]])


class Counts:
    """Counters of many aircraft.

    Args:
        names: of the kinds of messages
    """

    def __init__(self, names: Sequence[str] = ()) -> None:
        self.state = np.empty((0, COLUMNS))  # a row per aircraft
        self._kinds = np.empty((0, len(names)), np.int64)  # since the last `rates`
        self._hz = np.empty((0, len(names)))  # of each kind, smoothed; nan: never heard
        self._number = {name: k for k, name in enumerate(names)}
        self._names = list(names)
        self._waiting = (np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0), np.empty(0))

    def add(self) -> None:
        """Make room for one more aircraft."""
        self.state = np.concatenate([self.state, _NEW])
        self._kinds = np.concatenate([self._kinds, np.zeros((1, len(self._number)), np.int64)])
        self._hz = np.concatenate([self._hz, np.full((1, len(self._number)), np.nan)])

    def reset(self, number: int) -> None:
        """Begin anew for one aircraft."""
        self.state[number] = _NEW
        self._kinds[number], self._hz[number] = 0, np.nan

    def numbers(self, names: Sequence[str]) -> np.ndarray:
        """Number kinds by name, new ones too, (n,)."""
        found = np.array([self._number.setdefault(name, len(self._number)) for name in names], np.int64)
        more = ((0, 0), (0, len(self._number) - self._kinds.shape[1]))
        self._kinds, self._hz = np.pad(self._kinds, more), np.pad(self._hz, more, constant_values=np.nan)
        self._names = list(self._number)
        return found

    def note(self, owner: np.ndarray, kind: np.ndarray, arrival: np.ndarray, seq: np.ndarray | None) -> None:
        """Take note of messages in the order they came.

        Args:
            owner: number of the aircraft, (n,)
            kind: number of the name, (n,)
            arrival: fleet times, never falling, (n,) [s since 1970]
            seq: sequence numbers, (n,); None where there are none, so that none can be missed
        """
        missing = np.empty(len(owner))
        _gaps(self.state, owner, arrival, np.empty(0, np.int64) if seq is None else seq, missing)
        new = owner, kind, arrival, missing
        self._waiting = tuple(map(np.concatenate, zip(self._waiting, new, strict=True)))  # type: ignore[assignment]

    def upto(self, now: float) -> None:
        """Count what had arrived up to `now` [s since 1970]."""
        if len(self._waiting[0]) and (done := _count(self.state, self._kinds, *self._waiting, now)):
            self._waiting = tuple(one[done:] for one in self._waiting)  # type: ignore[assignment]

    def rates(self, number: int, passed: float) -> dict[str, float]:
        """Return how often each kind comes from one aircraft [Hz], smoothed; `passed` since this was last asked [s]."""
        found, hz = _smooth(self._kinds[number], self._hz[number], passed)
        return dict(zip(map(self._names.__getitem__, found.tolist()), hz.tolist(), strict=True))


@nb.njit(cache=True, nogil=True)
def _smooth(kinds, hz, passed):
    """Take counts up into rates, unless the time passed is none; gives the kinds worth telling and their rates."""
    for k in range(len(kinds)):
        if 0 < passed < np.inf and (kinds[k] or not np.isnan(hz[k])):
            new = kinds[k] / passed
            hz[k] = new if np.isnan(hz[k]) else (1 - SMOOTH) * hz[k] + SMOOTH * new
        kinds[k] = 0
    found = np.flatnonzero(hz > LEAST_HZ)
    return found, np.round(hz[found], 2)


@nb.njit(cache=True, nogil=True)
def _gaps(state, owner, arrival, seq, missing):
    """Fill `missing` with the messages missed up to each one."""
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
    """Count messages up to `now`; gives how many."""
    i = 0
    while i < len(owner) and arrival[i] <= now:
        mine = state[owner[i]]
        mine[RECEIVED] += 1
        mine[SPOKE], mine[MISSED] = arrival[i], missing[i]
        kinds[owner[i], kind[i]] += 1
        i += 1
    return i
