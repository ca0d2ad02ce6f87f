"""Decode rows of a sample into tuples: for single rows this is faster than a numpy array."""

import struct
from functools import cache
from typing import Any

from fleet.contract import Array, Rows

_LETTER = {"<f4": "f", "<f8": "d", "<i4": "i", "<i8": "q", "|u1": "B"}


@cache
def _packed(dtype: str, width: int) -> struct.Struct:
    return struct.Struct(f"<{width}{_LETTER[dtype]}")


def last(x: Array) -> tuple[float, ...]:
    """Return the last row of a table; empty when there is none.

    Raises:
        ValueError: when dtype, shape and byte count disagree; correct the sender.
    """
    shape = x.shape
    if len(shape) != 2 or not shape[0]:
        return ()
    if x.dtype not in _LETTER or not 0 < shape[1] < 100 or len(x.data) != shape[0] * _packed(x.dtype, shape[1]).size:
        return tuple(map(float, x.numpy()[-1]))  # raises with the reason
    pack = _packed(x.dtype, shape[1])
    return pack.unpack_from(x.data, (shape[0] - 1) * pack.size)


def stacked(uav: int, rows: Rows) -> tuple[Any, Any]:
    """Return the times (n,) and rows (n, 3 or more) of positions; decode a single row without numpy.

    Raises:
        ValueError: when the shapes do not match; the gateway must resend.
    """
    t, x = rows.t, rows.x
    if x.shape == (1, 3) and t.shape == (1,):
        at, row = last(Array(t.dtype, (1, 1), t.data)), last(x)
        return at, (row,)
    times, places = t.numpy(), x.numpy()
    if places.ndim != 2 or places.shape[1] < 3 or times.shape != (len(places),):
        raise ValueError(f"uav-{uav}: position rows have shape {places.shape}, expected (n, 3) and n times; resend")
    return times.tolist(), places.tolist()
