"""Row type of the dialect tables, and the range of plausible values of each field."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numba as nb
import numpy as np

from fleet.contract import FIRST_OPTIONAL_COLUMN


class FieldSource(NamedTuple):
    """Mapping from one message to the columns of a `Sample` field.

    `columns` and `when` read message fields as attributes, numbers or arrays: they must not use `if` or `math`.
    """

    message: str  # message name in the dialect
    field: str  # field of `Sample`; columns as in `contract.COLUMNS`
    columns: Callable[[Any], tuple[Any, ...]]
    tick: int = 0  # MAVLink: time source BOOT, USEC, USEC32 or NONE of `tables.clock`
    rank: int = 0  # priority: the highest active rank of a field wins; in MAVLink below `RANK_COUNT`
    autopilots: tuple[str, ...] = ()  # empty: any
    when: Callable[[Any], Any] | None = None  # mask of the applicable messages
    requires: str = ""  # MAVLink: used only while this field is active


_MAX_RATES = (100.0,) * 3  # [rad/s]
_MAX_POSITION = (9e8, 1.8e9, 1e8)  # [1e-7 deg, 1e-7 deg, mm]
MAX_MAGNITUDE: dict[str, tuple[float, ...]] = {
    "attitude": (7.0, 7.0, 7.0, *_MAX_RATES),
    "imu": (1e3, 1e3, 1e3, *_MAX_RATES),
    "position": _MAX_POSITION,
    "velocity": (500.0, 500.0, 500.0),
    "air": (500.0, 1.5, 500.0),
    "servo": (65535.0,) * 16,
    "command": (7.0, 7.0, 1e6, 1e5, 1e3),
    "leg": (65535.0,),
    "wind": (150.0, 150.0),
    "target": _MAX_POSITION,
    "pressure": (120_000.0,),
    "gnss": _MAX_POSITION[2:],
    "height": (9e4,),
    "bearing": (7.0,),
    "battery": (1e3, 1e3, 1.0),
}
"""Maximum plausible magnitude per column in the units of `contract.COLUMNS`; other values are rejected."""

_MAX_ARRAY = {field: np.array(values) for field, values in MAX_MAGNITUDE.items()}


def is_plausible(field: str, values: np.ndarray) -> np.ndarray:
    """Return a mask of the rows, (n, k), with all columns within `MAX_MAGNITUDE`, (n,).

    Only the optional columns of `UNTOLD` may be non-finite.
    """
    rows = np.ascontiguousarray(values, float).reshape(-1, values.shape[-1])
    optional_from = FIRST_OPTIONAL_COLUMN.get(field, values.shape[-1])
    return _all_within(rows, _MAX_ARRAY[field], optional_from).reshape(values.shape[:-1])


@nb.njit(cache=True, nogil=True)
def _all_within(rows, limits, optional_from):
    within = np.ones(len(rows), np.bool_)
    for i in range(len(rows)):
        for k in range(rows.shape[1]):
            if not (abs(rows[i, k]) <= limits[k] or (k >= optional_from and np.isnan(rows[i, k]))):
                within[i] = False
    return within


def euler(q: Any) -> tuple[Any, ...]:
    """Return phi theta psi [rad] of a quaternion's columns, scalar first, body -> NED.

    Source: Beard & McLain eq. B.1.
    """
    norm = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    e0, e1, e2, e3 = (e / np.where(np.abs(norm - 1) < 0.1, norm, np.nan) for e in q)
    phi = np.arctan2(2 * (e0 * e1 + e2 * e3), e0**2 + e3**2 - e1**2 - e2**2)
    theta = np.arcsin(np.clip(2 * (e0 * e2 - e1 * e3), -1, 1))
    return phi, theta, np.arctan2(2 * (e0 * e3 + e1 * e2), e0**2 + e1**2 - e2**2 - e3**2)
