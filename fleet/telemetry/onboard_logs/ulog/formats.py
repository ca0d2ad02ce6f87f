"""Declarations of a ULog: message formats, their sizes, and topic subscriptions."""

import re
from typing import NamedTuple

SIZES = {
    **dict.fromkeys(("int8_t", "uint8_t", "bool", "char"), 1),
    **dict.fromkeys(("int16_t", "uint16_t"), 2),
    **dict.fromkeys(("int32_t", "uint32_t", "float"), 4),
    **dict.fromkeys(("int64_t", "uint64_t", "double"), 8),
}
_MAX_ROW = 0xFFFF - 2  # bytes of one row
_MAX_WANTED_ROW = 4096  # bytes of one row of a topic in the table; PX4 stays below 2000
_MAX_TOPICS = 2000  # maximum subscriptions of one file
_MAX_DEPTH = 8  # maximum nesting of formats
_MAX_FIELDS = 999  # maximum fields of one format
_MAX_DECLARED = 50_000  # maximum fields of all formats; PX4 declares about 10,000
_MAX_COLUMNS = 50_000  # maximum numbers per row, summed over all wanted topics
_MAX_ATTEMPTS = 10_000  # maximum subscriptions parsed, valid or not
_MAX_NAME = 100
_NAME = re.compile(rb"[A-Za-z_]\w{0,99}")
_FORMAT_TEXT = re.compile(rb"[A-Za-z_]\w{0,99}:[\w \[\];]*")
_FIELD = re.compile(rb"(\w{1,60})(?:\[(\d{1,5})\])? (\w{1,60})")  # no two parts can match the same bytes
_KEY = re.compile(rb"(\w+)(?:\[(\d+)\])? ([\w./@-]+)")
_CONTROL = re.compile(rb"[\x00-\x08\x0b\x0c\x0e-\x1a\x1c-\x1f\x7f]")  # escape is allowed: it colours texts


class Subscription(NamedTuple):
    """One subscription: size of its rows and offset of their time stamp."""

    name: str
    min_size: int  # bytes of a row without trailing padding
    max_size: int  # bytes with padding
    stamp_offset: int
    wanted: bool


def is_readable(text: bytes) -> bool:
    """Return whether bytes contain no control characters."""
    return _CONTROL.search(text) is None


