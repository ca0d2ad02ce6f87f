"""Parse binary DataFlash logs to `Records`, block by block, tolerant of damage.

A message is 0xA3 0x95, its type, and the fields of the FMT of that type. After damage the search continues one byte
later for a header whose message is followed by another header: one flipped bit loses one message.
"""

import lzma
import zlib
from collections.abc import Callable, Iterator
from typing import IO

import numpy as np

from fleet.telemetry.onboard_logs.dataflash.records import Damage, Format, Records, parse_format

BLOCK = 1 << 20  # bytes read at a time
MAGIC = b"\xa3\x95"
SYNC1, SYNC2 = MAGIC
FMT, FMT_LENGTH = 0x80, 89
MIN_MESSAGE, MAX_MESSAGE = 3, 255
_FMT = parse_format("FMT", "BBnNZ", "Type,Length,Name,Format,Columns", FMT_LENGTH)
MAX_DAMAGE = 1 << 25  # damaged bytes, beyond `_MAX_DAMAGE_RATIO` times the good ones, that end reading
_MAX_DAMAGE_RATIO = 4
_MAX_CHANGES = 2000  # maximum number of format declarations; a log has about a hundred
_READ_ERRORS = (OSError, EOFError, lzma.LZMAError, zlib.error)


def read_blocks(opener: Callable[[], IO[bytes]], damage: Damage) -> Iterator[list[Records]]:
    """Read a log from the start: the records of each MiB, with positions in bytes."""
    parser = BinaryParser(damage)
    with opener() as stream:
        for data in read_pieces(stream, damage):
            yield parser.feed(data)
            if parser.skipped_bytes > MAX_DAMAGE + _MAX_DAMAGE_RATIO * (parser.place - parser.skipped_bytes):
                damage.count("too much damage, the rest was not read", parser.place)
                break
    yield parser.feed(b"", last=True)


def read_pieces(stream: IO[bytes], damage: Damage) -> Iterator[bytes]:
    """Read a stream to its end, or to the first error of the decompression."""
    place = 0
    while True:
        try:
            data = stream.read(BLOCK)
        except _READ_ERRORS as error:
            damage.count(f"the file cannot be read on ({error or type(error).__name__})", place)
            return
        if not data:
            return
        place += len(data)
        yield data


class BinaryParser:
    """Split bytes into messages, and group messages by format."""

    def __init__(self, damage: Damage) -> None:
        assert _FMT is not None
        self._damage = damage
        self._base = 0  # file offset of the first byte of `_buf`
        self._buf = b""
        self._formats: list[Format | None] = [None] * 256
        self._lengths = [0] * 256
        self._starts: list[list[int]] = [[] for _ in range(256)]  # start of the messages of each type in `_buf`
        self._completed: list[Records] = []  # records with a format that was redefined
        self._formats[FMT], self._lengths[FMT] = _FMT, FMT_LENGTH
        self._declarations: dict[int, bytes] = {}  # bytes of the newest FMT of each type
        self._changes = 0
        self.skipped_bytes = 0  # skipped bytes

    @property
    def place(self) -> int:
        """Return the number of parsed bytes."""
        return self._base

    def feed(self, data: bytes, last: bool = False) -> list[Records]:
        """Parse the next bytes; return the messages they complete."""
        self._buf += data
        at = self._parse(last)
        completed = self._completed + [r for kind in range(256) if (r := self._records(kind)) is not None]
        self._completed = []
        self._buf = self._buf[at:]
        self._base += at
        return completed

    def _parse(self, last: bool) -> int:
        buf, lengths, starts = self._buf, self._lengths, self._starts
        at, size = 0, len(buf)
        end = size - 2 if last else size - 3 * MAX_MESSAGE
        previous: tuple[int, int] | None = None
        while at < end:
            type_id = buf[at + 2]
            length = lengths[type_id]
            if length and buf[at] == SYNC1 and buf[at + 1] == SYNC2:
                if at + length > size:
                    break
                starts[type_id].append(at)
                previous = (at, type_id)
                if type_id == FMT:
                    self._declare_format(at)
                at += length
            else:
                at = self._resume(at, previous, last)
                previous = None
        if last and at < size:
            self._record_damage(at, size)
            at = size
        return at

    def _resume(self, at: int, previous: tuple[int, int] | None, last: bool) -> int:
        """Find the next message after damage at `at`; the previous message may be damaged too."""
        buf, lengths = self._buf, self._lengths
        damage_start = at
        if previous is not None and buf[at : at + 2] != MAGIC:
            start, type_id = previous
            next_start = self._search(start + 1, last)
            previous_damaged = next_start < at or (
                next_start - start in lengths and buf[at] != SYNC1 and buf[at + 1] != SYNC2 and next_start < len(buf)
            )
            if previous_damaged:
                self._starts[type_id].pop()
                damage_start = start
        else:
            next_start = self._search(at + 1, last)
        self._record_damage(damage_start, next_start)
        return next_start

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

    def _record_damage(self, start: int, stop: int) -> None:
        skipped = self._buf[start:stop]
        self.skipped_bytes += stop - start
        if skipped.strip(b"\0") and skipped.strip(b"\xff"):  # page padding is no damage
            has_header = skipped[:2] == MAGIC and len(skipped) > 2
            kind = (
                "messages of an unknown type, bytes"
                if has_header and not self._lengths[skipped[2]]
                else "damaged bytes"
            )
            self._damage.count(kind, self._base + start, stop - start)

    def _declare_format(self, at: int) -> None:
        assert _FMT is not None and _FMT.layout is not None
        declaration = self._buf[at : at + FMT_LENGTH]
        if self._declarations.get(declaration[3]) == declaration:
            return
        self._changes += 1
        if self._changes > _MAX_CHANGES:
            self._damage.count("too many format declarations", self._base + at)
            return
        self._declarations[declaration[3]] = declaration
        records = Records(_FMT, np.array([at]), np.frombuffer(self._buf, _FMT.layout, 1, at))
        type_id, length = int(records.Type[0]), int(records.Length[0])
        if type_id == FMT:
            return
        name, codes, columns = (records.texts(c)[0] for c in ("Name", "Format", "Columns"))
        new_format = parse_format(name, codes, columns, length) if length >= MIN_MESSAGE else None
        if new_format is None:
            self._damage.count("formats that contradict themselves", self._base + at)
            return
        if self._formats[type_id] != new_format and (earlier := self._records(type_id)) is not None:
            self._completed.append(earlier)
        self._formats[type_id], self._lengths[type_id] = new_format, length

    def _records(self, type_id: int) -> Records | None:
        starts, format_ = self._starts[type_id], self._formats[type_id]
        if not starts or format_ is None or format_.layout is None:
            return None
        self._starts[type_id] = []
        return _extract(self._buf, format_, np.array(starts), self._base)


def _extract(buf: bytes, format_: Format, starts: np.ndarray, base: int) -> Records:
    assert format_.layout is not None
    n = len(buf) - format_.length + 1
    overlapping = np.ndarray((n,), np.dtype((np.void, format_.length)), buf, strides=(1,))
    return Records(format_, starts + base, overlapping[starts].view(format_.layout))
