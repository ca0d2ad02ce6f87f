"""The last minutes of every aircraft, for whoever joins late: kept as it was sent, answered in one message."""

import contextlib
import threading
from collections import deque
from typing import Any, NamedTuple

import msgspec

from fleet.bus import Answers
from fleet.codec import Wire
from fleet.contract import History, Sample, Status

SECONDS = 160.0  # as long as a twin remembers
MOST = 512 << 20  # bytes over all aircraft; beyond, everybody's past becomes shorter
KINDS = (Sample, Status)


class _Said(NamedTuple):
    t: float  # fleet time [s since 1970]
    kind: type
    payload: bytes


class _Past:
    """What one aircraft said."""

    def __init__(self) -> None:
        self.said: deque[_Said] = deque()
        self.size = 0
        self.since = 0.0  # nothing after it is left out [s since 1970]

    def trim(self, before: float, most: int) -> int:
        """Forget what is older than `before` [s since 1970] or beyond `most` bytes; gives how much shorter it is."""
        size = self.size
        while self.said and (self.said[0].t < before or self.size > most):
            gone = self.said.popleft()
            self.size -= len(gone.payload)
            self.since = max(self.since, gone.t)
        return size - self.size


class Keeper:
    """Remember what was said, answer for one aircraft at a time.

    Args:
        seconds: how far back, on the fleet clock
        most: bytes over all aircraft, shared equally
    """

    def __init__(self, seconds: float = SECONDS, most: int = MOST) -> None:
        self.size = 0  # bytes kept
        self._seconds, self._most = seconds, most
        self._pasts: dict[int, _Past] = {}
        self._lock = threading.Lock()  # questions come on a thread of the bus

    def keep(self, wire: Wire, t: float) -> None:
        """Remember a packed message about fleet time `t` [s since 1970]."""
        if wire.kind not in KINDS:
            return
        with self._lock:
            past = self._pasts.get(wire.uav)
            if past is None:
                past = self._pasts[wire.uav] = _Past()
                past.since = t
                self.size -= sum(
                    one.trim(float("-inf"), self._most // len(self._pasts)) for one in self._pasts.values()
                )
            past.said.append(_Said(t, wire.kind, wire.payload))
            past.size += len(wire.payload)
            self.size += len(wire.payload) - past.trim(t - self._seconds, self._most // len(self._pasts))

    def answer(self, uav: int | None, settings: dict[str, str], payload: bytes) -> Answers:
        """Answer a question on the bus.

        Raises:
            ValueError: when it is not about one aircraft: everybody's past at once is more than one message.
        """
        del payload
        if uav is None:
            raise ValueError(
                "history: found a question about every aircraft, expected one id in the key; ask one by one"
            )
        seconds = self._seconds
        with contextlib.suppress(ValueError):
            seconds = float(settings.get("seconds", seconds))
        with self._lock:
            past = self._pasts.get(uav)
            if past is None or not past.said:
                return []
            said, since = list(past.said), past.since
        newest = said[-1].t
        first = newest - seconds
        told: dict[type, tuple[Any, ...]] = {
            kind: tuple(msgspec.Raw(one.payload) for one in said if one.kind is kind and one.t >= first)
            for kind in KINDS
        }
        since = max(since, first)
        return [(History(uav=uav, t=newest, since=since, samples=told[Sample], statuses=told[Status]), None)]
