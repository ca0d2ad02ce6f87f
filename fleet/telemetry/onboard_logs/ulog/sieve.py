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

from fleet.telemetry.onboard_logs.ulog.formats import Formats, could_be, readable

MAGIC = b"ULog\x01\x12\x35"
HEADER = 16  # bytes: magic, version, start stamp
LARGEST = 1 << 29  # maximum bytes read of one file
HOPELESS = 1 << 26  # bytes without a valid message that end reading
JUMP_US = 60_000_000  # larger time jumps need confirmation [us]
LATEST_US = 1 << 52  # later stamps are invalid [us]
COMPANY = 20  # consecutive stamps that confirm a time jump
_BLOCK = 1 << 20
_WIDEST = 3 + 0xFFFF  # bytes of the longest message
_SYNC = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"
_TYPES = frozenset(b"ABCDFILMOPQRS")
_A_TYPE = re.compile(rb"[ABCDFILMOPQRS]")
_PASSED = frozenset(b"ACDFILOP")  # types that pyulog requires
_DATA = ord("D")
_LEVELS = frozenset(b"01234567")
_head = struct.Struct("<HB").unpack_from
_short = struct.Struct("<H").unpack_from
_stamp = struct.Struct("<Q").unpack_from
_MOST_PLACES = 8  # damaged positions reported
_MOST_SLOW = 2_000_000  # maximum number of messages parsed individually
_MOST_WANTED = 1 << 27  # bytes of wanted rows: 30 min at the highest rates, else 2 h
_MOST_SMALL = dict.fromkeys(b"CILOP", (20000, 1 << 22))  # maximum messages of a type and their bytes
_MOST_SEARCHED = 2_000_000_000  # maximum search cost: bytes examined, plus `_SEARCH_COST` per position
_PLACE = 1000


