"""ULog table: one row per PX4 topic and `Sample` field, from PX4 1.6 (2017) to 1.16.

PX4 moves fields between topics from release to release. A row applies if the log has its topic, auxiliary topics and
fields; the highest active rank wins. A new release is a new row, and no row checks a version.
A row reads the fields of its topic as arrays; `interpolated` reads another topic at the same times.
Source: PX4-Autopilot msg/ at the release tags; MAVLink equivalents: src/modules/mavlink/streams/.
"""

from collections.abc import Callable, Iterator
from math import pi
from typing import Any

import numpy as np

from fleet.telemetry.tables.row import FieldSource, euler

DEG = pi / 180  # [rad/deg]
_NO_FIX_DEG = 0.01  # within 1 km of latitude 0, longitude 0 [deg]
_FIX_3D = 3
_MIN_PRESSURE_PA = 2_000.0  # at 26 km altitude; lower values are in millibar
_IDLE = 5  # position_setpoint.type without target
_EARTH_M = 6_371_000.0  # radius of the sphere of PX4's local projection
_MIN_PULSE_US, _MAX_PULSE_US = 700.0, 2300.0  # valid servo pulse widths

Columns = Callable[[Any], tuple[Any, ...]]


def _has_position(lat_deg: Any, lon_deg: Any) -> Any:
    return (np.abs(lat_deg) > _NO_FIX_DEG) | (np.abs(lon_deg) > _NO_FIX_DEG)


def _position(lat_deg: Any, lon_deg: Any, alt_m: Any) -> tuple[Any, ...]:
    return np.rint(lat_deg * 1e7), np.rint(lon_deg * 1e7), np.rint(alt_m * 1e3)


def _position_from_local(m: Any) -> tuple[Any, ...]:
    """Invert PX4's azimuthal equidistant projection. Source: PX4 src/lib/geo, MapProjection::reproject."""
    lat, lon = m.ref_lat * DEG, m.ref_lon * DEG
    c = np.hypot(m.x, m.y) / _EARTH_M
    k = np.sinc(c / pi)  # sin(c) / c
    n, e = m.x / _EARTH_M * k, m.y / _EARTH_M * k
    north = np.arcsin(np.clip(np.cos(c) * np.sin(lat) + n * np.cos(lat), -1, 1))
    east = lon + np.arctan2(e, np.cos(lat) * np.cos(c) - n * np.sin(lat))
    return _position(north / DEG, (east / DEG + 180) % 360 - 180, m.ref_alt - m.z)


# --- air: sources of airspeed and throttle ------------------------------------------------------------------------
# Calibrated before true airspeed: PX4's VFR_HUD and controllers and ArduPilot use calibrated airspeed.

_AIRSPEED: tuple[tuple[str, Columns], ...] = (
    ("airspeed_validated", lambda m: (m.calibrated_airspeed_m_s,)),  # since 1.12
    ("airspeed_validated", lambda m: (m.equivalent_airspeed_m_s,)),  # 1.10, 1.11
    ("airspeed", lambda m: (m.indicated_airspeed_m_s,)),
)


def _thrust(m: Any) -> Any:
    return np.sqrt(sum(axis**2 for axis in m.xyz))


_THROTTLE: tuple[Callable[[Any], Any], ...] = (  # VTOL: the larger thrust, as in VFR_HUD
    lambda m: np.fmax(
        m.interpolated("actuator_controls_0").control[3], m.interpolated("actuator_controls_1").control[3]
    ),
    lambda m: m.interpolated("actuator_controls_0").control[3],  # until 1.13
    lambda m: np.fmax(
        _thrust(m.interpolated("vehicle_thrust_setpoint")), _thrust(m.interpolated("vehicle_thrust_setpoint.1"))
    ),
    lambda m: _thrust(m.interpolated("vehicle_thrust_setpoint")),  # since 1.14
    lambda m: m.interpolated("actuator_motors").control[0],
)


