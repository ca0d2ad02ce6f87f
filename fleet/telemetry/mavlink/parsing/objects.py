"""Message objects with pymavlink's field values, created in batches, 15 times faster than pymavlink."""

from collections import namedtuple
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np


class _Said:
    """Base of all message objects, with pymavlink's interface."""

    __slots__ = ()
    NAME = ""

    def get_type(self) -> str:
        """Return the message name."""
        return self.NAME

    def get_srcSystem(self) -> int:
        """Return the MAVLink system id of the sender."""
        return self[-2]  # type: ignore[index, no-any-return]

    def get_srcComponent(self) -> int:
        """Return the MAVLink component id of the sender."""
        return self[-1]  # type: ignore[index, no-any-return]


@cache
def _kind(name: str, fields: tuple[str, ...]) -> type:
    plain = namedtuple(name, (*fields, "system", "component"))  # type: ignore[misc]
    return type(name, (_Said, plain), {"__slots__": (), "NAME": name})


def objects(name: str, rows: np.ndarray, systems: Sequence[int], components: Sequence[int]) -> list[Any]:
    """Create a message object for every row of field values.

    Args:
        name: message name
        rows: structured array with the layout `decode.layout(name)`, (n,)
        systems, components: MAVLink ids of the senders, n numbers
    """
    names = rows.dtype.names or ()
    kind, texts = _kind(name, names), [k for k, field in enumerate(names) if rows.dtype[field].kind == "S"]
    told = rows.tolist()
    if texts:
        told = [_read(row, texts) for row in told]
    return [kind(*row, *who) for row, *who in zip(told, systems, components, strict=True)]


def _read(row: tuple[Any, ...], texts: list[int]) -> list[Any]:
    fields = list(row)
    for k in texts:
        fields[k] = fields[k].split(b"\0", 1)[0].decode("ascii", errors="replace")
    return fields
