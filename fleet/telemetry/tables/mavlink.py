"""MAVLink table: one row per message and `Sample` field, with its time source.

All unit conversions of MAVLink to SI, NED, FRD and rad are here. A new source is a new row.
Source: MAVLink common.xml; for ArduPilot's deviations its GCS_Common.cpp and GCS_MAVLink_Plane.cpp.
"""

from math import pi
from typing import Any

import numpy as np

from fleet.telemetry.tables.clock import BOOT, NONE, USEC, USEC32
from fleet.telemetry.tables.row import FieldSource, euler

DEG = pi / 180  # [rad/deg]
MILLI_G = 9.80665e-3  # [m/s2 per milli-g]


def _imu_milli(m: Any) -> tuple[Any, ...]:
    acc = (m.xacc * MILLI_G, m.yacc * MILLI_G, m.zacc * MILLI_G)
    return (*acc, m.xgyro * 1e-3, m.ygyro * 1e-3, m.zgyro * 1e-3)


def _command(m: Any, alt_error: Any, va_error: Any) -> tuple[Any, ...]:
    return (m.nav_roll * DEG, m.nav_pitch * DEG, m.xtrack_error, alt_error, va_error)


_NO_OUTPUT = 65535  # as some releases of PX4 send it
_FIRST_OUTPUTS = tuple(f"servo{n}_raw" for n in range(1, 9))
_LAST_OUTPUTS = tuple(f"servo{n}_raw" for n in range(9, 17))  # extension fields, 0 in MAVLink 1


def _outputs(m: Any, names: tuple[str, ...]) -> tuple[Any, ...]:
    return tuple(np.where(getattr(m, name) == _NO_OUTPUT, 0, getattr(m, name)) for name in names)


def _second_port(m: Any) -> tuple[Any, ...]:
    return (*(m.servo1_raw * 0,) * 8, *_outputs(m, _FIRST_OUTPUTS))


_NO_ITEM = 65535
_FIX_3D = 3
_NO_FIX_E7 = 100_000  # within 1 km of latitude 0, longitude 0 [1e-7 deg]


def _has_fix(m: Any) -> Any:
    return _has_position(m.lat, m.lon)  # without a fix autopilots send 0, 0 or values near it


def _has_position(lat: Any, lon: Any) -> Any:
    return (abs(lat) > _NO_FIX_E7) | (abs(lon) > _NO_FIX_E7)


_ABS_PRESSURE = 1 << 9  # HIGHRES_IMU_UPDATED_FLAGS


def _has_velocity(m: Any) -> Any:
    """Return a mask of valid velocities: an estimator without velocity sends exact zeros or NaN."""
    return np.isfinite(m.vx + m.vy + m.vz) & ((m.vx != 0) | (m.vy != 0) | (m.vz != 0))


def _has_pressure(m: Any) -> Any:
    return ((m.fields_updated & _ABS_PRESSURE) != 0) & np.isfinite(m.abs_pressure) & (m.abs_pressure > 0)


def _wind(m: Any) -> tuple[Any, ...]:
    # direction: where the wind comes from
    return (-m.speed * np.cos(m.direction * DEG), -m.speed * np.sin(m.direction * DEG))


_NO_VOLTAGE = 65535  # battery not measured


def _battery(m: Any) -> tuple[Any, ...]:
    current = np.where(m.current_battery < 0, np.nan, m.current_battery * 1e-2)  # -1: not measured
    return (m.voltage_battery * 1e-3, current, np.where(m.battery_remaining < 0, np.nan, m.battery_remaining * 1e-2))


