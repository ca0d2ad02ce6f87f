"""Telemetry messages of a simulated aircraft and their rates, for ArduPlane and PX4.

Only this file and `mavlink` use degrees, centimetres and integer percent.
Source: MAVLink common and ardupilotmega dialects; PX4 src/modules/mavlink for its streams.
"""

import struct
from collections.abc import Callable
from math import atan2, cos, degrees, hypot, nan, sin
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.simulator.vehicle.sensors import SEA_LEVEL_RHO, Estimate

ARDUPLANE_MODES = {"CIRCLE": 1, "FBWA": 5, "FBWB": 6, "CRUISE": 7, "AUTO": 10, "RTL": 11, "LOITER": 12, "GUIDED": 15}
PX4_MODES = {"LOITER": 3, "MISSION": 4, "RTL": 5, "LAND": 6}  # sub modes of main mode AUTO
PX4_AUTO = 4  # main mode
_ARMED = (
    mav.MAV_MODE_FLAG_SAFETY_ARMED
    | mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    | mav.MAV_MODE_FLAG_STABILIZE_ENABLED
    | mav.MAV_MODE_FLAG_GUIDED_ENABLED
)


class TelemetryState(NamedTuple):
    """Telemetry values of one aircraft at one instant."""

    t: float  # since boot [s]
    estimate: Estimate
    position: tuple[int, int, int]  # estimated position [1e-7 deg, 1e-7 deg, mm above mean sea level]
    height: float  # above home [m]
    pulses: tuple[int, int, int, int]  # servos 1..4 [us]
    delta_t: float  # [-]
    phi_c: float  # [rad]
    theta_c: float  # [rad]
    target: tuple[float, float]  # horizontal, from the aircraft to the waypoint, NED [m]
    alt_error: float  # [m]
    Va_error: float  # [m/s]
    xtrack_error: float  # [m]
    seq: int  # current mission item
    n_items: int  # number of mission items
    home: tuple[int, int, int]  # [1e-7 deg, 1e-7 deg, mm above mean sea level]
    wind: tuple[float, float]  # estimate of the autopilot, NED, direction it blows to [m/s]
    mode: str  # flight mode, a name in the tables of the autopilot
    destination: tuple[int, int, int] | None  # of a mode without mission [1e-7 deg, 1e-7 deg, mm above mean sea level]


def _boot_ms(t: float) -> int:
    return round(t * 1e3) & 0xFFFFFFFF


def _attitude(f: TelemetryState) -> Any:
    return mav.MAVLink_attitude_message(_boot_ms(f.t), *map(float, f.estimate.euler), *map(float, f.estimate.rates))


def _imu(f: TelemetryState) -> Any:
    fields = 0b111111  # accelerometers and gyros
    zeros = (0.0,) * 7
    return mav.MAVLink_highres_imu_message(
        round(f.t * 1e6), *map(float, f.estimate.force), *map(float, f.estimate.rates), *zeros, fields
    )


def _servos(f: TelemetryState) -> Any:
    return mav.MAVLink_servo_output_raw_message(round(f.t * 1e6) & 0xFFFFFFFF, 0, *f.pulses, 0, 0, 0, 0)


def _position(f: TelemetryState) -> Any:
    v = [round(float(x) * 100) for x in f.estimate.v]
    heading = round(degrees(f.estimate.euler[2]) * 100) % 36_000
    return mav.MAVLink_global_position_int_message(_boot_ms(f.t), *f.position, round(f.height * 1e3), *v, heading)


def _hud(f: TelemetryState) -> Any:
    heading = int(degrees(f.estimate.euler[2])) % 360
    ground_speed = hypot(f.estimate.v[0], f.estimate.v[1])
    return mav.MAVLink_vfr_hud_message(
        f.estimate.Va, ground_speed, heading, round(f.delta_t * 100), f.position[2] * 1e-3, -float(f.estimate.v[2])
    )