def _air_row(topic: str, airspeed: Columns, throttle: Callable[[Any], Any], rank: int) -> FieldSource:
    def columns(m: Any) -> tuple[Any, ...]:
        return (*airspeed(m), throttle(m), -m.interpolated("vehicle_local_position").vz)

    return FieldSource(topic, "air", columns, rank=rank)


def _air_rows() -> Iterator[FieldSource]:
    pairs = [(topic, airspeed, throttle) for topic, airspeed in _AIRSPEED for throttle in _THROTTLE]
    for rank, (topic, airspeed, throttle) in enumerate(reversed(pairs)):
        yield _air_row(topic, airspeed, throttle, rank)


# --- servo --------------------------------------------------------------------------------------------------------


def _output(m: Any) -> tuple[Any, ...]:
    first = tuple(np.where(np.isfinite(output), output, 0.0) for output in m.output[:8])
    return first if len(m.output) <= 8 else (*first, *_only_pulses(m.output[8:16], 8))


def _both_ports(m: Any) -> tuple[Any, ...]:
    """Return the outputs of MAIN; those of AUX follow as 9 to 16 where MAIN has none."""
    main, aux = _output(m), _only_pulses(m.interpolated("actuator_outputs.1").output[:8], 8)
    rest = main[8:] or (np.zeros_like(main[0]),) * 8
    has_own = np.any([output != 0 for output in rest], axis=0)
    return (*main[:8], *(np.where(has_own, own, other) for own, other in zip(rest, aux, strict=True)))


def _only_pulses(outputs: tuple[Any, ...], width: int) -> tuple[Any, ...]:
    """Return outputs with 0 for all that is no pulse width."""
    valid = tuple(np.where((o > _MIN_PULSE_US) & (o < _MAX_PULSE_US), o, 0.0) for o in outputs)
    return (*valid, *(np.zeros_like(outputs[0], float),) * (width - len(valid)))


def _are_pulses(m: Any) -> Any:
    """Return a mask of outputs that are pulse widths, not ESC counts or rad/s (since 1.13) nor all zero."""
    outputs = np.array(_output(m)[:8])
    is_pulse = ((outputs == 0) | ((outputs > _MIN_PULSE_US) & (outputs < _MAX_PULSE_US))).all(axis=0)
    driven = (outputs != 0).any(axis=0)
    return is_pulse & driven & (np.sum(is_pulse & driven) >= 0.9 * np.sum(driven))


def _pulse_widths(m: Any, middle: float, reach: float) -> tuple[Any, ...]:
    """Return pulse widths [us] for a control of -1..1; 0 for non-finite controls."""
    pulses = [np.where(np.isfinite(c), middle + reach * np.clip(c, -1, 1), 0.0) for c in m.control[:16]]
    width = 8 if len(pulses) <= 8 else 16
    return (*pulses, *([np.zeros_like(pulses[0])] * (width - len(pulses))))


def _is_driven(m: Any) -> Any:
    return np.isfinite(np.array(m.control[:16])).any(axis=0)


# --- command: set points of a fixed wing; errors are commanded minus actual ---------------------------------------


def _setpoint_euler(m: Any) -> tuple[Any, ...]:
    return euler(m.q_d)[:2]


def _setpoint_angles(m: Any) -> tuple[Any, ...]:
    return m.roll_body, m.pitch_body


def _estimator_errors(m: Any) -> tuple[Any, ...]:
    tecs = m.interpolated("tecs_status")
    altitude_error = tecs.altitude_sp - m.interpolated("vehicle_global_position").alt
    return altitude_error, tecs.true_airspeed_sp - tecs.true_airspeed_filtered


def _tecs_errors(altitude_sp: str, airspeed_sp: str, airspeed: str) -> Columns:
    def columns(m: Any) -> tuple[Any, ...]:
        tecs = m.interpolated("tecs_status")
        return getattr(tecs, altitude_sp) - tecs.altitude_filtered, getattr(tecs, airspeed_sp) - getattr(tecs, airspeed)

    return columns


