"""Filter of ULog bytes: pass only complete, valid messages of wanted topics; count and report the rest.

pyulog does not validate its input: one damaged byte can lose the rest of a file, or all of it. This filter passes only
bytes that pyulog can read. It streams: memory is one buffer of the file.
Source: PX4 guide, "ULog file format".
"""

import lzma
import re
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from typing import IO

from fleet.telemetry.onboard_logs.ulog.formats import Formats, is_possible_body, is_readable

MAGIC = b"ULog\x01\x12\x35"
HEADER = 16  # bytes: magic, version, start stamp
MAX_FILE_BYTES = 1 << 29  # maximum bytes read of one file
MAX_SILENT_BYTES = 1 << 26  # bytes without a valid message that end reading
MAX_JUMP_US = 60_000_000  # larger time jumps need confirmation [us]
MAX_STAMP_US = 1 << 52  # later stamps are invalid [us]
MIN_AGREEING = 20  # consecutive stamps that confirm a time jump
_BLOCK = 1 << 20
_MAX_MESSAGE = 3 + 0xFFFF  # bytes of the longest message
_SYNC = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"
_TYPES = frozenset(b"ABCDFILMOPQRS")
_TYPE_BYTE = re.compile(rb"[ABCDFILMOPQRS]")
_PASSED_TYPES = frozenset(b"ACDFILOP")  # types that pyulog requires
_DATA = ord("D")
_LEVELS = frozenset(b"01234567")
_read_header = struct.Struct("<HB").unpack_from
_read_uint16 = struct.Struct("<H").unpack_from
_read_stamp = struct.Struct("<Q").unpack_from
_MAX_PLACES = 8  # damaged positions reported
_MAX_SLOW = 2_000_000  # maximum number of messages parsed individually
_MAX_WANTED_BYTES = 1 << 27  # bytes of wanted rows: 30 min at the highest rates, else 2 h
_KIND_LIMITS = dict.fromkeys(b"CILOP", (20000, 1 << 22))  # maximum messages of a type and their bytes
_MAX_SEARCHED = 2_000_000_000  # maximum search cost: bytes examined, plus `_SEARCH_COST` per position
_SEARCH_COST = 1000


