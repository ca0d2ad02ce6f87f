"""Samples not yet read: of a small fleet every one, in a crowd the newest of each, and all with news of the mission."""

import threading
from collections.abc import Iterable

import msgspec

from fleet.contract import Rows

CROWD = 300  # above this many a sample that a newer one has replaced is not read
MOST = 40  # letters kept of one UAV while nobody looks; the newest replaces the last
MOST_UAVS = 4_000  # of whom letters are kept: ids are written by strangers
_LEG = b"\xa3leg\x82"  # msgpack: the key, and a map after it, which nil is not


class Whose(msgspec.Struct):
    """Of a message only whose it is."""

    uav: int


class Leg(msgspec.Struct):
    """Of a sample only the mission item in force."""

    leg: Rows


Letter = tuple[bytes, float]
"""What came, and when, monotonic [s]."""


class Inbox:
    """Filled by the bus's thread, emptied by whoever reads."""

    def __init__(self) -> None:
        self.crowd = False
        self.keen: frozenset[int] = frozenset()  # of whom every letter is kept, also in a crowd
        self.lost = 0  # letters that name nobody, or came when there was no room
        self._letters: dict[int, list[Letter]] = {}
        self._kept: set[int] = set()  # whose last letter has news of the mission
        self._item: dict[int, bytes] = {}  # the mission item each named last
        self._leg = msgspec.msgpack.Decoder(Leg)
        self._whose = msgspec.msgpack.Decoder(Whose)
        self._lock = threading.Lock()

    def put(self, payload: bytes, now: float) -> None:
        """Take in one sample as it came; one that cannot be read at all is counted."""
        try:
            uav = self._whose.decode(payload).uav
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            self.lost += 1
            return
        news = self.crowd and _LEG in payload and self._is_news(uav, payload)
        with self._lock:
            held = self._letters.get(uav)
            if held is None:
                if len(self._letters) < MOST_UAVS:
                    self._letters[uav] = [(payload, now)]
                else:
                    self.lost += 1
            elif len(held) < MOST and (not self.crowd or uav in self.keen or uav in self._kept):
                held.append((payload, now))
            else:
                held[-1] = payload, now
            self._kept.discard(uav)
            if news:
                self._kept.add(uav)

    def _is_news(self, uav: int, payload: bytes) -> bool:
        """Tell whether a sample names another mission item than the one before; one that cannot be read may."""
        try:
            told = self._leg.decode(payload).leg.x
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return True
        before = self._item.get(uav)
        if len(self._item) < MOST_UAVS or before is not None:
            self._item[uav] = told.data
        return before != told.data

    def take(self, uavs: Iterable[int] | None = None) -> list[Letter]:
        """Empty it, or take out what is of some UAVs: letters of each in the order they came."""
        if not self._letters:
            return []
        with self._lock:
            if uavs is not None:
                return [letter for uav in uavs for letter in self._letters.pop(uav, ())]
            letters, self._letters = self._letters, {}
            self._kept.clear()
        return [letter for held in letters.values() for letter in held]
