"""Serialise objects of registered classes without pickle: untrusted bytes give these classes or a `ValueError`.

Scalars are encoded as they are; everything else is a list that starts with its type tag: `["t", 1, 2]` is a tuple.
A repeated object is encoded as a reference, so that identity is preserved.
"""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from math import prod
from typing import Any, NamedTuple

import msgspec
import numpy as np

_DTYPES = ("<f8", "<f4", "<i8", "<i4", "<u8", "<u4", "|i1", "|u1", "|b1")
_DEEPEST = 24  # nested lists
_PLAIN = (type(None), bool, int, float, str, bytes)


class Special(NamedTuple):
    """Conversion of a third-party class to serialisable parts and back."""

    apart: Callable[[Any], Any]
    together: Callable[[Any], Any]


Known = Mapping[str, type | tuple[type, Special]]
"""Classes by their serialised name."""


def pack(thing: Any, known: Known) -> bytes:
    """Serialise an object.

    Raises:
        TypeError: when it contains an object of an unregistered class; add the class to `registry`.
    """
    return msgspec.msgpack.encode(_Writer(known).write(thing))


def unpack(data: bytes, known: Known) -> Any:
    """Deserialise an object.

    Raises:
        ValueError: when the bytes are no object of these classes; the sender runs another version or is hostile.
    """
    try:
        return _Reader(known).read(msgspec.msgpack.decode(data), 0)
    except (TypeError, KeyError, IndexError, AttributeError, OverflowError, RecursionError, msgspec.DecodeError) as why:
        raise ValueError(f"twin: found {len(data)} invalid bytes ({why}), expected a twin; update workers") from None


class _Writer:
    def __init__(self, known: Known) -> None:
        self.names = {(one if isinstance(one, type) else one[0]): name for name, one in known.items()}
        self.special = {one[0]: one[1] for one in known.values() if not isinstance(one, type)}
        self.met: dict[int, int] = {}
        self.kept: list[Any] = []  # keeps the objects alive, so that their ids stay unique

    def write(self, thing: Any) -> Any:
        kind = type(thing)
        if kind in _PLAIN:
            return thing
        if isinstance(thing, np.generic):
            return thing.item()
        if kind is np.ndarray:
            return _array(thing, self.write)
        if kind in (list, tuple):
            return ["l" if kind is list else "t", *map(self.write, thing)]
        if kind is dict:
            return ["d", *(self.write(part) for pair in thing.items() for part in pair)]
        if kind is deque:
            return ["q", thing.maxlen, *map(self.write, thing)]
        name = self.names.get(kind)
        if name is None:
            raise TypeError(f"{kind.__module__}.{kind.__qualname__}: is not serialisable; add it to the registry")
        if isinstance(thing, Enum):
            return ["e", name, thing.value]
        if isinstance(thing, tuple):
            return ["n", name, *map(self.write, thing)]
        return self._object(thing, name)

    def _object(self, thing: Any, name: str) -> list[Any]:
        if id(thing) in self.met:
            return ["r", self.met[id(thing)]]
        self.met[id(thing)] = len(self.kept)
        self.kept.append(thing)
        if isinstance(thing, msgspec.Struct):
            return ["s", name, msgspec.msgpack.encode(thing)]
        if type(thing) in self.special:
            return ["x", name, self.write(self.special[type(thing)].apart(thing))]
        return ["o", name, *(part for key in _names(thing) for part in (key, self.write(getattr(thing, key))))]


class _Reader:
    def __init__(self, known: Known) -> None:
        self.known = known
        self.met: list[Any] = []

    def read(self, told: Any, depth: int) -> Any:
        if type(told) in _PLAIN:
            return told
        if depth > _DEEPEST or type(told) is not list:
            raise TypeError(f"{type(told).__name__} {depth} deep")
        kind, *rest = told
        if kind == "a":
            return _numbers(*rest)
        if kind == "e":
            return self._class(rest[0], Enum)(rest[1])
        if kind == "r":
            return self.met[rest[0]]
        if kind in ("s", "o", "x"):
            return self._object(kind, rest, depth + 1)
        first = 1 if kind in ("q", "n", "w") else 0
        parts = [self.read(part, depth + 1) for part in rest[first:]]
        if kind == "d":
            return dict(zip(parts[::2], parts[1::2], strict=True))
        if kind == "q":
            return deque(parts, maxlen=rest[0])
        if kind == "n":
            return self._class(rest[0], tuple)(*parts)
        if kind == "w":
            words = np.empty(len(parts), object)
            words[:] = parts
            return words.reshape(rest[0])
        return {"l": list, "t": tuple}[kind](parts)

    def _object(self, kind: str, rest: list[Any], depth: int) -> Any:
        place = len(self.met)
        self.met.append(None)
        if kind == "x":
            special = self.known[rest[0]]
            if isinstance(special, type):
                raise TypeError(f"{rest[0]} has no codec")
            self.met[place] = special[1].together(self.read(rest[1], depth))
        elif kind == "s":
            self.met[place] = msgspec.msgpack.decode(rest[1], type=self._class(rest[0], msgspec.Struct))
        else:
            cls = self._class(rest[0], object)
            made = self.met[place] = cls.__new__(cls)
            parts = {key: self.read(part, depth) for key, part in zip(rest[1::2], rest[2::2], strict=True)}
            if parts.keys() != set(_names(cls if is_dataclass(cls) else cls())):
                raise TypeError(f"a {rest[0]} with other attributes")
            made.__dict__.update(parts)
        return self.met[place]

    def _class(self, name: str, kind: type) -> Any:
        found = self.known[name]
        if isinstance(found, tuple) or not issubclass(found, kind):
            raise TypeError(f"{name} is no {kind.__name__}")
        return found


def _names(thing: Any) -> list[str]:
    return [field.name for field in fields(thing)] if is_dataclass(thing) else list(vars(thing))


def _array(thing: np.ndarray, write: Callable[[Any], Any]) -> list[Any]:
    if thing.dtype == object:
        return ["w", list(thing.shape), *map(write, thing.ravel().tolist())]
    if thing.dtype.str not in _DTYPES:
        raise TypeError(f"an array of {thing.dtype}: is not serialisable; expected one of {_DTYPES}")
    return ["a", thing.dtype.str, list(thing.shape), np.ascontiguousarray(thing).tobytes()]


def _numbers(dtype: str, shape: list[int], data: bytes) -> np.ndarray:
    if dtype not in _DTYPES or any(n < 0 for n in shape) or prod(shape) * np.dtype(dtype).itemsize != len(data):
        raise TypeError(f"an array of {dtype!r} {shape} in {len(data)} bytes")
    return np.frombuffer(data, dtype).reshape(shape).copy()
