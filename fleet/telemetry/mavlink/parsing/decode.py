"""Decode bytes of many senders to MAVLink frames, and frames to field arrays or messages."""

import re
from collections import Counter, OrderedDict
from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.telemetry.mavlink.parsing import scan as s
from fleet.telemetry.mavlink.parsing.objects import objects
from fleet.telemetry.mavlink.parsing.payload_gather import deal, gather
from fleet.telemetry.mavlink.parsing.received import Heard, tight

MOST_SENDERS = 512  # senders of one link whose incomplete frames are stored
_NAMES = {number: kind.msgname for number, kind in dialect.mavlink_map.items()}
IDS = {name: number for number, name in _NAMES.items()}
_KIND = {"c": "S", "b": "i1", "B": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4"}
_KIND |= {"q": "<i8", "Q": "<u8", "f": "<f4", "d": "<f8"}


class Frames(NamedTuple):
    """Valid frames in order of reception."""

    buf: np.ndarray  # bytes that contain the frames, (b,) uint8
    at: np.ndarray  # `scan.COLUMNS` numbers per frame, (n, 9)
    arrival: np.ndarray  # fleet time, (n,) [s since 1970]
    sender: np.ndarray  # number of the sender in `senders`, (n,)
    senders: tuple[Hashable, ...] = (None,)

    def messages(self, which: np.ndarray) -> list[Any]:
        """Return frames, by number, as message objects like those of pymavlink, (k,)."""
        found: list[Any] = [None] * len(which)
        numbers = self.at[which, s.ID]
        for number in np.unique(numbers).tolist():
            mine = np.flatnonzero(numbers == number)
            said, name = which[mine], _NAMES[number]
            who = self.at[said][:, [s.SYSTEM, s.COMPONENT]].T.tolist()
            for k, one in zip(mine.tolist(), objects(name, self.fields(said, name).rows, *who), strict=True):
                found[k] = one
        return found

    def only(self, which: np.ndarray) -> "Frames":
        """Return a selection of the frames, by number or mask."""
        return self._replace(at=self.at[which], arrival=self.arrival[which], sender=self.sender[which])

    def fields(self, which: np.ndarray, name: str) -> "Fields":
        """Return the fields of frames of one message as arrays."""
        kind = layout(name)
        laid = gather(self.buf, self.at[which, s.PAYLOAD], self.at[which, s.SIZE], kind.itemsize)
        return Fields(laid.view(kind)[:, 0])

    def dealt(self) -> "Dealt":
        """Group all frames by message."""
        return Dealt(self)


def joined(parts: Sequence[Frames]) -> Frames:
    """Join several batches in order."""
    if len(parts) == 1:
        return parts[0]
    ats, numbers = [], []
    known: dict[Hashable, int] = {}
    begin = 0
    for part in parts:
        at = part.at.copy()
        at[:, [s.START, s.STOP, s.PAYLOAD]] += begin
        ats.append(at)
        renumbered = [known.setdefault(sender, len(known)) for sender in part.senders]
        numbers.append(np.array(renumbered, np.int64)[part.sender])
        begin += len(part.buf)
    buf, arrival = np.concatenate([part.buf for part in parts]), np.concatenate([part.arrival for part in parts])
    return Frames(buf, np.concatenate(ats), arrival, np.concatenate(numbers), tuple(known))


class Fields:
    """Field arrays of frames of one message, by field name."""

    __slots__ = ("rows",)

    def __init__(self, rows: np.ndarray) -> None:
        self.rows = rows

    def __getattr__(self, name: str) -> np.ndarray:
        return self.rows[name]


_DTYPES: dict[str, np.dtype] = {}


def layout(name: str) -> np.dtype:
    """Return the wire layout of a message, derived from pymavlink's class."""
    if name not in _DTYPES:
        kind = dialect.mavlink_map[IDS[name]]
        tokens = re.findall(r"(\d*)([a-zA-Z])", kind.unpacker.format.lstrip("<"))
        layout: list[Any] = []
        for field, (count, letter) in zip(kind.ordered_fieldnames, tokens, strict=True):
            layout.append((field, f"S{count or 1}") if letter in "cs" else (field, _KIND[letter], (int(count or 1),)))
        _DTYPES[name] = np.dtype([(f[0], f[1]) if len(f) == 2 or f[2] == (1,) else f for f in layout])
    return _DTYPES[name]


_ORDER = {_NAMES[number]: kind for kind, number in enumerate(sorted(_NAMES))}
_KINDS = np.zeros(len(s.EXTRA), np.int64)
_KINDS[[IDS[name] for name in _ORDER]] = list(_ORDER.values())
_LAYOUTS = [layout(name) for name in _ORDER]
_WIDTHS = np.array([kind.itemsize for kind in _LAYOUTS])


KINDS = tuple(_ORDER)
"""Names of all messages of the dialect, by number."""


def kinds(frames: Frames) -> np.ndarray:
    """Return the index of each frame's message in `MESSAGE_NAMES`, (n,)."""
    return _KINDS[frames.at[:, s.ID]]


class Dealt:
    """Frames grouped by message, in order of reception."""

    def __init__(self, frames: Frames) -> None:
        self._told, begin, self._which, first = deal(frames.buf, frames.at, _KINDS, _WIDTHS)
        self._begin, self._first = begin.tolist(), first.tolist()

    def fields(self, name: str) -> tuple[np.ndarray, Fields]:
        """Return the frames of one message: frame numbers, (k,), and field arrays."""
        kind = _ORDER[name]
        told = self._told[self._begin[kind] : self._begin[kind + 1]]
        return self._which[self._first[kind] : self._first[kind + 1]], Fields(told.view(_LAYOUTS[kind]))

    def names(self) -> list[str]:
        """Return the names of the received messages."""
        return [name for name, kind in _ORDER.items() if self._first[kind] < self._first[kind + 1]]


class Decoder:
    """Find frames in the bytes of many senders; incomplete frames are carried over by sender."""

    def __init__(self) -> None:
        self.counts = np.zeros(s.COUNTS, np.int64)
        self._carry: OrderedDict[Hashable, bytes] = OrderedDict()

    def counters(self) -> Counter[str]:
        """Return the counts of messages, bad_bytes, bad_frames and unknown (frames of messages outside the dialect)."""
        names = ("messages", "bad_bytes", "bad_frames", "unknown")
        return Counter(dict(zip(names, self.counts.tolist(), strict=True)))

    def feed(self, heard: Heard) -> Frames:
        """Decode pieces in order of arrival; return the frames they complete."""
        if self._carry and not self._carry.keys().isdisjoint(heard.senders):
            return self._joined(heard)
        found = _room(heard.buf, 0)
        n = s.straight(heard.buf, heard.start, heard.stop, found, s.EXTRA, s.CRC)
        if n < 0:
            counts = self.counts.copy()
            parts = np.stack([heard.start, heard.stop, np.zeros_like(heard.start)], axis=1)
            found, _, _ = frames_of(heard.buf, parts, counts)
            if (parts[:, 0] < parts[:, 1]).any():
                return self._joined(heard)
            self.counts[:] = counts
        else:
            self.counts[s.MESSAGES] += n
            found = found[:n]
        part = found[:, s.PART]
        return Frames(heard.buf, found, heard.arrival[part], heard.sender[part], heard.senders)

    def _joined(self, heard: Heard) -> Frames:
        """Decode the joined pieces of each sender, after its carried bytes."""
        order = np.argsort(heard.sender, kind="stable")
        told, ends = tight(heard.buf, heard.start[order], (heard.stop - heard.start)[order])
        last = np.searchsorted(heard.sender[order], np.arange(len(heard.senders)), side="right")
        stops = np.concatenate([[0], ends])[last]  # end of each sender's bytes
        carries = [self._carry.pop(sender, b"") for sender in heard.senders]
        carried = np.array([len(carry) for carry in carries])
        grown = np.cumsum(carried)
        pieces = zip(carries, np.split(told, stops[:-1]), strict=True)
        buf = np.frombuffer(b"".join(part for carry, mine in pieces for part in (carry, mine.tobytes())), np.uint8)
        parts = np.stack([np.concatenate([[0], (stops + grown)[:-1]]), stops + grown, carried > 0], axis=1)
        at, _, _ = frames_of(buf, parts, self.counts)
        for number in np.flatnonzero(parts[:, 0] < parts[:, 1]).tolist():
            self._remember(heard.senders[number], buf[parts[number, 0] : parts[number, 1]].tobytes())
        sender = at[:, s.PART]
        arrival = heard.arrival[order][np.searchsorted(ends, at[:, s.STOP] - grown[sender])]
        order = np.argsort(arrival, kind="stable")
        return Frames(buf, at[order], arrival[order], sender[order], heard.senders)

    def _remember(self, sender: Hashable, rest: bytes) -> None:
        self._carry[sender] = rest
        if len(self._carry) > MOST_SENDERS:
            self.counts[s.BAD_BYTES] += len(self._carry.popitem(last=False)[1])


def frames_of(
    buf: np.ndarray, parts: np.ndarray, counts: np.ndarray, prefix: int = 0, last_t: float = np.nan
) -> tuple[np.ndarray, np.ndarray, float]:
    """Run `scan.scan` on `buf`; return frames (n, 9), their stamps (n,) [us] and the newest stamp [us]."""
    found = _room(buf, prefix)
    times = np.empty(len(found) if prefix else 0)
    n, last_t = s.scan(buf, parts, prefix, last_t, found, times, counts, s.EXTRA, s.CRC)
    return found[:n], times[:n], last_t


def _room(buf: np.ndarray, prefix: int) -> np.ndarray:
    """Return an empty header array for the maximum number of frames in `buf`."""
    return np.empty((len(buf) // (8 + prefix) + 1, s.COLUMNS), np.int64)