_ERRORS_1_11 = _tecs_errors("altitude_sp", "true_airspeed_sp", "true_airspeed_filtered")
_ERRORS_1_8 = _tecs_errors("altitude_sp", "airspeed_sp", "airspeed_filtered")
_ERRORS_1_6 = _tecs_errors("altitudeSp", "airspeedSp", "airspeed_filtered")
_COMMAND_SOURCES: tuple[tuple[Columns, str, Columns], ...] = (  # roll and pitch, path topic or none, errors
    (_setpoint_euler, "position_controller_status", _estimator_errors),  # 1.16 has no roll_body
    (_setpoint_angles, "position_controller_status", _estimator_errors),  # 1.14, 1.15: TECS logs no altitude
    (_setpoint_angles, "position_controller_status", _ERRORS_1_11),  # 1.11 to 1.13
    (_setpoint_angles, "position_controller_status", _ERRORS_1_8),  # 1.9, 1.10
    (_setpoint_angles, "fw_pos_ctrl_status", _ERRORS_1_8),  # 1.8
    (_setpoint_angles, "fw_pos_ctrl_status", _ERRORS_1_6),  # 1.6, 1.7
    *((_setpoint_angles, "", errors) for errors in (_ERRORS_1_11, _ERRORS_1_8, _ERRORS_1_6)),  # path topic not logged
)


def _command_row(attitude: Columns, path: str, errors: Columns, rank: int) -> FieldSource:
    def columns(m: Any) -> tuple[Any, ...]:
        xtrack_error = m.interpolated(path).xtrack_error if path else np.full(len(m), np.nan)
        return (*attitude(m), xtrack_error, *errors(m))

    return FieldSource("vehicle_attitude_setpoint", "command", columns, rank=rank)


# --- pressure and satellites --------------------------------------------------------------------------------------


def _baro(m: Any) -> tuple[Any, ...]:
    return (m.pressure * np.where(m.pressure < _MIN_PRESSURE_PA, 100.0, 1.0),)  # millibar until 1.13


def _fix(m: Any) -> Any:
    return m.fix_type >= _FIX_3D


# --- the table ----------------------------------------------------------------------------------------------------

