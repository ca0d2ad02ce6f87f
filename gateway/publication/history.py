"""History of the last minutes of every aircraft for late subscribers: packed messages, returned as one message."""

import contextlib
import threading
from collections import deque
from collections.abc import Iterable
from math import isfinite
from typing import Any

import msgspec

from fleet.bus.bus_protocol import Replies
from fleet.bus.codec import EncodedMessage
from fleet.contract import History, Sample, Status

HISTORY_S = 160.0  # length of the history of a twin
MAX_BYTES = 512 << 20  # bytes over all aircraft; beyond, the history of every aircraft becomes shorter
KINDS = (Sample, Status)


class _UavHistory:
    """Packed messages of one aircraft: (fleet time [s since 1970], bytes), oldest first, by kind."""

    def __init__(self, since: float) -> None:
        self.payloads: dict[type, deque[tuple[float, bytes]]] = {kind: deque() for kind in KINDS}
        self.size = 0
        self.since = since  # complete from this time on [s since 1970]

    def trim(self, before: float, max_bytes: int) -> int:
        """Delete messages older than `before` [s since 1970] or beyond `max_bytes`; return the bytes deleted."""
        size = self.size
        for queue in self.payloads.values():
            while queue and queue[0][0] < before:
                self._drop_oldest(queue)
        while self.size > max_bytes:
            self._drop_oldest(min(filter(None, self.payloads.values()), key=lambda queue: queue[0][0]))
        return size - self.size

    def _drop_oldest(self, queue: deque[tuple[float, bytes]]) -> None:
        t, payload = queue.popleft()
        self.size -= len(payload)
        self.since = max(self.since, t)


class HistoryStore:
    """Store packed messages and answer history queries, one aircraft at a time.

    Args:
        seconds: length of the history, on the fleet clock
        max_bytes: over all aircraft, shared equally
    """

    def __init__(self, seconds: float = HISTORY_S, max_bytes: int = MAX_BYTES) -> None:
        self.size = 0  # bytes stored
        self._share = max_bytes  # of one aircraft [bytes]
        self._seconds, self._max_bytes = seconds, max_bytes
        self._histories: dict[int, _UavHistory] = {}
        self._lock = threading.Lock()  # queries arrive on a thread of the bus

    def add(self, wires: Iterable[EncodedMessage]) -> None:
        """Store packed messages; those without a time are skipped."""
        with self._lock:
            for wire in wires:
                if wire.kind in KINDS and isfinite(wire.t):
                    self._add(wire)

    def _add(self, wire: EncodedMessage) -> None:
        history = self._histories.get(wire.uav)
        if history is None:
            history = self._histories[wire.uav] = _UavHistory(wire.t)
            self._share = self._max_bytes // len(self._histories)
            self.size -= sum(other.trim(float("-inf"), self._share) for other in self._histories.values())
        size = len(wire.payload)
        history.payloads[wire.kind].append((wire.t, wire.payload))
        history.size += size
        self.size += size - history.trim(wire.t - self._seconds, self._share)

    def remove(self, uavs: Iterable[int]) -> None:
        """Remove aircraft; the others get their share of memory."""
        with self._lock:
            for uav in uavs:
                if (history := self._histories.pop(uav, None)) is not None:
                    self.size -= history.size
            self._share = self._max_bytes // max(len(self._histories), 1)

    def answer(self, uav: int | None, settings: dict[str, str], payload: bytes) -> Replies:
        """Answer a query on the bus.

        Raises:
            ValueError: when it is not about one aircraft: all histories do not fit one message.
        """
        del payload
        if uav is None:
            raise ValueError(
                "history: found a query for every aircraft, expected one id in the key; query one at a time"
            )
        seconds = self._seconds
        with contextlib.suppress(ValueError):
            seconds = float(settings.get("seconds", seconds))
        with self._lock:
            history = self._histories.get(uav)
            if history is None or not any(history.payloads.values()):
                return []
            payloads, since = {kind: list(selected) for kind, selected in history.payloads.items()}, history.since
        newest = max(items[-1][0] for items in payloads.values() if items)
        first = newest - seconds
        selected: dict[type, tuple[Any, ...]] = {
            kind: tuple(msgspec.Raw(payload) for t, payload in items if t >= first) for kind, items in payloads.items()
        }
        since = max(since, first)
        return [(History(uav=uav, t=newest, since=since, samples=selected[Sample], statuses=selected[Status]), None)]