class UlogFilter:
    """File object for pyulog: a header, then only valid messages."""

    def __init__(self, opener: Callable[[], IO[bytes]], wanted: frozenset[str], skipped: list[str]) -> None:
        self.start_us = 0
        self.formats = Formats(wanted)
        self.messages = 0  # valid messages, wanted or not
        self._skipped, self._file = skipped, opener()
        self._buffer, self._at, self._base, self._ended = bytearray(), 0, 0, False  # base: file offset of raw[0]
        self._passed, self._read_at = bytearray(), 0
        self._batches = self._parse()
        self._restarts: list[int] = []
        self._newest_us: int | None = None
        self._jumped_count = 0
        self._dropped: Counter[str] = Counter()
        self._places = 0
        self._damage: list[int] | None = None  # start, end
        self._in_data = False
        self._slow_count = self._wanted_bytes = self._searched_bytes = 0  # running totals of the limits `_MAX_…`
        self._small: Counter[int] = Counter()
        self._small_bytes: Counter[int] = Counter()

    # --- file interface for pyulog ---

    def read(self, n: int) -> bytes:
        """Return the next `n` bytes, fewer at the end."""
        while len(self._passed) - self._read_at < n:
            batch = next(self._batches, None)
            if batch is None:
                break
            del self._passed[: max(self._read_at - _MAX_MESSAGE, 0)]  # pyulog seeks back by one message
            self._read_at = min(self._read_at, _MAX_MESSAGE)
            self._passed += batch
        data = bytes(self._passed[self._read_at : self._read_at + n])
        self._read_at += len(data)
        return data

    def seek(self, offset: int, whence: int = 0) -> int:
        """Seek relative to the current position, back by at most one message; pyulog needs no other seek."""
        self._read_at = max(self._read_at + offset, 0) if whence == 1 else self._read_at
        return self._read_at

    def tell(self) -> int:
        """Return the position in the buffer of passed bytes."""
        return self._read_at

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    # --- raw bytes ---

    def _fill(self, need: int) -> bool:
        """Buffer at least `need` bytes from here on; return whether the file has them."""
        while len(self._buffer) - self._at < need and not self._ended:
            del self._buffer[: self._at]
            self._base, self._at = self._base + self._at, 0
            self._buffer += self._block()
        return len(self._buffer) - self._at >= need

    def _block(self) -> bytes:
        remaining = MAX_FILE_BYTES - self._base - len(self._buffer)
        try:
            block = self._file.read(min(_BLOCK, remaining)) if remaining > 0 else b""
        except (OSError, EOFError, lzma.LZMAError, zlib.error) as error:
            block = b""
            self._add_message(f"the file is damaged ({error}); the data before are used")
        if remaining <= 0:
            self._add_message(f"it is longer than {MAX_FILE_BYTES >> 20} MiB, the rest was not read; split it")
        self._ended = not block
        return block

    @property
    def _offset(self) -> int:
        return self._base + self._at

    # --- parsing ---

    def _parse(self) -> Iterator[bytes]:
        yield self._header()
        batch, last_good = bytearray(), self._offset
        while self._fill(3):
            if limit := self._limit_reached():
                self._add_message(f"{limit} up to byte {self._offset}, the rest was not read; split it")
                break
            message = self._skip_good_rows()
            if not message and self._fill(3):
                message = self._next_message()
            if message is None:
                if self._offset - last_good > MAX_SILENT_BYTES:
                    self._add_message(
                        f"{MAX_SILENT_BYTES >> 20} MiB without a message from byte {last_good} on, the rest "
                        "was not read"
                    )
                    break
                continue
            last_good = self._offset
            batch += message
            if len(batch) >= 1 << 16:
                yield bytes(batch)
                batch.clear()
        yield bytes(batch)
        self._report()

    def _limit_reached(self) -> str:
        """Return the limit that ends reading, or an empty string."""
        if self._wanted_bytes > _MAX_WANTED_BYTES:
            return f"over {_MAX_WANTED_BYTES >> 20} MiB of rows of required topics"
        if self._slow_count > _MAX_SLOW:
            return f"over {_MAX_SLOW:,} messages other than rows"
        return "too many invalid messages" if self._searched_bytes > _MAX_SEARCHED else ""

    def _header(self) -> bytes:
        complete = self._fill(HEADER)
        head = bytes(self._buffer[:HEADER])
        if complete and head.startswith(MAGIC):
            self.start_us = _read_stamp(head, 8)[0]
            self._at = HEADER
        elif head:
            self._add_message(
                f"begins with {head[:7].hex(' ')}, expected {MAGIC.hex(' ')} of a ULog; searched for messages"
            )
        self._newest_us = self.start_us if 0 < self.start_us < MAX_STAMP_US else None
        return MAGIC + b"\x01" + struct.pack("<Q", self.start_us)

    def _skip_good_rows(self) -> bytes | None:
        """Skip valid rows and return the wanted ones; optimised, because a log is nearly all rows."""
        buffer, at, end, topics, newest = (
            self._buffer,
            self._at,
            len(self._buffer),
            self.formats.topics,
            self._newest_us,
        )
        out = bytearray()
        if self._restarts or newest is None:
            return b""
        while at + 5 <= end and buffer[at + 2] == _DATA:
            topic = topics.get(buffer[at + 3] | buffer[at + 4] << 8)
            size = buffer[at] | buffer[at + 1] << 8
            if topic is None or at + 3 + size > end or size != topic.min_size + 2:
                break
            if topic.wanted:
                stamp = _read_stamp(buffer, at + 5 + topic.stamp_offset)[0]
                if not -MAX_JUMP_US < stamp - newest < MAX_JUMP_US:
                    break
                if stamp > newest:
                    newest = stamp
                out += buffer[at : at + 3 + size]
            at += 3 + size
            self.messages += 1
        self._wanted_bytes += len(out)
        if at > self._at:
            self._report_damage()
            self._at, self._newest_us = at, newest
            self._jumped_count = 0 if out else self._jumped_count  # rows of unwanted topics have no checked time
        return bytes(out)

    def _next_message(self) -> bytes | None:
        """Skip one message or damage; return the bytes to pass, empty for none; None for damage."""
        self._slow_count += 1
        size, kind = _read_header(self._buffer, self._at)
        end = self._offset + 3 + size
        if self._restarts and end > self._restarts[0]:
            return self._restart()
        if kind in _TYPES and self._fill(3 + size):
            body = bytes(self._buffer[self._at + 3 : self._at + 3 + size])
            passed = self._filter_message(kind, body)
            if passed is not None:
                self._at += 3 + size
                self.messages += 1
                self._report_damage()
                return passed
        if self.messages and self._is_foreign(kind, size) and self._followed(3 + size):
            self._at += 3 + size
            self._dropped["messages of unknown topic or kind"] += 1
            return b""
        self._resync()
        return None

    def _restart(self) -> bytes:
        """Continue at data appended after a crash; the previous message is truncated."""
        step = self._restarts.pop(0) - self._offset
        if step > 0 and self._fill(step):
            self._at += step
        return b""

    def _is_foreign(self, kind: int, size: int) -> bool:
        """Return whether it may be a valid message of an unknown type, or of a topic with a lost format."""
        if kind == _DATA and size > 2 and self._fill(5):
            return _read_uint16(self._buffer, self._at + 3)[0] not in self.formats.topics
        return size > 0 and kind not in _TYPES

    def _followed(self, length: int) -> bool:
        return self._fill(length + 3) and self._buffer[self._at + length + 2] in _TYPES

    def _resync(self) -> None:
        """Skip to the next valid message, at most one buffer further."""
        start = self._offset
        self._fill(_MAX_MESSAGE)
        next_start = len(self._buffer) - 2 if len(self._buffer) - self._at > 2 else len(self._buffer)
        for match in _TYPE_BYTE.finditer(self._buffer, self._at + 3):
            at = match.start() - 2
            size, kind = _read_header(self._buffer, at)
            if at + 3 + size > len(self._buffer):
                if not self._ended:
                    next_start = at
                    break
                continue
            is_possible, examined = is_possible_body(kind, self._buffer, at + 3, at + 3 + size)
            self._searched_bytes += examined + _SEARCH_COST
            if is_possible and _is_valid(kind, bytes(self._buffer[at + 3 : at + 3 + size]), self.formats):
                next_start = at
                break
            self._searched_bytes += size if is_possible else 0
            if self._searched_bytes > _MAX_SEARCHED:
                next_start = at
                break
        self._at = max(next_start, self._at + 1)
        if self._ended and len(self._buffer) - self._at < 3:
            self._at = len(self._buffer)
        self._dropped["damaged bytes"] += self._offset - start
        self._damage = [self._damage[0] if self._damage else start, self._offset]

    def _report_damage(self) -> None:
        if self._damage:
            self._places += 1
            if self._places <= _MAX_PLACES:
                self._add_message(f"bytes {self._damage[0]} to {self._damage[1]} are damaged and were skipped")
            self._damage = None

    def _filter_message(self, kind: int, body: bytes) -> bytes | None:
        """Return the bytes to pass: empty for a valid unwanted message, None for an invalid one."""
        if kind == _DATA:
            return self._data(body)
        if kind == ord("B") and self.messages == 0 and 40 <= len(body) < 100:  # only valid as the first message
            self._flags(body)
            return b""
        if not _is_valid(kind, body, self.formats):
            return None
        if kind == ord("F") and not self._in_data:
            if not self.formats.declare(body):
                return b""
        elif kind == ord("A"):
            self._in_data = True
            if not self.formats.subscribe(body):
                return b""
        elif kind == ord("F"):
            return b""
        if kind in _KIND_LIMITS:
            self._small[kind] += 1
            self._small_bytes[kind] += len(body)
            if self._small[kind] > _KIND_LIMITS[kind][0] or self._small_bytes[kind] > _KIND_LIMITS[kind][1]:
                self._dropped[f"messages of kind {chr(kind)} beyond the limit"] += 1
                return b""
        return struct.pack("<HB", len(body), kind) + body if kind in _PASSED_TYPES else b""

    def _data(self, body: bytes) -> bytes | None:
        topic = self.formats.topics.get(_read_uint16(body)[0]) if len(body) > 2 else None
        if topic is None or not topic.min_size <= len(body) - 2 <= topic.max_size:
            return None
        if not topic.wanted:
            return b""
        if not self._is_continuous(_read_stamp(body, 2 + topic.stamp_offset)[0]):
            self._dropped[f"rows of {topic.name} with an implausible stamp"] += 1
            return b""
        self._wanted_bytes += topic.min_size + 5
        return struct.pack("<HB", topic.min_size + 2, _DATA) + body[: topic.min_size + 2]

    def _is_continuous(self, stamp: int) -> bool:
        """Return whether a stamp continues from the last one; enough consecutive jumps set a new time."""
        if stamp < MAX_STAMP_US and (self._newest_us is None or abs(stamp - self._newest_us) < MAX_JUMP_US):
            self._newest_us = stamp if self._newest_us is None else max(stamp, self._newest_us)
            self._jumped_count = 0
            return True
        self._jumped_count += stamp < MAX_STAMP_US
        if self._jumped_count >= MIN_AGREEING:
            self._newest_us, self._jumped_count = stamp, 0
        return False

    def _flags(self, body: bytes) -> None:
        if body[8] & ~1 or any(body[9:16]):
            self._add_message("its flags require a newer reader; it was read anyway")
        if body[8] & 1:
            self._restarts = sorted(offset for offset in struct.unpack("<3Q", body[16:40]) if offset > self._offset)

    def _add_message(self, sentence: str) -> None:
        self._skipped.append(sentence)

    def _report(self) -> None:
        self._report_damage()
        if self._places > _MAX_PLACES:
            self._add_message(f"… and {self._places - _MAX_PLACES} more damaged ranges")
        for kind, count in self._dropped.most_common(_MAX_PLACES):
            self._add_message(f"{count} {kind} skipped")


def _is_valid(kind: int, body: bytes, formats: Formats) -> bool:
    """Return whether the bytes are valid for their message type."""
    if kind == _DATA:
        topic = formats.topics.get(_read_uint16(body)[0]) if len(body) > 2 else None
        return topic is not None and topic.min_size <= len(body) - 2 <= topic.max_size
    if kind in b"LC":
        text = 9 if kind == ord("L") else 11
        return len(body) >= text and body[0] in _LEVELS and is_readable(body[text:])
    if kind == ord("A"):
        return len(body) > 3 and is_readable(body[3:]) and formats.is_declared(body[3:])
    if kind == ord("F"):
        return formats.is_format(body)
    if kind in b"IP":
        return formats.is_value(body)
    if kind in b"MQ":
        return formats.is_value(body[1:])
    return {"S": body == _SYNC, "O": len(body) == 2, "R": len(body) == 2, "B": False}[chr(kind)]
