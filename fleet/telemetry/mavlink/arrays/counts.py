"""Message counters of many aircraft up to a given time: messages of each kind, lost messages. Compiled."""

from collections.abc import Sequence

import numba as nb
import numpy as np

SMOOTHING = 0.4  # weight of the newest interval in a rate
MIN_HZ = 0.005  # lower rates are not published [Hz]
NO_SEQ = -1.0  # sequence number before any message

LAST_ARRIVAL, LAST_COUNTED, RECEIVED, MISSED, MISSED_PENDING, LAST_SEQ, COLUMNS = range(7)
"""Columns per aircraft: arrival of the newest message; arrival of the newest counted message; counted messages; lost
messages up to the counted one; lost messages up to the newest one; its sequence number."""
_INITIAL = np.array([[-np.inf, -np.inf, 0.0, 0.0, 0.0, NO_SEQ]])


class MessageCounters:
    """Message counters of many aircraft.

    Args:
        names: message names
    """

    def __init__(self, names: Sequence[str] = ()) -> None:
        self.state = np.empty((0, COLUMNS))  # a row per aircraft
        self._kind_counts = np.empty((0, len(names)), np.int64)  # since the last `rates`
        self._rates_hz = np.empty((0, len(names)))  # smoothed rate of each kind; nan: never received
        self._kind_index = {name: k for k, name in enumerate(names)}
        self._names = list(names)
        self._pending = (np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0), np.empty(0))
        self._counted = 0  # the first pending messages, which are counted

    def add_aircraft(self) -> None:
        """Add one aircraft."""
        self.state = np.concatenate([self.state, _INITIAL])
        self._kind_counts = np.concatenate([self._kind_counts, np.zeros((1, len(self._kind_index)), np.int64)])
        self._rates_hz = np.concatenate([self._rates_hz, np.full((1, len(self._kind_index)), np.nan)])

    def reset(self, number: int) -> None:
        """Reset the counters of one aircraft."""
        self.state[number] = _INITIAL
        self._kind_counts[number], self._rates_hz[number] = 0, np.nan

    def kind_indices(self, names: Sequence[str]) -> np.ndarray:
        """Return the indices of message names, adding new names, (n,)."""
        indices = np.array([self._kind_index.setdefault(name, len(self._kind_index)) for name in names], np.int64)
        self._names = list(self._kind_index)
        padding = ((0, 0), (0, len(self._kind_index) - self._kind_counts.shape[1]))
        self._kind_counts = np.pad(self._kind_counts, padding)
        self._rates_hz = np.pad(self._rates_hz, padding, constant_values=np.nan)
        return indices

    def add_messages(self, owner: np.ndarray, kind: np.ndarray, arrival: np.ndarray, seq: np.ndarray | None) -> None:
        """Add messages in order of arrival.

        Args:
            owner: number of the aircraft, (n,)
            kind: index of the message name, (n,)
            arrival: fleet times, non-decreasing, (n,) [s since 1970]
            seq: sequence numbers, (n,); None without sequence numbers: no losses are counted
        """
        missed = np.empty(len(owner))
        _count_missed(self.state, owner, arrival, np.empty(0, np.int64) if seq is None else seq, missed)
        batch = owner, kind, arrival, missed
        pending = (column[self._counted :] for column in self._pending)
        self._pending = tuple(map(np.concatenate, zip(pending, batch, strict=True)))  # type: ignore[assignment]
        self._counted = 0

    def count_until(self, now: float) -> None:
        """Count the messages that arrived up to `now` [s since 1970]."""
        if self._counted < len(self._pending[0]):
            self._counted = _count_until(self.state, self._kind_counts, *self._pending, self._counted, now)

    def rates(self, number: int, elapsed: float) -> dict[str, float]:
        """Return the smoothed message rates of one aircraft [Hz]; `elapsed` since the last call [s]."""
        indices, rates_hz = _smooth(self._kind_counts[number], self._rates_hz[number], elapsed)
        names = self._names
        return {names[k]: rate_hz for k, rate_hz in zip(indices.tolist(), rates_hz.tolist(), strict=True)}


@nb.njit(cache=True, nogil=True)
def _smooth(kind_counts, rates_hz, elapsed):
    """Update rates from counts if `elapsed` is positive; return the kinds to publish and their rates."""
    for k in range(len(kind_counts)):
        if 0 < elapsed < np.inf and (kind_counts[k] or not np.isnan(rates_hz[k])):
            rate_hz = kind_counts[k] / elapsed
            rates_hz[k] = rate_hz if np.isnan(rates_hz[k]) else (1 - SMOOTHING) * rates_hz[k] + SMOOTHING * rate_hz
        kind_counts[k] = 0
    published = np.flatnonzero(rates_hz > MIN_HZ)
    return published, np.round(rates_hz[published], 2)


@nb.njit(cache=True, nogil=True)
def _count_missed(state, owner, arrival, seq, missed):
    """Fill `missed` with the number of messages lost up to each message."""
    for i in range(len(owner)):
        counters = state[owner[i]]
        if len(seq):
            gap = (seq[i] - nb.int64(counters[LAST_SEQ]) - 1) & 0xFF if counters[LAST_SEQ] >= 0 else 0
            if gap < 128:  # else a late message, not a loss
                counters[MISSED_PENDING] += gap
            counters[LAST_SEQ] = seq[i]
        counters[LAST_ARRIVAL] = arrival[i]
        missed[i] = counters[MISSED_PENDING]


@nb.njit(cache=True, nogil=True)
def _count_until(state, kind_counts, owner, kind, arrival, missed, first, now):
    """Count messages up to `now`, beginning with number `first`; return the number of the next one."""
    i = first
    while i < len(owner) and arrival[i] <= now:
        counters = state[owner[i]]
        counters[RECEIVED] += 1
        counters[LAST_COUNTED], counters[MISSED] = arrival[i], missed[i]
        kind_counts[owner[i], kind[i]] += 1
        i += 1
    return i
