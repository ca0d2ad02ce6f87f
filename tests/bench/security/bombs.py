"""Messages made to hurt whoever reads them: deep, long, huge, of the wrong kind, or well-formed and absurd."""

import copy
from collections.abc import Iterator
from typing import Any

import msgpack
import msgspec

from fleet.access.roles import MAX_BYTES, TOPIC_RULES
from fleet.bus.codec import encode

DEPTH = 200_000
HUGE = 0xFFFFFFFF
HEADS = (b"\xdd", b"\xdf", b"\xc6", b"\xdb", b"\xc9")  # array, map, bytes, text, extension of 32-bit length
ESCAPES = "\x1b]0;owned\x07\x1b[2J\x1b[31m‮\r\n"


def bombs(example: Any, most: int = MAX_BYTES) -> Iterator[tuple[str, bytes]]:
    """Give payloads for the class of an example, none larger than it may be, nor than `most`: (what, bytes)."""
    most = min(most, TOPIC_RULES[example.topic].max_bytes)
    plain = msgpack.unpackb(encode(example), strict_map_key=False)
    yield "nothing", b""
    yield "no msgpack", b"\xc1" * 64
    yield "another kind", msgpack.packb([1, 2, 3])
    yield "cut short", encode(example)[:-1]
    yield "not utf-8", msgpack.packb({"t": b"\xff"}, use_bin_type=False)
    yield "too large", msgpack.packb(plain | {"new": b"\0" * most})
    for head in HEADS:
        yield f"length {head.hex()} of 4 G", head + HUGE.to_bytes(4, "big")
        yield f"field of length {head.hex()}", _with(plain, "new", head + HUGE.to_bytes(4, "big"))
    yield "deep lists", b"\x91" * min(DEPTH, most - 1) + b"\xc0"
    yield "deep maps", b"\x81\xa1a" * (min(DEPTH, most) // 3 - 1) + b"\xc0"
    yield "deep new field", _with(plain, "new", b"\x91" * (min(DEPTH, most) // 2) + b"\xc0")
    yield "as many items as fit", msgpack.packb(list(range(128)) * (most // 128 - 1))
    yield "as many fields as fit", msgpack.packb({f"{n:05d}": 0 for n in range(min(most // 7 - 1, 30_000))})
    yield "escapes everywhere", msgpack.packb(_steering(type(example), plain))
    for name, value in plain.items():
        yield from ((f"{name}: {what}", packed) for what, packed in _absurd(plain, name, value, most))


def _absurd(plain: dict[str, Any], name: str, value: Any, most: int) -> Iterator[tuple[str, bytes]]:
    """Give the example with one field replaced by something of the same type that makes no sense."""
    if isinstance(value, bool):
        return
    if isinstance(value, int):
        for number in (-1, 2**31, 2**63 - 1, 2**64 - 1, -(2**63)):
            yield str(number), msgpack.packb(plain | {name: number})
    if isinstance(value, float):
        for number in (float("nan"), float("inf"), -1e308, 1e308):
            yield str(number), msgpack.packb(plain | {name: number})
    if isinstance(value, str):
        yield "escapes", msgpack.packb(plain | {name: ESCAPES})
        yield "long", msgpack.packb(plain | {name: "Ω" * (most // 4)})
    if isinstance(value, list) and value:
        yield "long", msgpack.packb(plain | {name: value[:1] * (most // (len(msgpack.packb(value[0])) + 1) // 2)})
        yield "empty", msgpack.packb(plain | {name: []})
    if isinstance(value, dict):
        yield "empty", msgpack.packb(plain | {name: {}})
    for path, array in _arrays(value):
        for what, lie in _lies(array, most):
            yield f"{path} {what}", msgpack.packb(plain | {name: _at(value, path, lie)})


def _arrays(value: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], dict[str, Any]]]:
    if isinstance(value, dict) and set(value) == {"dtype", "shape", "data"}:
        yield path, value
    elif isinstance(value, dict):
        for name, held in value.items():
            yield from _arrays(held, (*path, name))


def _at(value: Any, path: tuple[str, ...], new: Any) -> Any:
    """Give a copy with something else at a path."""
    return {**value, path[0]: _at(value[path[0]], path[1:], new)} if path else new


def _steering(kind: type, plain: Any) -> Any:
    """Put words that steer a terminal into every text that may hold them: no name of an enumeration, no dtype."""
    worse = copy.deepcopy(plain)
    for holder, at in list(_texts(worse)):
        before, holder[at] = holder[at], ESCAPES
        if not decodes(kind, msgpack.packb(worse)):
            holder[at] = before
    return worse


def _texts(within: Any) -> Iterator[tuple[Any, Any]]:
    for at, value in list(within.items() if isinstance(within, dict) else enumerate(within)):
        if isinstance(value, str):
            yield within, at
        elif isinstance(value, dict | list):
            yield from _texts(value)


def _lies(value: dict[str, Any], most: int) -> Iterator[tuple[str, dict[str, Any]]]:
    """Give arrays that are not what they say, or are, and far too large."""
    yield "shape of 4 G", value | {"shape": [2**32, 2**32]}
    yield "negative shape", value | {"shape": [-1, -3]}
    yield "many dimensions", value | {"shape": [1] * 20_000}
    yield "objects", value | {"dtype": "|O"}
    yield "text", value | {"dtype": "<U9999999"}
    yield "none", value | {"shape": [0], "data": b""}
    yield "huge", value | {"dtype": "<f4", "shape": [most // 8], "data": b"\xff" * (most // 8 * 4)}
    yield "huge rows", value | {"dtype": "<f4", "shape": [most // 24, 3], "data": b"\xff" * (most // 24 * 12)}


def _with(plain: dict[str, Any], name: str, raw: bytes) -> bytes:
    """Pack a map with one more field, given as bytes."""
    packed = [part for pair in plain.items() for part in (msgpack.packb(pair[0]), msgpack.packb(pair[1]))]
    head = bytes([0x80 | (len(plain) + 1)]) if len(plain) < 15 else b"\xde" + (len(plain) + 1).to_bytes(2, "big")
    return head + b"".join(packed) + msgpack.packb(name) + raw


def questions() -> Iterator[tuple[str, str, bytes]]:
    """Give hostile queries: (what, parameters, payload)."""
    for text in (
        "seconds=nan",
        "seconds=1e999",
        "seconds=-1",
        "seconds=",
        "horizon=nan;step=0",
        "horizon=1e9;step=1e-9",
    ):
        yield text, text, b""
    yield "long parameters", "horizon=" + "9" * 50_000, b""
    yield "many parameters", ";".join(f"p{n}=1" for n in range(5_000)), b""
    for what, payload in (
        ("deep question", b"\x91" * 100_000 + b"\xc0"),
        ("question of 4 G", b"\xdd\xff\xff\xff\xff"),
        ("no msgpack", b"\xc1" * 100),
        ("many items", msgpack.packb({"items": [{"seq": 0}] * 20_000})),
        ("many ids", msgpack.packb({"uavs": list(range(100_000))})),
        ("params", msgpack.packb({"params": {f"P{n}": 1e308 for n in range(20_000)}})),
        ("nan", msgpack.packb({"speed": float("nan"), "wind": [float("inf"), 0.0]})),
    ):
        yield what, "", payload


def decodes(kind: type, payload: bytes) -> bool:
    """Tell whether a payload is a message after all."""
    try:
        msgspec.msgpack.decode(payload, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return False
    return True
