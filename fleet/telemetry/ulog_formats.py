"""What a ULog declares of itself: message formats, their sizes, and which number stands for which topic."""

import re
from typing import NamedTuple

SIZES = {
    **dict.fromkeys(("int8_t", "uint8_t", "bool", "char"), 1),
    **dict.fromkeys(("int16_t", "uint16_t"), 2),
    **dict.fromkeys(("int32_t", "uint32_t", "float"), 4),
    **dict.fromkeys(("int64_t", "uint64_t", "double"), 8),
}
_LARGEST = 0xFFFF - 2  # bytes of one row
_LARGEST_WANTED = 4096  # bytes of one row of a topic in the table; PX4 stays below 2000
_MOST_TOPICS = 2000  # subscriptions of one file
_DEEPEST = 8  # formats within formats
_FORMAT = re.compile(rb"([A-Za-z_]\w{0,99}):((?:\w{1,60}(?:\[\d{1,5}\])? \w{1,60};?){1,999})")
_FIELD = re.compile(rb"(\w+)(?:\[(\d+)\])? (\w+)")
_KEY = re.compile(rb"(\w+)(?:\[(\d+)\])? ([\w./@-]+)")
_CONTROL = re.compile(rb"[\x00-\x08\x0b\x0c\x0e-\x1a\x1c-\x1f\x7f]")  # escape may colour a text


class Topic(NamedTuple):
    """One subscription: what a row of it must weigh, and where its stamp is."""

    name: str
    least: int  # bytes of a row without the padding at its end
    most: int  # bytes with it
    stamp_at: int
    wanted: bool


def readable(text: bytes) -> bool:
    """Tell whether bytes are text."""
    return _CONTROL.search(text) is None


class Formats:
    """The formats declared so far, and the topics made of them."""

    def __init__(self, wanted: frozenset[str]) -> None:
        self.topics: dict[int, Topic] = {}
        self._wanted = wanted
        self._fields: dict[bytes, list[tuple[bytes, int, bytes]]] = {}

    def is_format(self, body: bytes) -> bool:
        """Tell whether the bytes declare a format."""
        return len(body) < 0xFFFF and _FORMAT.fullmatch(body) is not None

    def is_value(self, body: bytes) -> bool:
        """Tell whether the bytes are a key and a value of the type the key names."""
        if not body or len(body) < 1 + body[0]:
            return False
        key = _KEY.fullmatch(body, 1, 1 + body[0])
        if key is None or key[1].decode() not in SIZES:
            return False
        size = SIZES[key[1].decode()] * int(key[2] or 1)
        return len(body) - 1 - body[0] == size and (key[1] != b"char" or readable(body[1 + body[0] :].rstrip(b"\0")))

    def knows(self, name: bytes) -> bool:
        """Tell whether a format of that name was declared."""
        return name in self._fields

    def learn(self, body: bytes) -> None:
        """Take a format; the first of a name stands."""
        name, _, fields = body.partition(b":")
        found = [(kind, max(int(n or 1), 1), field) for kind, n, field in _FIELD.findall(fields)]
        if len({field for _, _, field in found}) == len(found):
            self._fields.setdefault(name, found)

    def subscribe(self, body: bytes) -> bool:
        """Take a subscription; tell whether its rows are wanted and can be read."""
        number = int.from_bytes(body[1:3], "little")
        if number in self.topics or len(self.topics) >= _MOST_TOPICS:
            return False
        name = body[3:]
        fields = self._fields[name]
        size = self._size(name, _DEEPEST)
        stamp_at = 0
        for kind, n, field in fields:
            if field == b"timestamp":
                break
            stamp_at += n * (self._size(kind, _DEEPEST) or 0)
        stamped = any(field == b"timestamp" and kind == b"uint64_t" and n == 1 for kind, n, field in fields)
        if not size or not stamped:
            return False
        padding = 0
        for kind, n, field in reversed(fields):
            if not field.startswith(b"_padding"):
                break
            padding += n * (self._size(kind, _DEEPEST) or 0)
        wanted = name.decode() in self._wanted and size <= _LARGEST_WANTED
        self.topics[number] = Topic(name.decode(), size - padding, size, stamp_at, wanted)
        return wanted

    def _size(self, kind: bytes, depth: int) -> int | None:
        """Give the bytes of a type; None where it is unknown, too large or contains itself."""
        if kind.decode() in SIZES:
            return SIZES[kind.decode()]
        if depth == 0 or kind not in self._fields:
            return None
        total = 0
        for part, n, _ in self._fields[kind]:
            size = self._size(part, depth - 1)
            total += n * size if size else _LARGEST + 1
            if total > _LARGEST:
                return None
        return total