def _nav(f: TelemetryState) -> Any:
    bearing = round(degrees(atan2(f.target[1], f.target[0])))
    distance = min(round(hypot(*f.target)), 65_535)
    Va_error = f.Va_error * 100  # ArduPlane sends centimetres per second here, unlike the dialect documentation
    return mav.MAVLink_nav_controller_output_message(
        degrees(f.phi_c), degrees(f.theta_c), bearing, bearing, distance, f.alt_error, Va_error, f.xtrack_error
    )


def _mission_current(f: TelemetryState) -> Any:
    return mav.MAVLink_mission_current_message(f.seq, f.n_items, mav.MISSION_STATE_ACTIVE, 1)


def _heartbeat(f: TelemetryState) -> Any:
    return mav.MAVLink_heartbeat_message(
        mav.MAV_TYPE_FIXED_WING,
        mav.MAV_AUTOPILOT_ARDUPILOTMEGA,
        _ARMED,
        ARDUPLANE_MODES[f.mode],
        mav.MAV_STATE_ACTIVE,
        3,
    )


def _destination(f: TelemetryState) -> Any:
    """Create POSITION_TARGET_GLOBAL_INT in a mode without mission that flies to a point; None in other modes."""
    if f.destination is None:
        return None
    lat, lon, alt = f.destination
    only_position = 0b0000111111111000  # ignores velocity, acceleration and yaw
    zeros = (0.0,) * 8
    return mav.MAVLink_position_target_global_int_message(
        _boot_ms(f.t), mav.MAV_FRAME_GLOBAL_INT, only_position, lat, lon, alt * 1e-3, *zeros
    )


def _sys_status(f: TelemetryState) -> Any:
    present = mav.MAV_SYS_STATUS_SENSOR_3D_GYRO | mav.MAV_SYS_STATUS_SENSOR_3D_ACCEL | mav.MAV_SYS_STATUS_AHRS
    volts = round(48_000 - 2_000 * f.delta_t)
    return mav.MAVLink_sys_status_message(
        present, present, present, 250, volts, round(2_000 * f.delta_t), 80, 0, 0, 0, 0, 0, 0
    )


def _heartbeat_px4(f: TelemetryState) -> Any:
    base_mode, mode = _ARMED | mav.MAV_MODE_FLAG_AUTO_ENABLED, PX4_MODES[f.mode] << 24 | PX4_AUTO << 16
    return mav.MAVLink_heartbeat_message(
        mav.MAV_TYPE_FIXED_WING, mav.MAV_AUTOPILOT_PX4, base_mode, mode, mav.MAV_STATE_ACTIVE, 3
    )


def quaternion(phi: float, theta: float, psi: float) -> list[float]:
    """Return the quaternion of an attitude [rad], scalar first. Source: Beard & McLain 2012, appendix B."""
    (cf, ct, cp), (sf, st, sp) = ([wave(a / 2) for a in (phi, theta, psi)] for wave in (cos, sin))
    return [
        cf * ct * cp + sf * st * sp,
        sf * ct * cp - cf * st * sp,
        cf * st * cp + sf * ct * sp,
        cf * ct * sp - sf * st * cp,
    ]


def _attitude_target(f: TelemetryState) -> Any:
    q = quaternion(f.phi_c, f.theta_c, f.estimate.euler[2])
    return mav.MAVLink_attitude_target_message(_boot_ms(f.t), 0, q, 0.0, 0.0, 0.0, f.delta_t)


def home_position(f: Any) -> Any:
    """Return HOME_POSITION of a state with `home` and `t`."""
    unset = [nan] * 4
    return mav.MAVLink_home_position_message(*f.home, 0.0, 0.0, 0.0, unset, nan, nan, nan, round(f.t * 1e6))


def _wind_cov(f: TelemetryState) -> Any:
    altitude = f.position[2] * 1e-3
    return mav.MAVLink_wind_cov_message(round(f.t * 1e6), *f.wind, 0.0, 0.2, 0.0, altitude, 0.4, 0.0)


def _local(f: TelemetryState) -> Any:
    return mav.MAVLink_local_position_ned_message(_boot_ms(f.t), *map(float, f.estimate.p), *map(float, f.estimate.v))


