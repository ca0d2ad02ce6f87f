r"""The `.parauav` file: what a fleet said on its bus, byte for byte. `fleet record` writes it.

A file is records and nothing else, so it may be cut anywhere, and two may be joined with `cat`:

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

MAGIC = b"\xc1UV1"  # C1 is the one byte that msgpack never uses
MOST = 1 << 22  # bytes of the longest body; the longest message there is, a mission of 1,000 items, has 200 kB
CHUNK = 1 << 20
HOPELESS = 1 << 26  # bytes without a single record after which a file is no recording of a fleet
SEARCHED = 8  # times the bytes read, and a `HOPELESS` more, are summed in vain before the rest is left unread
_PREFIX = "application/msgpack;"
_HEAD = struct.Struct("<4sII")
_BODY = struct.Struct("<dQQB")


class Record(NamedTuple):
    """One message as it was heard."""

    heard: float  # by the recorder [s since 1970]
    encoding: str  # as on the bus
    payload: bytes
    stamp: Stamp | None = None

    def pack(self) -> bytes:
        """Return the bytes in the file."""
        named = self.encoding.removeprefix(_PREFIX).encode("ascii", "replace")[:255]
        epoch, writer = self.stamp or (0, 0)
        body = _BODY.pack(self.heard, epoch, writer, len(named)) + named + self.payload
        return _HEAD.pack(MAGIC, len(body), zlib.crc32(body)) + body


class FleetLog:
    """The records of a file, whole, cut short or damaged.

    Args:
        source: the file
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self.read = 0  # records
        self.bad = 0  # bytes that belong to no sound record
        self.first_bad: int | None = None  # where the first of them is
        self.tangled = False  # the rest was left unread: too much begins like a record and is none

    def records(self) -> Iterator[tuple[int, Record]]:
        """Return the sound records: (place in the file [bytes], record)."""
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
    """How many bytes may still be summed for records that are none."""

    def __init__(self, left: int) -> None:
        self.left = left


def sound(told: bytes, last: bool = True, vain: Vain | None = None) -> Iterator[tuple[int, int]]:
    """Find the sound records in some bytes; the last pair is empty and tells where the search must go on.

    Args:
        told: any bytes
        last: nothing follows, so that what is not whole never will be
        vain: lowered by what is summed in vain; below 0 the search ends
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
    kept = len(told) if last else max(at, len(told) - len(MAGIC) + 1)  # the beginning of a magic may be there
    yield kept, kept


def _stop(told: bytes, start: int) -> int:
    """Tell where the record that begins here ends; beyond the bytes: not whole yet.

    0: it is none; less: it is none, and that many bytes were summed to know.
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
