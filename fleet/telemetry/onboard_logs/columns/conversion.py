"""Convert columns of a table to the units and frames of `Sample` fields."""

from collections.abc import Sequence
from math import pi

import numpy as np

from fleet.frames import wrap
from fleet.telemetry.tables.row import euler

_DEG, _G = pi / 180, 9.80665
UNITS = {  # factor to SI
    "1": 1.0,
    "rad": 1.0,
    "rad/s": 1.0,
    "m": 1.0,
    "m/s": 1.0,
    "m/s2": 1.0,
    "us": 1.0,
    "Pa": 1.0,
    "deg": _DEG,
    "deg/s": _DEG,
    "cm": 1e-2,
    "mm": 1e-3,
    "cm/s": 1e-2,
    "mm/s": 1e-3,
    "km/h": 1 / 3.6,
    "knot": 1852.0 / 3600.0,
    "ft": 0.3048,
    "g": _G,
    "mg": 1e-3 * _G,
    "hPa": 100.0,
    "percent": 1e-2,
    "1e-7deg": 1e-7 * _DEG,
}
UNITS |= {f"-{unit}": -factor for unit, factor in UNITS.items()}  # for columns of the opposite sign
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
FRAMES = ("ned", "enu")
"""Frame of angles, positions and velocities; body axes are FRD with `ned`, FLU with `enu` (as in ROS)."""
WIDTHS = {
    "attitude": (3, 4, 6, 7),
    "imu": (3, 6),
    "position": (3,),
    "velocity": (3,),
    "air": (1, 2, 3),
    "leg": (1,),
    "servo": tuple(range(1, 17)),
    "command": (2, 3, 4, 5),
    "wind": (2,),
    "target": (3,),
    "pressure": (1,),
    "gnss": (1,),
    "height": (1,),
    "bearing": (1,),
    "battery": (3,),
    "mode": (1,),
    "armed": (1,),
}
"""Number of columns of each field; attitude: roll pitch yaw or a quaternion (scalar first), with or without rates."""
_SERVO_SPAN_US = 500.0


def to_sample(field: str, columns: Sequence[np.ndarray], frame: str) -> np.ndarray:
    """Convert the columns of a field to the units of `contract.COLUMNS`, (n, k).

    Args:
        field: `Sample` field
        columns: in SI units, in the order of the map, (n,) each
        frame: one of `FRAMES`
    """
    enu = frame == "enu"
    if field == "attitude":
        return _attitude(columns, enu)
    if field == "imu":
        gyro = columns[3:6] if len(columns) == 6 else [np.zeros_like(columns[0])] * 3
        return np.column_stack([*_body(columns[:3], enu), *_body(gyro, enu)])
    if field in ("velocity", "wind"):
        return np.column_stack(_ned(columns, enu))
    if field in ("position", "target"):
        lat, lon, alt = columns
        return np.column_stack([np.rint(lat / _DEG * 1e7), np.rint(lon / _DEG * 1e7), np.rint(alt * 1e3)])
    if field == "gnss":
        return np.rint(columns[0] * 1e3)[:, None]
    return np.column_stack(_padded(field, columns))


def pulses(control: np.ndarray) -> np.ndarray:
    """Convert a control of -1..1 to a pulse width [us]."""
    return 1500.0 + _SERVO_SPAN_US * np.clip(control, -1.0, 1.0)


def _padded(field: str, columns: Sequence[np.ndarray]) -> list[np.ndarray]:
    forms = {"servo": (0.0, 8 if len(columns) <= 8 else 16), "air": (0.0, 3), "command": (np.nan, 5)}
    fill, width = forms.get(field, (0.0, len(columns)))
    return [*columns, *[np.full(len(columns[0]), fill)] * (width - len(columns))]


def _attitude(columns: Sequence[np.ndarray], enu: bool) -> np.ndarray:
    """Return phi theta psi p q r; the rates are nan where the map has none.

    ENU and FLU to NED and FRD: phi = roll, theta = -pitch, psi = pi/2 - yaw. Source: ROS REP 103.
    """
    n_angles = 4 if len(columns) in (4, 7) else 3
    angles = list(euler(columns[:4]) if n_angles == 4 else columns[:3])
    if enu:
        angles = [angles[0], -angles[1], pi / 2 - angles[2]]
    angles[2] = wrap(angles[2])
    rates = columns[n_angles:] or [np.full(len(columns[0]), np.nan)] * 3
    return np.column_stack([*angles, *_body(rates, enu)])


def _body(vector: Sequence[np.ndarray], flu: bool) -> list[np.ndarray]:
    x, y, z = vector
    return [x, -y, -z] if flu else [x, y, z]


def _ned(vector: Sequence[np.ndarray], enu: bool) -> list[np.ndarray]:
    if not enu:
        return list(vector)
    east, north, *up = vector
    return [north, east, *(-component for component in up)]
