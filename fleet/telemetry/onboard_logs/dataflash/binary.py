"""Parse binary DataFlash logs to `Records`, block by block, tolerant of damage.

A message is 0xA3 0x95, its type, and the fields of the FMT of that type. After damage the search continues one byte
later for a header whose message is followed by another header: one flipped bit loses one message.
"""

import lzma
import zlib
from collections.abc import Callable, Iterator
from typing import IO

import numpy as np

from fleet.telemetry.onboard_logs.dataflash.records import Damage, Format, Records, form

BLOCK = 1 << 20  # bytes read at a time
MAGIC = b"\xa3\x95"
HEAD1, HEAD2 = MAGIC
FMT, FMT_LENGTH = 0x80, 89
SHORTEST, LONGEST = 3, 255
_FMT = form("FMT", "BBnNZ", "Type,Length,Name,Format,Columns", FMT_LENGTH)
HOPELESS = 1 << 25  # damaged bytes, beyond `_MAX_DAMAGE_RATIO` times the good ones, that end reading
_WORSE = 4
_MOST_CHANGES = 2000  # maximum number of format declarations; a log has about a hundred
_READ_ERRORS = (OSError, EOFError, lzma.LZMAError, zlib.error)


def blocks(opener: Callable[[], IO[bytes]], damage: Damage) -> Iterator[list[Records]]:
    """Read a log from the start: the records of each MiB, with positions in bytes."""
    walk = Walk(damage)
    with opener() as stream:
        for data in pieces(stream, damage):
            yield walk.feed(data)
            if walk.lost > HOPELESS + _WORSE * (walk.place - walk.lost):
                damage.note("too much damage, the rest was not read", walk.place)
                break
    yield walk.feed(b"", last=True)


def pieces(stream: IO[bytes], damage: Damage) -> Iterator[bytes]:
    """Read a stream to its end, or to the first error of the decompression."""
    place = 0
    while True:
        try:
            data = stream.read(BLOCK)
        except _READ_ERRORS as error:
            damage.note(f"the file cannot be read on ({error or type(error).__name__})", place)
            return
        if not data:
            return
        place += len(data)
        yield data


class Walk:
    """Split bytes into messages, and group messages by format."""

    def __init__(self, damage: Damage) -> None:
        assert _FMT is not None
        self._damage = damage
        self._base = 0  # file offset of the first byte of `_buf`
        self._buf = b""
        self._formats: list[Format | None] = [None] * 256
        self._lengths = [0] * 256
        self._hits: list[list[int]] = [[] for _ in range(256)]  # start of the messages of each type in `_buf`
        self._done: list[Records] = []  # records with a format that was redefined
        self._formats[FMT], self._lengths[FMT] = _FMT, FMT_LENGTH
        self._told: dict[int, bytes] = {}  # bytes of the newest FMT of each type
        self._changes = 0
        self.lost = 0  # skipped bytes

    @property
    def place(self) -> int:
        """Return the number of parsed bytes."""
        return self._base

    def feed(self, data: bytes, last: bool = False) -> list[Records]:
        """Parse the next bytes; return the messages they complete."""
        self._buf += data
        at = self._walk(last)
        found = self._done + [r for kind in range(256) if (r := self._records(kind)) is not None]
        self._done = []
        self._buf = self._buf[at:]
        self._base += at
        return found

    def _walk(self, last: bool) -> int:
        buf, lengths, hits = self._buf, self._lengths, self._hits
        at, size = 0, len(buf)
        end = size - 2 if last else size - 3 * LONGEST
        before: tuple[int, int] | None = None
        while at < end:
            kind = buf[at + 2]
            length = lengths[kind]
            if length and buf[at] == HEAD1 and buf[at + 1] == HEAD2:
                if at + length > size:
                    break
                hits[kind].append(at)
                before = (at, kind)
                if kind == FMT:
                    self._define(at)
                at += length
            else:
                at = self._resume(at, before, last)
                before = None
        if last and at < size:
            self._lose(at, size)
            at = size
        return at

    def _resume(self, at: int, before: tuple[int, int] | None, last: bool) -> int:
        """Find the next message after damage at `at`; the previous message may be damaged too."""
        buf, lengths = self._buf, self._lengths
        bad = at
        if before is not None and buf[at : at + 2] != MAGIC:
            start, kind = before
            found = self._search(start + 1, last)
            torn = found < at or (
                found - start in lengths and buf[at] != HEAD1 and buf[at + 1] != HEAD2 and found < len(buf)
            )
            if torn:
                self._hits[kind].pop()
                bad = start
        else:
            found = self._search(at + 1, last)
        self._lose(bad, found)
        return found

    def _search(self, at: int, last: bool) -> int:
        """Find a message followed by another one, or the position at which more bytes are required."""
        buf, lengths, size = self._buf, self._lengths, len(self._buf)
        while (at := buf.find(MAGIC, at)) >= 0:
            if at + 3 > size:
                break
            length = lengths[buf[at + 2]]
            after = at + length
            if length and (after == size if after + 2 > size else buf[after : after + 2] == MAGIC):
                return at
            if length and after + 2 > size and not last:
                return at
            at += 1
        return size if at < 0 or last else at

    def _lose(self, start: int, stop: int) -> None:
        lost = self._buf[start:stop]
        self.lost += stop - start
        if lost.strip(b"\0") and lost.strip(b"\xff"):  # page padding is no damage
            known = lost[:2] == MAGIC and len(lost) > 2
            kind = "messages of an unknown type, bytes" if known and not self._lengths[lost[2]] else "damaged bytes"
            self._damage.note(kind, self._base + start, stop - start)

    def _define(self, at: int) -> None:
        assert _FMT is not None and _FMT.layout is not None
        told = self._buf[at : at + FMT_LENGTH]
        if self._told.get(told[3]) == told:
            return
        self._changes += 1
        if self._changes > _MOST_CHANGES:
            self._damage.note("too many format declarations", self._base + at)
            return
        self._told[told[3]] = told
        found = Records(_FMT, np.array([at]), np.frombuffer(self._buf, _FMT.layout, 1, at))
        kind, length = int(found.Type[0]), int(found.Length[0])
        if kind == FMT:
            return
        name, codes, columns = (found.texts(c)[0] for c in ("Name", "Format", "Columns"))
        new = form(name, codes, columns, length) if length >= SHORTEST else None
        if new is None:
            self._damage.note("formats that contradict themselves", self._base + at)
            return
        if self._formats[kind] != new and (records := self._records(kind)) is not None:
            self._done.append(records)
        self._formats[kind], self._lengths[kind] = new, length

    def _records(self, kind: int) -> Records | None:
        hits, known = self._hits[kind], self._formats[kind]
        if not hits or known is None or known.layout is None:
            return None
        self._hits[kind] = []
        return _cut(self._buf, known, np.array(hits), self._base)


def _cut(buf: bytes, known: Format, starts: np.ndarray, base: int) -> Records:
    assert known.layout is not None
    n = len(buf) - known.length + 1
    every = np.ndarray((n,), np.dtype((np.void, known.length)), buf, strides=(1,))
    return Records(known, starts + base, every[starts].view(known.layout))
