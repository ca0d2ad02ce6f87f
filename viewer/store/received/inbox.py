"""Letters not yet read: of a small fleet all are read, in a crowd the newest of each, and all with news of the mission.

Reading a letter costs ten times what putting it aside does: of a thousand aircraft only what is drawn is read.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import msgspec

from fleet.access.roles import SAID
from fleet.bus.bus_protocol import Letter as Said
from fleet.bus.codec import Stamp
from fleet.contract import Rows, Sample

CROWD = 300  # above this many a sample that a newer one has replaced is not read
MOST = 40  # letters kept of one UAV while nobody looks; the newest replaces the last
MOST_UAVS = 4_000  # of whom letters are kept: ids are written by strangers
_LEG = b"\xa3leg\x82"  # msgpack: the key, and a map after it, which nil is not


class Leg(msgspec.Struct):
    """Of a sample only the mission item in force."""

    leg: Rows


class Head(msgspec.Struct, frozen=True):
    """Of a sample what is drawn or told; the rest of it is passed over."""

    uav: int
    t: float
    attitude: Rows | None = None
    position: Rows | None = None
    air: Rows | None = None
    leg: Rows | None = None


_HEAD, _LEG_ALONE = msgspec.msgpack.Decoder(Head), msgspec.msgpack.Decoder(Leg)
_UNREADABLE = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)


def read(payload: bytes) -> Head:
    """Unpack what the viewer needs of a sample.

    Raises:
        ValueError: when the bytes are too many or do not fit; the sender must repair it.
    """
    if len(payload) > SAID[Sample.topic].most:
        raise ValueError(f"sample: found {len(payload):,} bytes, expected {SAID[Sample.topic].most:,}; send less")
    try:
        return _HEAD.decode(payload)
    except _UNREADABLE as error:
        raise ValueError(f"sample: found {len(payload)} bytes that do not fit ({str(error)[:80]}); resend") from None


class Letter:
    """What came, when, monotonic [s], and under which claim: ten thousand a second, so it is quickly made."""

    __slots__ = ("now", "payload", "stamp")

    def __init__(self, payload: bytes, now: float, stamp: Stamp | None = None) -> None:
        self.payload, self.now, self.stamp = payload, now, stamp


class Held(NamedTuple):
    """What waits of one UAV, and since when, monotonic [s]."""

    since: float
    letters: list[Letter]


class Inbox:
    """Samples that wait; who fills it and who empties it hold the same lock."""

    def __init__(self) -> None:
        self.crowd = False
        self.keen: frozenset[int] = frozenset()  # of whom every letter is kept, also in a crowd
        self.lost = 0  # letters that name nobody, or came when there was no room
        self._held: dict[int, Held] = {}  # who has waited longest first
        self._kept: set[int] = set()  # whose last letter has news of the mission
        self._item: dict[int, bytes] = {}  # the mission item each named last

    def put(self, samples: list[Said], now: float) -> None:
        """Take in samples as they came."""
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
        """Return whether a sample names another mission item than the one before; one that cannot be read may."""
        try:
            told = _LEG_ALONE.decode(payload).leg.x
        except _UNREADABLE:
            return True
        before = self._item.get(uav)
        if len(self._item) < MOST_UAVS or before is not None:
            self._item[uav] = told.data
        return before != told.data

    def take(self, uavs: Iterable[int] | None = None) -> Iterator[tuple[int, Letter]]:
        """Empty it, or take out what is of some UAVs: letters of each in the order they came."""
        for uav in list(self._held) if uavs is None else uavs:
            if (held := self._held.pop(uav, None)) is not None:
                self._kept.discard(uav)
                yield from ((uav, letter) for letter in held.letters)

    def waiting(self, before: float) -> list[int]:
        """Name those of whom something has waited since before a time, monotonic [s]."""
        found = []
        for uav, held in self._held.items():
            if held.since > before:
                break
            found.append(uav)
        return found


class Newest:
    """Letters of another class in a crowd: the newest of each, read when one has waited for so long."""

    def __init__(self, wait_s: float) -> None:
        self._wait_s = wait_s
        self._held: dict[int, tuple[float, Letter]] = {}  # since when, monotonic [s]; who has waited longest first

    def put(self, uav: int, letter: Letter) -> None:
        """Take in one in place of the one before."""
        held = self._held.get(uav)
        if held is not None or len(self._held) < MOST_UAVS:
            self._held[uav] = (held[0] if held is not None else letter.now), letter

    def drop(self, uav: int) -> None:
        """Forget what waits of a UAV: a newer one was read."""
        self._held.pop(uav, None)

    def due(self, now: float) -> list[tuple[int, Letter]]:
        """Take out what has waited long enough, at `now`, monotonic [s]."""
        found = []
        while self._held and (uav := next(iter(self._held))) is not None and self._held[uav][0] + self._wait_s <= now:
            found.append((uav, self._held.pop(uav)[1]))
        return found
