"""MAVROS table: one row per ROS 2 topic and `Sample` field; topics are named as after `mavros/`.

MAVROS converts MAVLink to ENU and FLU; this table converts back. Its altitudes of `global_position` are above the
ellipsoid. Source: ROS REP 103 and 105; MAVROS plugins (imu, global_position, local_position, rc_io, vfr_hud, wind).
"""

from math import pi
from typing import Any

import numpy as np

from fleet.frames import wrap
from fleet.telemetry.tables.row import FieldSource, euler

_DEG = pi / 180  # [rad/deg]
_GLOBAL = (0, 5)  # MAV_FRAME: altitude above sea level
_MAX_ITEM = 65534
_NO_FIX_DEG = 0.01  # within 1 km of latitude 0, longitude 0 [deg]


def _flu(m: Any) -> tuple[Any, ...]:
    return (m.x, -m.y, -m.z)


def _attitude(m: Any) -> tuple[Any, ...]:
    roll, pitch, yaw = euler((m.orientation.w, m.orientation.x, m.orientation.y, m.orientation.z))
    return (roll, -pitch, wrap(pi / 2 - yaw), *_flu(m.angular_velocity))


def _ned(m: Any) -> tuple[Any, ...]:
    return (m.y, m.x, -m.z)


def _position(m: Any, altitude: Any) -> tuple[Any, ...]:
    return (np.rint(m.latitude * 1e7), np.rint(m.longitude * 1e7), np.rint(altitude * 1e3))


def _has_position(m: Any) -> Any:
    return (np.abs(m.latitude) > _NO_FIX_DEG) | (np.abs(m.longitude) > _NO_FIX_DEG)


def _channels(m: Any) -> tuple[Any, ...]:
    channels = m.channels[:16]
    width = 8 if len(channels) <= 8 else 16
    return (*(np.nan_to_num(pulse) for pulse in channels), *(channels[0] * 0.0,) * (width - len(channels)))


TABLE: tuple[FieldSource, ...] = (
    FieldSource("imu/data", "attitude", _attitude),
    FieldSource("imu/data", "imu", lambda m: (*_flu(m.linear_acceleration), *_flu(m.angular_velocity)), rank=2),
    FieldSource("imu/data_raw", "imu", lambda m: (*_flu(m.linear_acceleration), *_flu(m.angular_velocity)), rank=1),
    FieldSource(
        "global_position/global",
        "position",
        lambda m: _position(m, m.interpolated("altitude").amsl),
        rank=3,
        when=_has_position,
    ),
    FieldSource(
        "global_position/global",
        "position",
        lambda m: _position(m, m.interpolated("vfr_hud").altitude),
        rank=2,
        when=_has_position,
    ),
    FieldSource("global_position/global", "position", lambda m: _position(m, m.altitude), rank=1, when=_has_position),
    FieldSource("local_position/velocity_local", "velocity", lambda m: _ned(m.twist.linear), rank=2),
    FieldSource("global_position/raw/gps_vel", "velocity", lambda m: _ned(m.twist.linear), rank=1),
    FieldSource("vfr_hud", "air", lambda m: (m.airspeed, m.throttle, m.climb)),
    FieldSource("rc/out", "servo", _channels),
    FieldSource(
        "nav_controller_output",
        "command",
        lambda m: (m.nav_roll * _DEG, m.nav_pitch * _DEG, m.xtrack_error, m.alt_error, m.aspd_error * np.nan),
    ),
    FieldSource("mission/waypoints", "leg", lambda m: (np.where(m.current_seq > _MAX_ITEM, -1.0, m.current_seq),)),
    FieldSource("wind_estimation", "wind", lambda m: _ned(m.twist.linear)[:2], autopilots=("px4",)),
    FieldSource(  # from WIND: it points to where the wind comes from
        "wind_estimation",
        "wind",
        lambda m: (-m.twist.linear.y, -m.twist.linear.x),
        autopilots=("ardupilot",),
    ),
    FieldSource(
        "setpoint_raw/target_global",
        "target",
        lambda m: _position(m, m.altitude),
        when=lambda m: np.isin(m.coordinate_frame, _GLOBAL) & _has_position(m),
    ),
    FieldSource("imu/static_pressure", "pressure", lambda m: (m.fluid_pressure,), when=lambda m: m.fluid_pressure > 0),
)

FIELDS = tuple(dict.fromkeys(row.field for row in TABLE))
ROWS: dict[str, tuple[FieldSource, ...]] = {
    field: tuple(sorted((row for row in TABLE if row.field == field), key=lambda row: -row.rank)) for field in FIELDS
}


def rows_of(autopilot: str) -> dict[str, tuple[FieldSource, ...]]:
    """Return the rows that apply to an autopilot."""
    return {
        field: tuple(row for row in rows if not row.autopilots or autopilot in row.autopilots)
        for field, rows in ROWS.items()
    }


TOPICS = frozenset({row.message for row in TABLE} | {"altitude"})
EVENT_TOPICS = frozenset({"state", "mission/waypoints", "param/event", "statustext/recv", "home_position/home"})
"""Topics read as events: mode and arming, mission, parameters, texts, home."""
