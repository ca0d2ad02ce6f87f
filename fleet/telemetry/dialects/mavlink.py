"""THE TABLE of MAVLink: one row per message and `Sample` field, with the clock its time comes from.

The only place where degrees, centimetres, milli-g and per cent become SI, NED, FRD and rad. A newcomer adds a row.
Source: MAVLink common.xml; for what ArduPilot really sends, its GCS_Common.cpp and GCS_MAVLink_Plane.cpp.
"""

from collections.abc import Callable
from enum import Enum
from math import pi
from typing import Any, NamedTuple

DEG = pi / 180  # [rad/deg]
MILLI_G = 9.80665e-3  # [m/s2 per milli-g]


class Tick(Enum):
    """Where the time of a message comes from."""

    BOOT_MS = "time_boot_ms, wraps after 49.7 days"
    USEC = "time_usec, 64 bit, since boot or since 1970"
    USEC32 = "time_usec cut to 32 bit, wraps after 71.6 minutes"
    NONE = "no time: the newest boot time heard from the same aircraft"


class Row(NamedTuple):
    """One way from a message to columns of a `Sample` field."""

    message: str  # MAVLink name
    field: str  # field of `Sample`; columns as in `contract.COLUMNS`
    tick: Tick
    columns: Callable[[Any], tuple[float, ...]]
    rank: int = 0  # among rows of one field the highest rank that flows wins
    autopilots: tuple[str, ...] = ()  # empty: any
    when: Callable[[Any], bool] | None = None  # which messages of that name count


def _imu_milli(m: Any) -> tuple[float, ...]:
    acc = (m.xacc * MILLI_G, m.yacc * MILLI_G, m.zacc * MILLI_G)
    return (*acc, m.xgyro * 1e-3, m.ygyro * 1e-3, m.zgyro * 1e-3)


def _command(m: Any, va_error: float) -> tuple[float, ...]:
    return (m.nav_roll * DEG, m.nav_pitch * DEG, m.xtrack_error, m.alt_error, va_error)


def _servo(m: Any) -> tuple[float, ...]:
    raw = (m.servo1_raw, m.servo2_raw, m.servo3_raw, m.servo4_raw, m.servo5_raw, m.servo6_raw, m.servo7_raw)
    return (*raw, m.servo8_raw)


_NO_FIX_E7 = 100_000  # a kilometre round zero, zero [1e-7 deg]


def _has_fix(m: Any) -> bool:
    return max(abs(m.lat), abs(m.lon)) > _NO_FIX_E7  # without a fix autopilots say zero, zero, or drift around it


TABLE: tuple[Row, ...] = (
    Row(
        "ATTITUDE",
        "attitude",
        Tick.BOOT_MS,
        lambda m: (m.roll, m.pitch, m.yaw, m.rollspeed, m.pitchspeed, m.yawspeed),
    ),
    Row("HIGHRES_IMU", "imu", Tick.USEC, lambda m: (m.xacc, m.yacc, m.zacc, m.xgyro, m.ygyro, m.zgyro), rank=3),
    Row("SCALED_IMU", "imu", Tick.BOOT_MS, _imu_milli, rank=2),
    Row("RAW_IMU", "imu", Tick.USEC, _imu_milli, rank=1, autopilots=("ardupilot",)),  # elsewhere raw has no unit
    Row("GLOBAL_POSITION_INT", "position", Tick.BOOT_MS, lambda m: (m.lat, m.lon, m.alt), when=_has_fix),
    Row(
        "GLOBAL_POSITION_INT",
        "velocity",
        Tick.BOOT_MS,
        lambda m: (m.vx * 1e-2, m.vy * 1e-2, m.vz * 1e-2),
        when=_has_fix,
    ),
    Row("VFR_HUD", "air", Tick.NONE, lambda m: (m.airspeed, m.throttle * 1e-2, m.climb)),
    Row("SERVO_OUTPUT_RAW", "servo", Tick.USEC32, _servo, when=lambda m: m.port == 0),
    Row(
        "NAV_CONTROLLER_OUTPUT",
        "command",
        Tick.NONE,
        lambda m: _command(m, m.aspd_error * 1e-2),  # ArduPilot sends cm/s, not the m/s of common.xml
        autopilots=("ardupilot",),
    ),
    Row(
        "NAV_CONTROLLER_OUTPUT",
        "command",
        Tick.NONE,
        lambda m: _command(m, m.aspd_error),
        autopilots=("px4", "generic"),
    ),
    Row("MISSION_CURRENT", "leg", Tick.NONE, lambda m: (-1 if m.seq == 65535 else m.seq,)),
)

ROWS: dict[str, tuple[Row, ...]] = {
    name: tuple(row for row in TABLE if row.message == name) for name in {row.message for row in TABLE}
}

_RATES = (100.0,) * 3  # [rad/s]
HIGHEST: dict[str, tuple[float, ...]] = {
    "attitude": (7.0, 7.0, 7.0, *_RATES),
    "imu": (1e3, 1e3, 1e3, *_RATES),
    "position": (9e8, 1.8e9, 1e8),
    "velocity": (500.0, 500.0, 500.0),
    "air": (500.0, 1.5, 500.0),
    "servo": (65535.0,) * 8,
    "command": (7.0, 7.0, 1e6, 1e5, 1e3),
    "leg": (65535.0,),
}
"""Largest believable magnitude per column, in the units of `contract.COLUMNS`; beyond it (or not finite) is refused."""


def believable(field: str, values: tuple[float, ...]) -> bool:
    """Tell whether every column is finite and within its largest believable magnitude."""
    return all(-high <= value <= high for value, high in zip(values, HIGHEST[field], strict=True))


def raw_seconds(tick: Tick, message: Any) -> float:
    """Read the message's own time [s] on whatever clock it counts; only for ticks other than NONE."""
    return message.time_boot_ms * 1e-3 if tick is Tick.BOOT_MS else message.time_usec * 1e-6
