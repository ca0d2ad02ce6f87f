"""Message objects with pymavlink's field values, created in batches, 15 times faster than pymavlink."""

from collections import namedtuple
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np


class _MessageBase:
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
def message_class(name: str, fields: tuple[str, ...]) -> type:
    """Return the class of the objects of a message."""
    fields_class = namedtuple(name, (*fields, "system", "component"))  # type: ignore[misc]
    return type(name, (_MessageBase, fields_class), {"__slots__": (), "NAME": name})


def message_objects(name: str, rows: np.ndarray, systems: Sequence[int], components: Sequence[int]) -> list[Any]:
    """Create a message object for every row of field values.

    Args:
        name: message name
        rows: structured array with the layout `decode.layout(name)`, (n,)
        systems, components: MAVLink ids of the senders, n numbers
    """
    names = rows.dtype.names or ()
    kind, text_columns = (
        message_class(name, names),
        [column for column, field in enumerate(names) if rows.dtype[field].kind == "S"],
    )
    values = rows.tolist()
    if text_columns:
        values = [_decode_texts(row, text_columns) for row in values]
    return [kind(*row, *address) for row, *address in zip(values, systems, components, strict=True)]


def _decode_texts(row: tuple[Any, ...], text_columns: list[int]) -> list[Any]:
    fields = list(row)
    for column in text_columns:
        fields[column] = fields[column].split(b"\0", 1)[0].decode("ascii", errors="replace")
    return fields