class Formats:
    """Declared formats and subscribed topics."""

    def __init__(self, wanted: frozenset[str]) -> None:
        self.topics: dict[int, Subscription] = {}
        self._wanted = wanted
        self._fields: dict[bytes, list[tuple[bytes, int, bytes]]] = {}
        self._extents: dict[tuple[bytes, int], tuple[int, int] | None] = {}  # cached, by type and remaining depth
        self._declared = self._columns = self._attempts = 0

    def is_format(self, body: bytes) -> bool:
        """Return whether the bytes declare a format, in linear time."""
        name, colon, fields = body.partition(b":")
        if not colon or len(body) >= 0xFFFF or _NAME.fullmatch(name) is None:
            return False
        parts = _split_fields(fields)
        return 0 < len(parts) <= _MAX_FIELDS and all(_FIELD.fullmatch(part) for part in parts)

    def is_value(self, body: bytes) -> bool:
        """Return whether the bytes are a key and a value of the key's type."""
        if not body or len(body) < 1 + body[0]:
            return False
        key = _KEY.fullmatch(body, 1, 1 + body[0])
        if key is None or key[1].decode() not in SIZES:
            return False
        size = SIZES[key[1].decode()] * int(key[2] or 1)
        return len(body) - 1 - body[0] == size and (key[1] != b"char" or is_readable(body[1 + body[0] :].rstrip(b"\0")))

    def is_declared(self, name: bytes) -> bool:
        """Return whether a format of this name is declared."""
        return name in self._fields

    def declare(self, body: bytes) -> bool:
        """Declare a format; reject a repeated name or too many fields; return whether it was accepted."""
        name, _, fields = body.partition(b":")
        parts = [match.groups() for part in _split_fields(fields) if (match := _FIELD.fullmatch(part))]
        declared = [(kind, max(int(length or 1), 1), field) for kind, length, field in parts]
        unique = len({field for _, _, field in declared}) == len(declared)
        if not unique or name in self._fields or self._declared + len(declared) > _MAX_DECLARED:
            return False
        self._declared += len(declared)
        self._fields[name] = declared
        self._extents.clear()
        return True

    def subscribe(self, body: bytes) -> bool:
        """Add a subscription; return whether its rows are wanted and readable."""
        number = int.from_bytes(body[1:3], "little")
        self._attempts += 1
        if number in self.topics or len(self.topics) >= _MAX_TOPICS or self._attempts > _MAX_ATTEMPTS:
            return False
        name = body[3:]
        fields = self._fields[name]
        size = self._size(name, _MAX_DEPTH)
        stamp_at = 0
        for kind, length, field in fields:
            if field == b"timestamp":
                break
            stamp_at += length * (self._size(kind, _MAX_DEPTH) or 0)
        stamped = any(field == b"timestamp" and kind == b"uint64_t" and n == 1 for kind, n, field in fields)
        if not size or not stamped:
            return False
        padding = 0
        for kind, length, field in reversed(fields):
            if not field.startswith(b"_padding"):
                break
            padding += length * (self._size(kind, _MAX_DEPTH) or 0)
        _, columns = self._extent(name, _MAX_DEPTH) or (0, 0)
        wanted = name.decode() in self._wanted and size <= _MAX_WANTED_ROW
        wanted = wanted and self._columns + columns <= _MAX_COLUMNS
        self._columns += columns if wanted else 0
        self.topics[number] = Subscription(name.decode(), size - padding, size, stamp_at, wanted)
        return wanted

    def _size(self, kind: bytes, depth: int) -> int | None:
        """Return the size of a type [bytes]; None if it is unknown, too large or recursive."""
        extent = self._extent(kind, depth)
        return None if extent is None else extent[0]

    def _extent(self, kind: bytes, depth: int) -> tuple[int, int] | None:
        """Return the size of a type [bytes] and its number of values, cached by depth."""
        if kind.decode() in SIZES:
            return SIZES[kind.decode()], 1
        if depth == 0 or kind not in self._fields:
            return None
        cache_key = kind, depth
        if cache_key not in self._extents:
            self._extents[cache_key] = self._sum_extents(kind, depth)
        return self._extents[cache_key]

    def _sum_extents(self, kind: bytes, depth: int) -> tuple[int, int] | None:
        size = columns = 0
        for field_type, length, _ in self._fields[kind]:
            extent = self._extent(field_type, depth - 1)
            if extent is None or not extent[0]:
                return None
            size, columns = size + length * extent[0], columns + length * extent[1]
            if size > _MAX_ROW:
                return None
        return size, columns


def is_possible_body(kind: int, raw: bytearray, begin: int, end: int) -> tuple[bool, int]:
    """Return whether bytes may be the body of a message, and the number of examined bytes, without a copy.

    Args:
        kind: message type
        raw: any bytes
        begin, end: range of the body in them
    """
    if kind == ord("F"):
        text = _FORMAT_TEXT.match(raw, begin, end)
        stop = text.end() if text else begin
        return stop == end, stop - begin
    if kind in b"LC":
        first = begin + (9 if kind == ord("L") else 11)
        if first > end or raw[begin] not in b"01234567":
            return False, 0
        control = _CONTROL.search(raw, first, end)
        return control is None, (control.start() if control else end) - first
    if kind in b"AIPMQORSB":
        return _is_possible_short(kind, raw, begin, end), 0
    return True, 0


def _is_possible_short(kind: int, raw: bytearray, begin: int, end: int) -> bool:
    """Return whether a body may be a subscription, a value or a marker, by a quick test."""
    if kind == ord("A"):
        return 3 < end - begin <= 3 + _MAX_NAME
    if kind in b"ORSB":
        return end - begin == {"O": 2, "R": 2, "S": 8}.get(chr(kind))
    at = begin + (kind in b"MQ")
    if at >= end or at + 1 + raw[at] > end:
        return False
    return _KEY.fullmatch(raw, at + 1, at + 1 + raw[at]) is not None


def _split_fields(fields: bytes) -> list[bytes]:
    """Split the fields of a format; the last semicolon is optional."""
    return fields.removesuffix(b";").split(b";")