TABLE: tuple[FieldSource, ...] = (
    FieldSource(
        "ATTITUDE",
        "attitude",
        lambda m: (m.roll, m.pitch, m.yaw, m.rollspeed, m.pitchspeed, m.yawspeed),
        BOOT,
    ),
    FieldSource("HIGHRES_IMU", "imu", lambda m: (m.xacc, m.yacc, m.zacc, m.xgyro, m.ygyro, m.zgyro), USEC, rank=3),
    FieldSource("SCALED_IMU", "imu", _imu_milli, BOOT, rank=2),
    FieldSource("RAW_IMU", "imu", _imu_milli, USEC, rank=1, autopilots=("ardupilot",)),  # others: raw without unit
    FieldSource("GLOBAL_POSITION_INT", "position", lambda m: (m.lat, m.lon, m.alt), BOOT, when=_has_fix),
    FieldSource(
        "GLOBAL_POSITION_INT",
        "velocity",
        lambda m: (m.vx * 1e-2, m.vy * 1e-2, m.vz * 1e-2),
        BOOT,
        when=_has_fix,
    ),
    FieldSource(
        "LOCAL_POSITION_NED",  # the same estimator, unrounded and often faster
        "velocity",
        lambda m: (m.vx, m.vy, m.vz),
        BOOT,
        rank=1,
        when=_has_velocity,
        requires="position",  # without a fix PX4 sends a drifting velocity, not aligned with north
    ),
    FieldSource("VFR_HUD", "air", lambda m: (m.airspeed, m.throttle * 1e-2, m.climb), NONE),
    FieldSource(
        "SERVO_OUTPUT_RAW",
        "servo",
        lambda m: _outputs(m, _FIRST_OUTPUTS + _LAST_OUTPUTS),
        USEC32,
        when=lambda m: m.port == 0,
    ),
    FieldSource(
        "SERVO_OUTPUT_RAW",
        "servo",
        _second_port,
        USEC32,
        autopilots=("px4", "generic"),  # AUX outputs; ArduPilot sends outputs 17 to 32 on this port
        when=lambda m: m.port == 1,
    ),
    FieldSource(
        "NAV_CONTROLLER_OUTPUT",
        "command",
        lambda m: _command(m, m.alt_error, m.aspd_error * 1e-2),  # ArduPilot sends cm/s, not the m/s of common.xml
        NONE,
        autopilots=("ardupilot",),
    ),
    FieldSource(
        "NAV_CONTROLLER_OUTPUT",
        "command",
        lambda m: _command(m, -m.alt_error, -m.aspd_error),  # PX4 sends actual minus commanded
        NONE,
        autopilots=("px4",),
    ),
    FieldSource(
        "NAV_CONTROLLER_OUTPUT",
        "command",
        lambda m: _command(m, m.alt_error, m.aspd_error),
        NONE,
        autopilots=("generic",),
    ),
    FieldSource(
        "NAV_CONTROLLER_OUTPUT", "bearing", lambda m: (m.target_bearing * DEG,), NONE, autopilots=("ardupilot",)
    ),
    FieldSource(
        "ATTITUDE_TARGET",
        "command",
        lambda m: (*euler(np.asarray(m.q, float).T)[:2], np.nan, np.nan, np.nan),
        BOOT,
        rank=1,  # PX4 attitude set points; only some builds send the other message
        autopilots=("px4",),
    ),
    FieldSource("MISSION_CURRENT", "leg", lambda m: (np.where(m.seq == _NO_ITEM, -1.0, m.seq),), NONE),
    FieldSource("WIND", "wind", _wind, NONE, rank=1),
    FieldSource("WIND_COV", "wind", lambda m: (m.wind_x, m.wind_y), USEC, rank=2),
    FieldSource(
        "POSITION_TARGET_GLOBAL_INT",
        "target",
        lambda m: (m.lat_int, m.lon_int, m.alt * 1e3),
        BOOT,
        when=lambda m: ((m.coordinate_frame == 0) | (m.coordinate_frame == 5)) & _has_position(m.lat_int, m.lon_int),
    ),
    FieldSource("HIGHRES_IMU", "pressure", lambda m: (m.abs_pressure * 1e2,), USEC, rank=1, when=_has_pressure),
    FieldSource("GLOBAL_POSITION_INT", "height", lambda m: (m.relative_alt * 1e-3,), BOOT, when=_has_fix),
    FieldSource(
        "SCALED_PRESSURE",
        "pressure",
        lambda m: (m.press_abs * 1e2,),
        BOOT,
        when=lambda m: m.press_abs != 0,  # 0: no barometer
    ),
    FieldSource("SYS_STATUS", "battery", _battery, NONE, when=lambda m: m.voltage_battery < _NO_VOLTAGE),
    # time_usec is boot time or receiver time, depending on the autopilot: not usable for the shared clock
    FieldSource("GPS_RAW_INT", "gnss", lambda m: (m.alt,), NONE, when=lambda m: m.fix_type >= _FIX_3D),
)

SECOND_PORT = next(number for number, row in enumerate(TABLE) if row.columns is _second_port)
"""Row of the second servo port: its columns complete rows of the first port and are no rows themselves."""

_OWN_TIME = {BOOT: lambda m: m.time_boot_ms * 1e-3, USEC: lambda m: m.time_usec * 1e-6, NONE: lambda m: 0.0}
_OWN_TIME[USEC32] = _OWN_TIME[USEC]


def own_seconds(row: FieldSource, message: Any) -> Any:
    """Return the time stamps of the messages from the row's time source [s]; 0 without source."""
    return _OWN_TIME[row.tick](message)