TABLE: tuple[FieldSource, ...] = (
    FieldSource(
        "vehicle_attitude", "attitude", lambda m: (*euler(m.q), *m.interpolated("vehicle_angular_velocity").xyz), rank=3
    ),
    FieldSource(
        "vehicle_attitude",  # until 1.9
        "attitude",
        lambda m: (*euler(m.q), m.rollspeed, m.pitchspeed, m.yawspeed),
        rank=2,
    ),
    FieldSource(
        "vehicle_attitude", "attitude", lambda m: (*euler(m.q), *m.interpolated("sensor_combined").gyro_rad), rank=1
    ),
    FieldSource("sensor_combined", "imu", lambda m: (*m.accelerometer_m_s2, *m.gyro_rad), rank=2),
    FieldSource(
        "vehicle_acceleration", "imu", lambda m: (*m.xyz, *m.interpolated("vehicle_angular_velocity").xyz), rank=1
    ),
    FieldSource(
        "vehicle_global_position",
        "position",
        lambda m: _position(m.lat, m.lon, m.alt),
        rank=6,
        when=lambda m: _has_position(m.lat, m.lon),
    ),
    FieldSource(
        "vehicle_local_position",
        "position",
        _position_from_local,
        rank=5,
        when=lambda m: (m.xy_global != 0) & (m.z_global != 0) & _has_position(m.ref_lat, m.ref_lon),
    ),
    *(
        row
        for topic, rank in (("vehicle_gps_position", 3), ("sensor_gps", 1))
        for row in (
            FieldSource(
                topic,
                "position",
                lambda m: _position(m.latitude_deg, m.longitude_deg, m.altitude_msl_m),  # since 1.14
                rank=rank + 1,
                when=_fix,
            ),
            FieldSource(topic, "position", lambda m: (m.lat, m.lon, m.alt), rank=rank, when=_fix),
        )
    ),
    FieldSource(
        "vehicle_local_position",
        "velocity",
        lambda m: (m.vx, m.vy, m.vz),
        rank=3,
        when=lambda m: (m.v_xy_valid != 0) & (m.v_z_valid != 0),
    ),
    FieldSource("vehicle_global_position", "velocity", lambda m: (m.vel_n, m.vel_e, m.vel_d), rank=2),  # until 1.10
    FieldSource(
        "vehicle_gps_position",
        "velocity",
        lambda m: (m.vel_n_m_s, m.vel_e_m_s, m.vel_d_m_s),
        rank=1,
        when=lambda m: (m.vel_ned_valid != 0) & (m.fix_type >= _FIX_3D),
    ),
    *_air_rows(),
    FieldSource("actuator_outputs", "servo", _both_ports, rank=4, when=_are_pulses),
    FieldSource("actuator_outputs", "servo", _output, rank=3, when=_are_pulses),
    FieldSource("actuator_servos", "servo", lambda m: _pulse_widths(m, 1500.0, 500.0), rank=2, when=_is_driven),
    FieldSource("actuator_motors", "servo", lambda m: _pulse_widths(m, 1000.0, 1000.0), rank=1, when=_is_driven),
    *(_command_row(*wanted, len(_COMMAND_SOURCES) - i) for i, wanted in enumerate(_COMMAND_SOURCES)),
    FieldSource("mission_result", "leg", lambda m: (np.where(m.seq_current < 0, -1.0, m.seq_current),), rank=4),
    FieldSource("navigator_mission_item", "leg", lambda m: (m.sequence_current,), rank=3),
    FieldSource("mission", "leg", lambda m: (np.where(m.current_seq < 0, -1.0, m.current_seq),), rank=2),
    FieldSource(
        "offboard_mission", "leg", lambda m: (np.where(m.current_seq < 0, -1.0, m.current_seq),), rank=1
    ),  # 1.6
    *(
        FieldSource(
            topic,
            "wind",
            lambda m: (m.windspeed_north, m.windspeed_east),
            rank=rank,
            when=lambda m: (m.windspeed_north != 0) | (m.windspeed_east != 0),  # exactly zero: no estimate yet
        )
        for topic, rank in (("wind", 3), ("wind_estimate", 2), ("airspeed_wind", 1))
    ),
    FieldSource(
        "position_setpoint_triplet",
        "target",
        lambda m: _position(m.current.lat, m.current.lon, m.current.alt),
        when=lambda m: (m.current.valid != 0) & (m.current.type != _IDLE) & _has_position(m.current.lat, m.current.lon),
    ),
    FieldSource(
        "vehicle_air_data", "pressure", lambda m: (m.baro_pressure_pa,), rank=2, when=lambda m: m.baro_pressure_pa > 0
    ),
    FieldSource("sensor_baro", "pressure", _baro, rank=1, when=lambda m: m.pressure > 0),
    *(
        row
        for topic, rank in (("vehicle_gps_position", 3), ("sensor_gps", 1))
        for row in (
            FieldSource(
                topic, "gnss", lambda m: (np.rint(m.altitude_msl_m * 1e3),), rank=rank + 1, when=_fix
            ),  # since 1.14
            FieldSource(topic, "gnss", lambda m: (m.alt,), rank=rank, when=_fix),
        )
    ),
)

CALCULATED = {
    "actuator_servos": "servo: calculated as 1500 ± 500 us from actuator_servos, in PX4's order of surfaces",
    "actuator_motors": "servo: calculated as 1000 to 2000 us from actuator_motors, in PX4's order of motors",
}
"""Notes on fields that are calculated, not logged."""

