"""What every dialect's table is made of: `Row`; and which values any of them may claim."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np


class Row(NamedTuple):
    """One way from a message to columns of a `Sample` field.

    `columns` and `when` read the message's fields as attributes, numbers and arrays alike: no `if`, no `math`.
    """

    message: str  # its name in the dialect
    field: str  # field of `Sample`; columns as in `contract.COLUMNS`
    columns: Callable[[Any], tuple[Any, ...]]
    tick: int = 0  # MAVLink: the clock its time comes from, BOOT, USEC, USEC32 or NONE of `telemetry.clock`
    rank: int = 0  # among rows of one field the highest rank that flows wins
    autopilots: tuple[str, ...] = ()  # empty: any
    when: Callable[[Any], Any] | None = None  # which messages of that name count


_RATES = (100.0,) * 3  # [rad/s]
_PLACE = (9e8, 1.8e9, 1e8)  # [1e-7 deg, 1e-7 deg, mm]
HIGHEST: dict[str, tuple[float, ...]] = {
    "attitude": (7.0, 7.0, 7.0, *_RATES),
    "imu": (1e3, 1e3, 1e3, *_RATES),
    "position": _PLACE,
    "velocity": (500.0, 500.0, 500.0),
    "air": (500.0, 1.5, 500.0),
    "servo": (65535.0,) * 8,
    "command": (7.0, 7.0, 1e6, 1e5, 1e3),
    "leg": (65535.0,),
    "wind": (150.0, 150.0),
    "target": _PLACE,
}
"""Largest believable magnitude per column, in the units of `contract.COLUMNS`; beyond it (or not finite) is refused."""

_HIGHEST = {field: np.array(values) for field, values in HIGHEST.items()}


def believable(field: str, values: np.ndarray) -> np.ndarray:
    """Tell for each row, (n, k), whether every column is finite and within its largest believable magnitude, (n,)."""
    return (np.abs(values) <= _HIGHEST[field]).all(axis=-1)