def _pressure(f: TelemetryState) -> Any:
    dynamic_pressure = 0.5 * SEA_LEVEL_RHO * f.estimate.Va**2  # [Pa]
    temperature = round((f.estimate.board_temperature - 273.15) * 100)
    return mav.MAVLink_scaled_pressure_message(
        _boot_ms(f.t), f.estimate.pressure * 0.01, dynamic_pressure * 0.01, temperature
    )


def _gps_raw(f: TelemetryState) -> Any:
    height = f.home[2] + round(f.estimate.gps_height * 1e3)
    ground_speed = round(hypot(f.estimate.v[0], f.estimate.v[1]) * 100)
    course = round(degrees(atan2(f.estimate.v[1], f.estimate.v[0])) * 100) % 36_000
    fix = (mav.GPS_FIX_TYPE_3D_FIX, *f.position[:2], height)
    return mav.MAVLink_gps_raw_int_message(round(f.t * 1e6), *fix, 80, 120, ground_speed, course, 14)


MessageSchedule = tuple[tuple[float, int, Callable[[Any], Any]], ...]
"""Rate [Hz], phase [ticks], message function of the telemetry state of the vehicle class."""

COMMON: MessageSchedule = (
    (25, 0, _attitude),
    (25, 2, _imu),
    (20, 1, _servos),
    (10, 0, _position),
    (10, 5, _hud),
)
TELEMETRY: MessageSchedule = (
    *COMMON,
    (5, 7, _nav),
    (1, 11, _mission_current),
    (1, 23, _heartbeat),
    (1, 37, _sys_status),
    (2, 41, _destination),
)
TELEMETRY_PX4: MessageSchedule = (
    *COMMON,
    (10, 7, _attitude_target),
    (1, 11, _mission_current),
    (1, 23, _heartbeat_px4),
    (1, 37, _sys_status),
    (1, 41, _destination),
    (1, 43, _wind_cov),
    (0.5, 53, home_position),
)
TELEMETRY_ONBOARD: MessageSchedule = (  # onboard log, without the bandwidth limit of a radio
    (25, 0, _attitude),
    (25, 2, _imu),
    (25, 1, _servos),
    (10, 0, _position),
    (10, 2, _local),
    (10, 5, _hud),
    (10, 6, _pressure),
    (5, 8, _gps_raw),
    (5, 7, _nav),
    (1, 11, _mission_current),
    (1, 23, _heartbeat),
)
ONBOARD_SENSORS: MessageSchedule = (  # of a multirotor, whose motors answer faster than servos
    (50, 0, _attitude),
    (50, 0, _imu),
    (50, 0, _servos),
    (10, 0, _position),
    (10, 5, _hud),
    (10, 6, _pressure),
    (5, 8, _gps_raw),
)
_INTEGER_PARAMS = ("PWM_MAIN_", "CA_SV_CS", "FW_ARSP_SCALE_EN", "NPFG_LB_PERIOD")  # PX4, name prefixes


class MavlinkDialect(NamedTuple):
    """MAVLink behaviour of one autopilot."""

    telemetry: MessageSchedule
    version: int  # encoded as in AUTOPILOT_VERSION
    integer_params: tuple[str, ...]  # name prefixes of integers, sent as raw bytes
    is_px4: bool = False


DIALECTS = {
    "ardupilot": MavlinkDialect(TELEMETRY, 0x040600FF, ()),  # 4.6.0, official release
    "px4": MavlinkDialect(TELEMETRY_PX4, 0x011000FF, _INTEGER_PARAMS, is_px4=True),  # 1.16.0
}
ONBOARD_DIALECT = MavlinkDialect(TELEMETRY_ONBOARD, 0x040600FF, ())


def param_value_message(name: str, value: float, counts: tuple[int, int], dialect: MavlinkDialect) -> Any:
    """Create PARAM_VALUE; counts: number of parameters and index of this one."""
    if dialect.integer_params and name.startswith(dialect.integer_params):
        (bits_as_float,) = struct.unpack("<f", struct.pack("<i", round(value)))
        return mav.MAVLink_param_value_message(name.encode(), bits_as_float, mav.MAV_PARAM_TYPE_INT32, *counts)
    return mav.MAVLink_param_value_message(name.encode(), value, mav.MAV_PARAM_TYPE_REAL32, *counts)