class Sieve:
    """File object for pyulog: a header, then only valid messages."""

    def __init__(self, opener: Callable[[], IO[bytes]], wanted: frozenset[str], skipped: list[str]) -> None:
        self.start_us = 0
        self.formats = Formats(wanted)
        self.messages = 0  # valid messages, wanted or not
        self._skipped, self._file = skipped, opener()
        self._raw, self._at, self._base, self._ended = bytearray(), 0, 0, False  # base: file offset of raw[0]
        self._good, self._read_at = bytearray(), 0
        self._source = self._walk()
        self._restarts: list[int] = []
        self._now_us: int | None = None
        self._strangers = 0
        self._dropped: Counter[str] = Counter()
        self._places = 0
        self._damage: list[int] | None = None  # start, end
        self._in_data = False
        self._slow = self._wanted = self._searched = 0  # running totals of the limits `_MAX_…`
        self._small: Counter[int] = Counter()
        self._small_bytes: Counter[int] = Counter()

    # --- file interface for pyulog ---

    def read(self, n: int) -> bytes:
        """Return the next `n` bytes, fewer at the end."""
        while len(self._good) - self._read_at < n:
            batch = next(self._source, None)
            if batch is None:
                break
            del self._good[: max(self._read_at - _WIDEST, 0)]  # pyulog seeks back by one message
            self._read_at = min(self._read_at, _WIDEST)
            self._good += batch
        data = bytes(self._good[self._read_at : self._read_at + n])
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
        while len(self._raw) - self._at < need and not self._ended:
            del self._raw[: self._at]
            self._base, self._at = self._base + self._at, 0
            self._raw += self._block()
        return len(self._raw) - self._at >= need

    def _block(self) -> bytes:
        room = LARGEST - self._base - len(self._raw)
        try:
            block = self._file.read(min(_BLOCK, room)) if room > 0 else b""
        except (OSError, EOFError, lzma.LZMAError, zlib.error) as error:
            block = b""
            self._say(f"the file is damaged ({error}); the data before are used")
        if room <= 0:
            self._say(f"it is longer than {LARGEST >> 20} MiB, the rest was not read; split it")
        self._ended = not block
        return block

    @property
    def _offset(self) -> int:
        return self._base + self._at

    # --- parsing ---

    def _walk(self) -> Iterator[bytes]:
        yield self._header()
        out, good = bytearray(), self._offset
        while self._fill(3):
            if why := self._too_much():
                self._say(f"{why} up to byte {self._offset}, the rest was not read; split it")
                break
            message = self._run()
            if not message and self._fill(3):
                message = self._next()
            if message is None:
                if self._offset - good > HOPELESS:
                    self._say(f"{HOPELESS >> 20} MiB without a message from byte {good} on, the rest was not read")
                    break
                continue
            good = self._offset
            out += message
            if len(out) >= 1 << 16:
                yield bytes(out)
                out.clear()
        yield bytes(out)
        self._report()

    def _too_much(self) -> str:
        """Return the limit that ends reading, or an empty string."""
        if self._wanted > _MOST_WANTED:
            return f"over {_MOST_WANTED >> 20} MiB of rows of required topics"
        if self._slow > _MOST_SLOW:
            return f"over {_MOST_SLOW:,} messages other than rows"
        return "too many invalid messages" if self._searched > _MOST_SEARCHED else ""

    def _header(self) -> bytes:
        whole = self._fill(HEADER)
        head = bytes(self._raw[:HEADER])
        if whole and head.startswith(MAGIC):
            self.start_us = _stamp(head, 8)[0]
            self._at = HEADER
        elif head:
            self._say(f"begins with {head[:7].hex(' ')}, expected {MAGIC.hex(' ')} of a ULog; searched for messages")
        self._now_us = self.start_us if 0 < self.start_us < LATEST_US else None
        return MAGIC + b"\x01" + struct.pack("<Q", self.start_us)

    def _run(self) -> bytes | None:
        """Skip valid rows and return the wanted ones; optimised, because a log is nearly all rows."""
        raw, at, end, topics, now = self._raw, self._at, len(self._raw), self.formats.topics, self._now_us
        out = bytearray()
        if self._restarts or now is None:
            return b""
        while at + 5 <= end and raw[at + 2] == _DATA:
            topic = topics.get(raw[at + 3] | raw[at + 4] << 8)
            size = raw[at] | raw[at + 1] << 8
            if topic is None or at + 3 + size > end or size != topic.least + 2:
                break
            if topic.wanted:
                stamp = _stamp(raw, at + 5 + topic.stamp_at)[0]
                if not -JUMP_US < stamp - now < JUMP_US:
                    break
                if stamp > now:
                    now = stamp
                out += raw[at : at + 3 + size]
            at += 3 + size
            self.messages += 1
        self._wanted += len(out)
        if at > self._at:
            self._tell_damage()
            self._at, self._now_us = at, now
            self._strangers = 0 if out else self._strangers  # rows of unwanted topics have no checked time
        return bytes(out)

    def _next(self) -> bytes | None:
        """Skip one message or damage; return the bytes to pass, empty for none; None for damage."""
        self._slow += 1
        size, kind = _head(self._raw, self._at)
        end = self._offset + 3 + size
        if self._restarts and end > self._restarts[0]:
            return self._restart()
        if kind in _TYPES and self._fill(3 + size):
            body = bytes(self._raw[self._at + 3 : self._at + 3 + size])
            passed = self._judge(kind, body)
            if passed is not None:
                self._at += 3 + size
                self.messages += 1
                self._tell_damage()
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
            return _short(self._raw, self._at + 3)[0] not in self.formats.topics
        return size > 0 and kind not in _TYPES

    def _followed(self, length: int) -> bool:
        return self._fill(length + 3) and self._raw[self._at + length + 2] in _TYPES

    def _resync(self) -> None:
        """Skip to the next valid message, at most one buffer further."""
        since = self._offset
        self._fill(_WIDEST)
        found = len(self._raw) - 2 if len(self._raw) - self._at > 2 else len(self._raw)
        for hit in _A_TYPE.finditer(self._raw, self._at + 3):
            at = hit.start() - 2
            size, kind = _head(self._raw, at)
            if at + 3 + size > len(self._raw):
                if not self._ended:
                    found = at
                    break
                continue
            good, looked = could_be(kind, self._raw, at + 3, at + 3 + size)
            self._searched += looked + _PLACE
            if good and _is_good(kind, bytes(self._raw[at + 3 : at + 3 + size]), self.formats):
                found = at
                break
            self._searched += size if good else 0
            if self._searched > _MOST_SEARCHED:
                found = at
                break
        self._at = max(found, self._at + 1)
        if self._ended and len(self._raw) - self._at < 3:
            self._at = len(self._raw)
        self._dropped["damaged bytes"] += self._offset - since
        self._damage = [self._damage[0] if self._damage else since, self._offset]

    def _tell_damage(self) -> None:
        if self._damage:
            self._places += 1
            if self._places <= _MOST_PLACES:
                self._say(f"bytes {self._damage[0]} to {self._damage[1]} are damaged and were skipped")
            self._damage = None

    def _judge(self, kind: int, body: bytes) -> bytes | None:
        """Return the bytes to pass: empty for a valid unwanted message, None for an invalid one."""
        if kind == _DATA:
            return self._data(body)
        if kind == ord("B") and self.messages == 0 and 40 <= len(body) < 100:  # only valid as the first message
            self._flags(body)
            return b""
        if not _is_good(kind, body, self.formats):
            return None
        if kind == ord("F") and not self._in_data:
            if not self.formats.learn(body):
                return b""
        elif kind == ord("A"):
            self._in_data = True
            if not self.formats.subscribe(body):
                return b""
        elif kind == ord("F"):
            return b""
        if kind in _MOST_SMALL:
            self._small[kind] += 1
            self._small_bytes[kind] += len(body)
            if self._small[kind] > _MOST_SMALL[kind][0] or self._small_bytes[kind] > _MOST_SMALL[kind][1]:
                self._dropped[f"messages of kind {chr(kind)} beyond the limit"] += 1
                return b""
        return struct.pack("<HB", len(body), kind) + body if kind in _PASSED else b""

    def _data(self, body: bytes) -> bytes | None:
        topic = self.formats.topics.get(_short(body)[0]) if len(body) > 2 else None
        if topic is None or not topic.least <= len(body) - 2 <= topic.most:
            return None
        if not topic.wanted:
            return b""
        if not self._in_time(_stamp(body, 2 + topic.stamp_at)[0]):
            self._dropped[f"rows of {topic.name} with an implausible stamp"] += 1
            return b""
        self._wanted += topic.least + 5
        return struct.pack("<HB", topic.least + 2, _DATA) + body[: topic.least + 2]

    def _in_time(self, stamp: int) -> bool:
        """Return whether a stamp continues from the last one; enough consecutive jumps set a new time."""
        if stamp < LATEST_US and (self._now_us is None or abs(stamp - self._now_us) < JUMP_US):
            self._now_us = stamp if self._now_us is None else max(stamp, self._now_us)
            self._strangers = 0
            return True
        self._strangers += stamp < LATEST_US
        if self._strangers >= COMPANY:
            self._now_us, self._strangers = stamp, 0
        return False

    def _flags(self, body: bytes) -> None:
        if body[8] & ~1 or any(body[9:16]):
            self._say("its flags require a newer reader; it was read anyway")
        if body[8] & 1:
            self._restarts = sorted(o for o in struct.unpack("<3Q", body[16:40]) if o > self._offset)

    def _say(self, sentence: str) -> None:
        self._skipped.append(sentence)

    def _report(self) -> None:
        self._tell_damage()
        if self._places > _MOST_PLACES:
            self._say(f"… and {self._places - _MOST_PLACES} more damaged ranges")
        for what, n in self._dropped.most_common(_MOST_PLACES):
            self._say(f"{n} {what} skipped")


def _is_good(kind: int, body: bytes, formats: Formats) -> bool:
    """Return whether the bytes are valid for their message type."""
    if kind == _DATA:
        topic = formats.topics.get(_short(body)[0]) if len(body) > 2 else None
        return topic is not None and topic.least <= len(body) - 2 <= topic.most
    if kind in b"LC":
        text = 9 if kind == ord("L") else 11
        return len(body) >= text and body[0] in _LEVELS and readable(body[text:])
    if kind == ord("A"):
        return len(body) > 3 and readable(body[3:]) and formats.knows(body[3:])
    if kind == ord("F"):
        return formats.is_format(body)
    if kind in b"IP":
        return formats.is_value(body)
    if kind in b"MQ":
        return formats.is_value(body[1:])
    return {"S": body == _SYNC, "O": len(body) == 2, "R": len(body) == 2, "B": False}[chr(kind)]