LATCHED_TOPICS = (
    *("vehicle_status", "vtol_vehicle_status", "mission_result", "mission", "position_setpoint_triplet"),
    *("navigator_mission_item", "home_position"),
)
"""Topics published on change: the last value before the log start applies at the start."""

_AUXILIARY_TOPICS = (
    *("vehicle_angular_velocity", "actuator_controls_0", "actuator_controls_1", "vehicle_thrust_setpoint"),
    *("position_controller_status", "fw_pos_ctrl_status", "tecs_status", "vehicle_status", "vtol_vehicle_status"),
    "home_position",
)
TOPICS: frozenset[str] = frozenset({row.message for row in TABLE} | set(_AUXILIARY_TOPICS))

FIELDS = tuple(dict.fromkeys(row.field for row in TABLE))
ROWS: dict[str, tuple[FieldSource, ...]] = {
    field: tuple(sorted((row for row in TABLE if row.field == field), key=lambda row: -row.rank)) for field in FIELDS
}

# --- modes and vehicles -------------------------------------------------------------------------------------------

ARMED = 2  # vehicle_status.arming_state
MODES: dict[int, tuple[tuple[tuple[int, int], str], ...]] = {
    0: (((0, 0), "MANUAL"),),
    1: (((0, 0), "ALTCTL"),),
    2: (((0, 0), "POSCTL"),),
    3: (((0, 0), "MISSION"),),
    4: (((0, 0), "LOITER"),),
    5: (((0, 0), "RTL"),),
    6: (((0, 0), "RCRECOVER"), ((1, 15), "POSITION_SLOW")),
    7: (((0, 0), "RTGS"),),
    8: (((0, 0), "LANDENGFAIL"), ((1, 16), "ALTITUDE_CRUISE")),
    9: (((0, 0), "LANDGPSFAIL"),),
    10: (((0, 0), "ACRO"),),
    12: (((0, 0), "DESCEND"),),
    13: (((0, 0), "TERMINATION"),),
    14: (((0, 0), "OFFBOARD"),),
    15: (((0, 0), "STABILIZED"),),
    16: (((0, 0), "RATTITUDE"),),
    17: (((0, 0), "TAKEOFF"),),
    18: (((0, 0), "LAND"),),
    19: (((0, 0), "FOLLOWME"),),
    20: (((0, 0), "PRECLAND"),),
    21: (((0, 0), "ORBIT"),),
    22: (((0, 0), "VTOL_TAKEOFF"),),
    **{23 + i: (((0, 0), f"EXTERNAL{i + 1}"),) for i in range(8)},
}
"""vehicle_status.nav_state -> (first release, name), names as in the heartbeat, if it has one."""


def mode_name(nav_state: int, release: tuple[int, int]) -> str:
    """Return the mode name of a nav_state in `release` (major, minor)."""
    names = [name for since, name in MODES.get(nav_state, ()) if since <= release]
    return names[-1] if names else f"nav_state {nav_state}"


AUTOSTART: tuple[tuple[range, str], ...] = (
    (range(2_000, 4_000), "fixed_wing"),
    (range(4_000, 13_000), "multirotor"),
    (range(13_000, 14_000), "quadplane"),
    (range(14_000, 16_000), "multirotor"),
    (range(16_000, 17_000), "helicopter"),
    (range(17_000, 18_000), "fixed_wing"),
)
"""SYS_AUTOSTART -> vehicle type, if no other source has it. Source: PX4 ROMFS/px4fmu_common/init.d/airframes."""

VEHICLE_TYPE = {1: "multirotor", 2: "fixed_wing"}  # vehicle_status.vehicle_type, since 1.9
TRANSITIONS = {1: "transition to fixed wing", 2: "transition to multicopter", 3: "hovers", 4: "flies as a fixed wing"}
"""Texts for vtol_vehicle_status, keyed by `vehicle_vtol_state` since 1.13."""
