"""Bytes to MAVLink frames of many senders at once, and frames to fields or whole messages."""

import re
from collections import Counter, OrderedDict
from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.telemetry import scan as s

MOST_SENDERS = 512  # addresses whose cut frames are remembered on one link
_NAMES = {number: kind.msgname for number, kind in dialect.mavlink_map.items()}
IDS = {name: number for number, name in _NAMES.items()}
_KIND = {"c": "S", "b": "i1", "B": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4"}
_KIND |= {"q": "<i8", "Q": "<u8", "f": "<f4", "d": "<f8"}

Piece = tuple[float, Hashable, bytes]
"""(arrival, fleet time [s since 1970]; sender; bytes as they came)."""


class Frames(NamedTuple):
    """Sound frames in the order they were heard."""

    buf: np.ndarray  # bytes they lie in, (b,) uint8
    at: np.ndarray  # `scan.COLUMNS` numbers a frame, (n, 8)
    arrival: np.ndarray  # fleet time, (n,) [s since 1970]
    sender: np.ndarray  # number of the sender in `senders`, (n,)
    senders: tuple[Hashable, ...] = (None,)

    def names(self, which: np.ndarray) -> list[str]:
        """Give the MAVLink names of frames `which`."""
        return [_NAMES[number] for number in self.at[which, s.ID].tolist()]

    def message(self, i: int) -> Any | None:
        """Give frame `i` as pymavlink would; None where it cannot be one, e.g. text that is no text."""
        frame = bytearray(self.buf[self.at[i, s.START] : self.at[i, s.STOP]].tobytes())
        try:
            return _PARSER.decode(frame)
        except (dialect.MAVError, ValueError, IndexError):
            return None

    def fields(self, which: np.ndarray, name: str) -> "Fields":
        """Give the fields of frames `which`, all of one message, as arrays."""
        kind = layout(name)
        laid = s.gather(self.buf, self.at[which, s.PAYLOAD], self.at[which, s.SIZE], kind.itemsize)
        return Fields(laid.view(kind)[:, 0])


_PARSER = dialect.MAVLink(None)


class Fields:
    """Fields of equal messages by name, each an array."""

    __slots__ = ("rows",)

    def __init__(self, rows: np.ndarray) -> None:
        self.rows = rows

    def __getattr__(self, name: str) -> np.ndarray:
        return self.rows[name]


_DTYPES: dict[str, np.dtype] = {}


def layout(name: str) -> np.dtype:
    """Give the layout of a message on the wire, read off pymavlink's class."""
    if name not in _DTYPES:
        kind = dialect.mavlink_map[IDS[name]]
        tokens = re.findall(r"(\d*)([a-zA-Z])", kind.unpacker.format.lstrip("<"))
        layout: list[Any] = []
        for field, (count, letter) in zip(kind.ordered_fieldnames, tokens, strict=True):
            layout.append((field, f"S{count or 1}") if letter in "cs" else (field, _KIND[letter], (int(count or 1),)))
        _DTYPES[name] = np.dtype([(f[0], f[1]) if len(f) == 2 or f[2] == (1,) else f for f in layout])
    return _DTYPES[name]


class Decoder:
    """Find the frames in what many senders say; each has its own carry, for frames may be cut between pieces."""

    def __init__(self) -> None:
        self.counts = np.zeros(3, np.int64)  # messages, bytes that belonged to no frame, unsound or unknown frames
        self._carry: OrderedDict[Hashable, bytes] = OrderedDict()

    def counters(self) -> Counter[str]:
        """Give messages, bad_bytes and bad_frames so far."""
        return Counter(dict(zip(("messages", "bad_bytes", "bad_frames"), self.counts.tolist(), strict=True)))

    def feed(self, pieces: Sequence[Piece]) -> Frames:
        """Take bytes as they came, give the frames completed by them in order of arrival."""
        by_sender: dict[Hashable, list[Piece]] = {}
        for piece in pieces:
            by_sender.setdefault(piece[1], []).append(piece)
        told, parts = bytearray(), np.empty((len(by_sender), 2), np.int64)
        ends: list[int] = []
        arrivals: list[float] = []
        for number, (sender, mine) in enumerate(by_sender.items()):
            parts[number, 0] = len(told)
            told += self._carry.pop(sender, b"")
            for came, _, data in mine:
                told += data
                ends.append(len(told))
                arrivals.append(came)
            parts[number, 1] = len(told)
        buf = np.frombuffer(bytes(told), np.uint8)
        begins = parts[:, 0].copy()
        at, _, _ = frames_of(buf, parts, self.counts)
        for sender, (start, stop) in zip(by_sender, parts.tolist(), strict=True):
            self._remember(sender, bytes(told[start:stop]))
        arrival = np.array(arrivals)[np.searchsorted(ends, at[:, s.STOP])] if len(at) else np.empty(0)
        sender_of = np.searchsorted(begins, at[:, s.START], side="right") - 1
        order = np.argsort(arrival, kind="stable") if len(by_sender) > 1 else slice(None)
        return Frames(buf, at[order], arrival[order], sender_of[order], tuple(by_sender))

    def _remember(self, sender: Hashable, rest: bytes) -> None:
        if rest:
            self._carry[sender] = rest
            if len(self._carry) > MOST_SENDERS:
                self.counts[1] += len(self._carry.popitem(last=False)[1])


def frames_of(
    buf: np.ndarray, parts: np.ndarray, counts: np.ndarray, prefix: int = 0, last_t: float = np.nan
) -> tuple[np.ndarray, np.ndarray, float]:
    """Run `scan.scan` over `buf`; gives its frames (n, 8), their stamps (n,) [us] and the newest stamp [us]."""
    most = len(buf) // (8 + prefix) + 1
    found, times = np.empty((most, s.COLUMNS), np.int64), np.empty(most)
    n, last_t = s.scan(buf, parts, prefix, last_t, found, times, counts, s.EXTRA, s.CRC)
    return found[:n], times[:n], last_t
