"""Decode rows of a sample into tuples: for single rows this is faster than a numpy array."""

import struct
from functools import cache
from typing import Any

from fleet.contract import Array, Rows

_STRUCT_CODES = {"<f4": "f", "<f8": "d", "<i4": "i", "<i8": "q", "|u1": "B"}


@cache
def _packed(dtype: str, width: int) -> struct.Struct:
    return struct.Struct(f"<{width}{_STRUCT_CODES[dtype]}")


def last_row(x: Array) -> tuple[float, ...]:
    """Return the last row of a table; empty when there is none.

    Raises:
        ValueError: when dtype, shape and byte count disagree; correct the sender.
    """
    shape = x.shape
    if len(shape) != 2 or not shape[0]:
        return ()
    if (
        x.dtype not in _STRUCT_CODES
        or not 0 < shape[1] < 100
        or len(x.data) != shape[0] * _packed(x.dtype, shape[1]).size
    ):
        return tuple(map(float, x.numpy()[-1]))  # raises with the reason
    pack = _packed(x.dtype, shape[1])
    return pack.unpack_from(x.data, (shape[0] - 1) * pack.size)


def position_rows(uav: int, rows: Rows) -> tuple[Any, Any]:
    """Return the times (n,) and rows (n, 3 or more) of positions; decode a single row without numpy.

    Raises:
        ValueError: when the shapes do not match; the gateway must resend.
    """
    t, x = rows.t, rows.x
    if x.shape == (1, 3) and t.shape == (1,):
        row_times, row = last_row(Array(t.dtype, (1, 1), t.data)), last_row(x)
        return row_times, (row,)
    times, positions = t.numpy(), x.numpy()
    if positions.ndim != 2 or positions.shape[1] < 3 or times.shape != (len(positions),):
        raise ValueError(f"uav-{uav}: position rows have shape {positions.shape}, expected (n, 3) and n times; resend")
    return times.tolist(), positions.tolist()
