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

MAGIC = b"\xc1UV1"  # msgpack never uses the byte C1
MAX_BODY = 1 << 22  # maximum body size [bytes]; the longest message, a mission of 1,000 items, has 200 kB
MAX_UNRECOGNISED = 1 << 26  # bytes without a record after which reading ends
_PREFIX = "application/msgpack;"
_HEAD = struct.Struct("<4sII")
_BODY = struct.Struct("<dQQB")


class BusRecord(NamedTuple):
    """One recorded message."""

    received_t: float  # reception by the recorder [s since 1970]
    encoding: str  # as on the bus
    payload: bytes
    stamp: Stamp | None = None

    def pack(self) -> bytes:
        """Encode the record for the file."""
        encoding_name = self.encoding.removeprefix(_PREFIX).encode("ascii", "replace")[:255]
        epoch, writer = self.stamp or (0, 0)
        body = _BODY.pack(self.received_t, epoch, writer, len(encoding_name)) + encoding_name + self.payload
        return _HEAD.pack(MAGIC, len(body), zlib.crc32(body)) + body

    @classmethod
    def unpack(cls, data: bytes) -> "BusRecord":
        """Decode a valid record of a file."""
        received_t, epoch, writer, name_size = _BODY.unpack_from(data, _HEAD.size)
        begin = _HEAD.size + _BODY.size
        encoding_name = data[begin : begin + name_size].decode("ascii", "replace")
        stamp = Stamp(epoch, writer) if epoch or writer else None
        received_t = received_t if math.isfinite(received_t) else 0.0
        return cls(received_t, _PREFIX + encoding_name, data[begin + name_size :], stamp)


class SearchBudget:
    """Number of bytes that may still be summed for invalid records."""

    def __init__(self, remaining: int) -> None:
        self.remaining = remaining


def find_records(data: bytes, last: bool = True, budget: SearchBudget | None = None) -> Iterator[tuple[int, int]]:
    """Find the valid records in bytes; the last pair is empty and marks where to continue.

    Args:
        data: any bytes
        last: whether no bytes follow, so that incomplete records are invalid
        budget: reduced by the bytes summed for invalid records; below 0 the search ends
    """
    position, budget = 0, SearchBudget(MAX_UNRECOGNISED) if budget is None else budget
    while budget.remaining >= 0 and (start := data.find(MAGIC, position)) >= 0:
        stop = _record_end(data, start)
        if stop > len(data) and not last:
            yield start, start
            return
        if start < stop <= len(data):
            yield start, stop
            position = stop
        else:
            position = start + 1
            budget.remaining -= max(-stop, 0)
    resume = len(data) if last else max(position, len(data) - len(MAGIC) + 1)  # may contain the start of a magic
    yield resume, resume


def _record_end(data: bytes, start: int) -> int:
    """Return the end of the record at `start`; beyond the bytes if incomplete.

    0: invalid; negative: invalid, after a checksum over this number of bytes.
    """
    after = start + _HEAD.size
    if after > len(data):
        return after
    _, size, crc = _HEAD.unpack_from(data, start)
    if not _BODY.size <= size <= MAX_BODY:
        return 0
    stop = after + int(size)
    if stop <= len(data) and zlib.crc32(memoryview(data)[after:stop]) != crc:
        return after - stop
    return stop
