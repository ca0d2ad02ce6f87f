"""History of the last minutes of every aircraft for late subscribers: packed messages, returned as one message."""

import contextlib
import threading
from collections import deque
from collections.abc import Iterable
from math import isfinite
from typing import Any

import msgspec

from fleet.bus.bus_protocol import Answers
from fleet.bus.codec import Wire
from fleet.contract import History, Sample, Status

SECONDS = 160.0  # length of the history of a twin
MOST = 512 << 20  # bytes over all aircraft; beyond, the history of every aircraft becomes shorter
KINDS = (Sample, Status)


class _Past:
    """Packed messages of one aircraft: (fleet time [s since 1970], bytes), oldest first, by kind."""

    def __init__(self, since: float) -> None:
        self.said: dict[type, deque[tuple[float, bytes]]] = {kind: deque() for kind in KINDS}
        self.size = 0
        self.since = since  # complete from this time on [s since 1970]

    def trim(self, before: float, most: int) -> int:
        """Delete messages older than `before` [s since 1970] or beyond `max_bytes`; return the bytes deleted."""
        size = self.size
        for said in self.said.values():
            while said and said[0][0] < before:
                self._forget(said)
        while self.size > most:
            self._forget(min(filter(None, self.said.values()), key=lambda said: said[0][0]))
        return size - self.size

    def _forget(self, said: deque[tuple[float, bytes]]) -> None:
        t, payload = said.popleft()
        self.size -= len(payload)
        self.since = max(self.since, t)


class Keeper:
    """Store packed messages and answer history queries, one aircraft at a time.

    Args:
        seconds: length of the history, on the fleet clock
        max_bytes: over all aircraft, shared equally
    """

    def __init__(self, seconds: float = SECONDS, most: int = MOST) -> None:
        self.size = 0  # bytes stored
        self._share = most  # of one aircraft [bytes]
        self._seconds, self._most = seconds, most
        self._pasts: dict[int, _Past] = {}
        self._lock = threading.Lock()  # queries arrive on a thread of the bus

    def keep(self, wires: Iterable[Wire]) -> None:
        """Store packed messages; those without a time are skipped."""
        with self._lock:
            for wire in wires:
                if wire.kind in KINDS and isfinite(wire.t):
                    self._keep(wire)

    def _keep(self, wire: Wire) -> None:
        past = self._pasts.get(wire.uav)
        if past is None:
            past = self._pasts[wire.uav] = _Past(wire.t)
            self._share = self._most // len(self._pasts)
            self.size -= sum(one.trim(float("-inf"), self._share) for one in self._pasts.values())
        size = len(wire.payload)
        past.said[wire.kind].append((wire.t, wire.payload))
        past.size += size
        self.size += size - past.trim(wire.t - self._seconds, self._share)

    def forget(self, uavs: Iterable[int]) -> None:
        """Remove aircraft; the others get their share of memory."""
        with self._lock:
            for uav in uavs:
                if (past := self._pasts.pop(uav, None)) is not None:
                    self.size -= past.size
            self._share = self._most // max(len(self._pasts), 1)

    def answer(self, uav: int | None, settings: dict[str, str], payload: bytes) -> Answers:
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
            past = self._pasts.get(uav)
            if past is None or not any(past.said.values()):
                return []
            said, since = {kind: list(told) for kind, told in past.said.items()}, past.since
        newest = max(told[-1][0] for told in said.values() if told)
        first = newest - seconds
        told: dict[type, tuple[Any, ...]] = {
            kind: tuple(msgspec.Raw(payload) for t, payload in mine if t >= first) for kind, mine in said.items()
        }
        since = max(since, first)
        return [(History(uav=uav, t=newest, since=since, samples=told[Sample], statuses=told[Status]), None)]
