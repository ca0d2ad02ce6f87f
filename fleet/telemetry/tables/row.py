"""What every dialect's table is made of: `Row`; and which values any of them may claim."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from fleet.contract import UNTOLD


class Row(NamedTuple):
    """One way from a message to columns of a `Sample` field.

    `columns` and `when` read the message's fields as attributes, numbers and arrays alike: no `if`, no `math`.
    """

    message: str  # its name in the dialect
    field: str  # field of `Sample`; columns as in `contract.COLUMNS`
    columns: Callable[[Any], tuple[Any, ...]]
    tick: int = 0  # MAVLink: the clock its time comes from, BOOT, USEC, USEC32 or NONE of `telemetry.clock`
    rank: int = 0  # among rows of one field the highest rank that flows wins; in MAVLink's table below `settle.RANKS`
    autopilots: tuple[str, ...] = ()  # empty: any
    when: Callable[[Any], Any] | None = None  # which messages of that name count
    given: str = ""  # MAVLink: it counts only while rows of this field flow


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
    "pressure": (120_000.0,),
    "gnss": _PLACE[2:],
    "height": (9e4,),
}
"""Largest believable magnitude per column, in the units of `contract.COLUMNS`; beyond it (or not finite) is refused."""

_HIGHEST = {field: np.array(values) for field, values in HIGHEST.items()}


def believable(field: str, values: np.ndarray) -> np.ndarray:
    """Tell for each row, (n, k), whether every column is within its largest believable magnitude, (n,).

    Every column is finite but those of `UNTOLD`.
    """
    good = np.abs(values) <= _HIGHEST[field]
    untold = UNTOLD.get(field, values.shape[-1])
    good[..., untold:] |= np.isnan(values[..., untold:])
    return good.all(axis=-1)


def euler(q: Any) -> tuple[Any, ...]:
    """Return phi theta psi [rad] of a quaternion's columns, scalar first, body -> NED.

    Source: Beard & McLain eq. B.1.
    """
    norm = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    e0, e1, e2, e3 = (e / np.where(np.abs(norm - 1) < 0.1, norm, np.nan) for e in q)
    phi = np.arctan2(2 * (e0 * e1 + e2 * e3), e0**2 + e3**2 - e1**2 - e2**2)
    theta = np.arcsin(np.clip(2 * (e0 * e2 - e1 * e3), -1, 1))
    return phi, theta, np.arctan2(2 * (e0 * e3 + e1 * e2), e0**2 + e1**2 - e2**2 - e3**2)
