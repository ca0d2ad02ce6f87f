"""Queues of undecoded messages: a small fleet decodes every sample, a large fleet the newest of each UAV.

Samples that change the mission item are always decoded. Decoding costs ten times as much as queueing, so of a large
fleet only what is drawn is decoded.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import msgspec

from fleet.access.roles import SAID
from fleet.bus.bus_protocol import Letter as Said
from fleet.bus.codec import Stamp
from fleet.contract import Rows, Sample

CROWD = 300  # UAVs above which only the newest sample of each is decoded
MOST = 40  # queued samples of one UAV; then the newest replaces the last
MOST_UAVS = 4_000  # UAVs with queued samples: ids are untrusted input
_LEG = b"\xa3leg\x82"  # msgpack: the key followed by a map (not nil)


class Leg(msgspec.Struct):
    """Active mission item of a sample."""

    leg: Rows


class Head(msgspec.Struct, frozen=True):
    """Fields of a sample that the viewer uses; the others are skipped."""

    uav: int
    t: float
    attitude: Rows | None = None
    position: Rows | None = None
    air: Rows | None = None
    leg: Rows | None = None


_HEAD, _LEG_ALONE = msgspec.msgpack.Decoder(Head), msgspec.msgpack.Decoder(Leg)
_UNREADABLE = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)


def read(payload: bytes) -> Head:
    """Decode the fields of a sample that the viewer uses.

    Raises:
        ValueError: when the message is too large or malformed; correct the sender.
    """
    if len(payload) > SAID[Sample.topic].most:
        raise ValueError(f"sample: found {len(payload):,} bytes, expected {SAID[Sample.topic].most:,}; send less")
    try:
        return _HEAD.decode(payload)
    except _UNREADABLE as error:
        raise ValueError(
            f"sample: found {len(payload)} malformed bytes ({str(error)[:80]}), expected msgpack; resend"
        ) from None


class Letter:
    """Queued payload, its arrival time, monotonic [s], and its fencing token; slots make it cheap to create."""

    __slots__ = ("now", "payload", "stamp")

    def __init__(self, payload: bytes, now: float, stamp: Stamp | None = None) -> None:
        self.payload, self.now, self.stamp = payload, now, stamp


class Held(NamedTuple):
    """Queued messages of one UAV and the arrival time of the first, monotonic [s]."""

    since: float
    letters: list[Letter]


class Inbox:
    """Queue of samples; the caller must own one common lock to fill or empty it."""

    def __init__(self) -> None:
        self.crowd = False
        self.keen: frozenset[int] = frozenset()  # UAVs of which every sample is kept, also in a large fleet
        self.lost = 0  # messages without a UAV id, or beyond the limit
        self._held: dict[int, Held] = {}  # oldest first
        self._kept: set[int] = set()  # UAVs whose last queued sample changes the mission item
        self._item: dict[int, bytes] = {}  # last mission item of each UAV

    def put(self, samples: list[Said], now: float) -> None:
        """Queue samples in order of arrival."""
        crowd, keen, kept = self.crowd, self.keen, self._kept
        for uav, payload, _, _ in samples:
            if uav is None:
                self.lost += 1
                continue
            news = crowd and _LEG in payload and self._is_news(uav, payload)
            held = self._held.get(uav)
            if held is None:
                if len(self._held) >= MOST_UAVS:
                    self.lost += 1
                    continue
                self._held[uav] = Held(now, [Letter(payload, now)])
            elif (not crowd or uav in keen or uav in kept) and len(held.letters) < MOST:
                held.letters.append(Letter(payload, now))
            else:
                held.letters[-1] = Letter(payload, now)
            kept.discard(uav)
            if news:
                kept.add(uav)

    def _is_news(self, uav: int, payload: bytes) -> bool:
        """Return whether a sample changes the mission item; True when it cannot be decoded."""
        try:
            told = _LEG_ALONE.decode(payload).leg.x
        except _UNREADABLE:
            return True
        before = self._item.get(uav)
        if len(self._item) < MOST_UAVS or before is not None:
            self._item[uav] = told.data
        return before != told.data

    def take(self, uavs: Iterable[int] | None = None) -> Iterator[tuple[int, Letter]]:
        """Remove and yield the messages of all or some UAVs, each UAV in order of arrival."""
        for uav in list(self._held) if uavs is None else uavs:
            if (held := self._held.pop(uav, None)) is not None:
                self._kept.discard(uav)
                yield from ((uav, letter) for letter in held.letters)

    def waiting(self, before: float) -> list[int]:
        """Return the UAVs with a message queued since before a time, monotonic [s]."""
        found = []
        for uav, held in self._held.items():
            if held.since > before:
                break
            found.append(uav)
        return found


class Newest:
    """Queue of the newest message per UAV; a message is due `wait_s` after the first one it replaced."""

    def __init__(self, wait_s: float) -> None:
        self._wait_s = wait_s
        self._held: dict[int, tuple[float, Letter]] = {}  # first arrival, monotonic [s]; oldest first

    def put(self, uav: int, letter: Letter) -> None:
        """Queue a message in place of the previous one."""
        held = self._held.get(uav)
        if held is not None or len(self._held) < MOST_UAVS:
            self._held[uav] = (held[0] if held is not None else letter.now), letter

    def drop(self, uav: int) -> None:
        """Discard the queued message of a UAV."""
        self._held.pop(uav, None)

    def due(self, now: float) -> list[tuple[int, Letter]]:
        """Remove and return the messages that are due at `now`, monotonic [s]."""
        found = []
        while self._held and (uav := next(iter(self._held))) is not None and self._held[uav][0] + self._wait_s <= now:
            found.append((uav, self._held.pop(uav)[1]))
        return found
