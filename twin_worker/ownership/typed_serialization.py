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
_MAX_DEPTH = 24  # nested lists
_SCALARS = (type(None), bool, int, float, str, bytes)


class ClassCodec(NamedTuple):
    """Conversion of a third-party class to serialisable parts and back."""

    to_parts: Callable[[Any], Any]
    from_parts: Callable[[Any], Any]


ClassRegistry = Mapping[str, type | tuple[type, ClassCodec]]
"""Classes by their serialised name."""


def serialise(value: Any, registry: ClassRegistry) -> bytes:
    """Serialise an object.

    Raises:
        TypeError: when it contains an object of an unregistered class; add the class to `registry`.
    """
    return msgspec.msgpack.encode(_Encoder(registry).encode(value))


def deserialise(data: bytes, registry: ClassRegistry) -> Any:
    """Deserialise an object.

    Raises:
        ValueError: when the bytes are no object of these classes; the sender runs another version or is hostile.
    """
    try:
        return _Decoder(registry).decode(msgspec.msgpack.decode(data), 0)
    except (
        TypeError,
        KeyError,
        IndexError,
        AttributeError,
        OverflowError,
        RecursionError,
        msgspec.DecodeError,
    ) as error:
        raise ValueError(f"twin: found {len(data)} invalid bytes ({error}), expected a twin; update workers") from None


class _Encoder:
    def __init__(self, registry: ClassRegistry) -> None:
        self.names = {(entry if isinstance(entry, type) else entry[0]): name for name, entry in registry.items()}
        self.codecs = {one[0]: one[1] for one in registry.values() if not isinstance(one, type)}
        self.references: dict[int, int] = {}
        self.objects: list[Any] = []  # keeps the objects alive, so that their ids stay unique

    def encode(self, value: Any) -> Any:
        value_type = type(value)
        if value_type in _SCALARS:
            return value
        if isinstance(value, np.generic):
            return value.item()
        if value_type is np.ndarray:
            return _encode_array(value, self.encode)
        if value_type in (list, tuple):
            return ["l" if value_type is list else "t", *map(self.encode, value)]
        if value_type is dict:
            return ["d", *(self.encode(part) for pair in value.items() for part in pair)]
        if value_type is deque:
            return ["q", value.maxlen, *map(self.encode, value)]
        name = self.names.get(value_type)
        if name is None:
            raise TypeError(
                f"{value_type.__module__}.{value_type.__qualname__}: is not serialisable; add it to the registry"
            )
        if isinstance(value, Enum):
            return ["e", name, value.value]
        if isinstance(value, tuple):
            return ["n", name, *map(self.encode, value)]
        return self._encode_object(value, name)

    def _encode_object(self, value: Any, name: str) -> list[Any]:
        if id(value) in self.references:
            return ["r", self.references[id(value)]]
        self.references[id(value)] = len(self.objects)
        self.objects.append(value)
        if _is_message(type(value)):
            return ["s", name, msgspec.msgpack.encode(value)]
        if type(value) in self.codecs:
            return ["x", name, self.encode(self.codecs[type(value)].to_parts(value))]
        return [
            "o",
            name,
            *(part for key in _attribute_names(value) for part in (key, self.encode(getattr(value, key)))),
        ]


class _Decoder:
    def __init__(self, registry: ClassRegistry) -> None:
        self.registry = registry
        self.objects: list[Any] = []

    def decode(self, data: Any, depth: int) -> Any:
        if type(data) in _SCALARS:
            return data
        if depth > _MAX_DEPTH or type(data) is not list:
            raise TypeError(f"{type(data).__name__} {depth} deep")
        tag, *rest = data
        if tag == "a":
            return _decode_array(*rest)
        if tag == "e":
            return self._class(rest[0], Enum)(rest[1])
        if tag == "r":
            return self.objects[rest[0]]
        if tag in ("s", "o", "x"):
            return self._decode_object(tag, rest, depth + 1)
        first = 1 if tag in ("q", "n", "w") else 0
        parts = [self.decode(part, depth + 1) for part in rest[first:]]
        if tag == "d":
            return dict(zip(parts[::2], parts[1::2], strict=True))
        if tag == "q":
            return deque(parts, maxlen=rest[0])
        if tag == "n":
            return self._class(rest[0], tuple)(*parts)
        if tag == "w":
            array = np.empty(len(parts), object)
            array[:] = parts
            return array.reshape(rest[0])
        return {"l": list, "t": tuple}[tag](parts)

    def _decode_object(self, tag: str, rest: list[Any], depth: int) -> Any:
        index = len(self.objects)
        self.objects.append(None)
        if tag == "x":
            codec = self.registry[rest[0]]
            if isinstance(codec, type):
                raise TypeError(f"{rest[0]} has no codec")
            self.objects[index] = codec[1].from_parts(self.decode(rest[1], depth))
        elif tag == "s":
            self.objects[index] = msgspec.msgpack.decode(rest[1], type=self._class(rest[0], msgspec.Struct))
        else:
            cls = self._class(rest[0], object)
            declared = is_dataclass(cls) or issubclass(cls, msgspec.Struct)
            instance = self.objects[index] = None if issubclass(cls, msgspec.Struct) else cls.__new__(cls)
            parts = {key: self.decode(part, depth) for key, part in zip(rest[1::2], rest[2::2], strict=True)}
            if _is_message(cls) or parts.keys() != set(_attribute_names(cls if declared else cls())):
                raise TypeError(f"a {rest[0]} with other attributes")
            if instance is None:
                self.objects[index] = cls(**parts)
            else:
                instance.__dict__.update(parts)
        return self.objects[index]

    def _class(self, name: str, base: type) -> Any:
        entry = self.registry[name]
        if isinstance(entry, tuple) or not issubclass(entry, base):
            raise TypeError(f"{name} is no {base.__name__}")
        return entry


def _is_message(kind: type) -> bool:
    """Return whether msgspec encodes a class by itself: a message of the bus."""
    return issubclass(kind, msgspec.Struct) and kind.__module__ == "fleet.contract"


def _attribute_names(value: Any) -> list[str]:
    if is_dataclass(value):
        return [field.name for field in fields(value)]
    return list(getattr(value, "__struct_fields__", None) or vars(value))


def _encode_array(array: np.ndarray, encode: Callable[[Any], Any]) -> list[Any]:
    if array.dtype == object:
        return ["w", list(array.shape), *map(encode, array.ravel().tolist())]
    if array.dtype.str not in _DTYPES:
        raise TypeError(f"an array of {array.dtype}: is not serialisable; expected one of {_DTYPES}")
    return ["a", array.dtype.str, list(array.shape), np.ascontiguousarray(array).tobytes()]


def _decode_array(dtype: str, shape: list[int], data: bytes) -> np.ndarray:
    if dtype not in _DTYPES or any(n < 0 for n in shape) or prod(shape) * np.dtype(dtype).itemsize != len(data):
        raise TypeError(f"an array of {dtype!r} {shape} in {len(data)} bytes")
    return np.frombuffer(data, dtype).reshape(shape).copy()
