r"""The `.parauav` file: the unmodified bus messages of a fleet. `fleet record` writes it.

A file contains only records, so it may be truncated anywhere, and files may be joined with `cat`:

    record   magic C1 55 56 31 | size u32 | crc u32 | body, `size` bytes long; crc is the CRC-32 (zlib) of the body
    body     heard f64 [s since 1970] | epoch u64 | writer u64 | n u8 | encoding, n bytes of ASCII | payload

All numbers are little endian. `encoding` names class and version as on the bus, without `application/msgpack;`, e.g.
`parauav.sample.1`; `payload` is the message's msgpack. Epoch and writer are 0 where the message carried none.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from typing import NamedTuple

from fleet.bus.codec import Stamp
from fleet.telemetry.recording.opening import Source

MAGIC = b"\xc1UV1"  # msgpack never uses the byte C1
MOST = 1 << 22  # maximum body size [bytes]; the longest message, a mission of 1,000 items, has 200 kB
CHUNK = 1 << 20
HOPELESS = 1 << 26  # bytes without a record after which reading ends
SEARCHED = 8  # search budget [bytes summed]: this times the bytes read, plus `MAX_UNRECOGNISED`
_PREFIX = "application/msgpack;"
_HEAD = struct.Struct("<4sII")
_BODY = struct.Struct("<dQQB")


class Record(NamedTuple):
    """One recorded message."""

    heard: float  # reception by the recorder [s since 1970]
    encoding: str  # as on the bus
    payload: bytes
    stamp: Stamp | None = None

    def pack(self) -> bytes:
        """Encode the record for the file."""
        named = self.encoding.removeprefix(_PREFIX).encode("ascii", "replace")[:255]
        epoch, writer = self.stamp or (0, 0)
        body = _BODY.pack(self.heard, epoch, writer, len(named)) + named + self.payload
        return _HEAD.pack(MAGIC, len(body), zlib.crc32(body)) + body


class FleetLog:
    """Reader of the records of a file, tolerant of truncation and damage.

    Args:
        source: the file
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self.read = 0  # number of records read
        self.bad = 0  # bytes outside valid records
        self.first_bad: int | None = None  # position of the first of them
        self.tangled = False  # reading ended: too many invalid record headers

    def records(self) -> Iterator[tuple[int, Record]]:
        """Return the valid records: (file offset [bytes], record)."""
        rest, place, vain = b"", 0, Vain(HOPELESS)
        with self._source.open() as stream:
            while True:
                chunk = stream.read(CHUNK) or b""
                told, at = rest + chunk, 0
                vain.left += SEARCHED * len(chunk)
                for start, stop in sound(told, not chunk, vain):
                    self._skip(place + at, start - at)
                    at = stop
                    if start < stop:
                        self.read += 1
                        yield place + start, _unpack(told[start:stop])
                rest, place = told[at:], place + at
                self.tangled = vain.left < 0
                if not chunk or self.tangled or (not self.read and place > HOPELESS):
                    return

    def _skip(self, place: int, count: int) -> None:
        if count and self.first_bad is None:
            self.first_bad = place
        self.bad += count


class Vain:
    """Number of bytes that may still be summed for invalid records."""

    def __init__(self, left: int) -> None:
        self.left = left


def sound(told: bytes, last: bool = True, vain: Vain | None = None) -> Iterator[tuple[int, int]]:
    """Find the valid records in bytes; the last pair is empty and marks where to continue.

    Args:
        data: any bytes
        last: whether no bytes follow, so that incomplete records are invalid
        budget: reduced by the bytes summed for invalid records; below 0 the search ends
    """
    at, vain = 0, Vain(HOPELESS) if vain is None else vain
    while vain.left >= 0 and (start := told.find(MAGIC, at)) >= 0:
        stop = _stop(told, start)
        if stop > len(told) and not last:
            yield start, start
            return
        if start < stop <= len(told):
            yield start, stop
            at = stop
        else:
            at = start + 1
            vain.left -= max(-stop, 0)
    kept = len(told) if last else max(at, len(told) - len(MAGIC) + 1)  # may contain the start of a magic
    yield kept, kept


def _stop(told: bytes, start: int) -> int:
    """Return the end of the record at `start`; beyond the bytes if incomplete.

    0: invalid; negative: invalid, after a checksum over this number of bytes.
    """
    after = start + _HEAD.size
    if after > len(told):
        return after
    _, size, crc = _HEAD.unpack_from(told, start)
    if not _BODY.size <= size <= MOST:
        return 0
    stop = after + int(size)
    if stop <= len(told) and zlib.crc32(memoryview(told)[after:stop]) != crc:
        return after - stop
    return stop


def _unpack(told: bytes) -> Record:
    heard, epoch, writer, n = _BODY.unpack_from(told, _HEAD.size)
    begin = _HEAD.size + _BODY.size
    named = told[begin : begin + n].decode("ascii", "replace")
    stamp = Stamp(epoch, writer) if epoch or writer else None
    return Record(heard if math.isfinite(heard) else 0.0, _PREFIX + named, told[begin + n :], stamp)
