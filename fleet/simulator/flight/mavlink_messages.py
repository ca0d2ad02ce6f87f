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

AUTO = 10  # ArduPlane custom_mode
MISSION = 4 << 24 | 4 << 16  # PX4 custom_mode: sub mode MISSION of main mode AUTO
_ARMED = (
    mav.MAV_MODE_FLAG_SAFETY_ARMED
    | mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    | mav.MAV_MODE_FLAG_STABILIZE_ENABLED
    | mav.MAV_MODE_FLAG_GUIDED_ENABLED
)


class Flight(NamedTuple):
    """Telemetry values of one aircraft at one instant."""

    t: float  # since boot [s]
    now: Estimate
    place: tuple[int, int, int]  # estimated position [1e-7 deg, 1e-7 deg, mm above mean sea level]
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
    total: int  # number of mission items
    home: tuple[int, int, int]  # [1e-7 deg, 1e-7 deg, mm above mean sea level]
    wind: tuple[float, float]  # estimate of the autopilot, NED, direction it blows to [m/s]


def _boot_ms(t: float) -> int:
    return round(t * 1e3) & 0xFFFFFFFF


def _attitude(f: Flight) -> Any:
    return mav.MAVLink_attitude_message(_boot_ms(f.t), *map(float, f.now.euler), *map(float, f.now.rates))


def _imu(f: Flight) -> Any:
    fields = 0b111111  # accelerometers and gyros
    zeros = (0.0,) * 7
    return mav.MAVLink_highres_imu_message(
        round(f.t * 1e6), *map(float, f.now.force), *map(float, f.now.rates), *zeros, fields
    )


def _servos(f: Flight) -> Any:
    return mav.MAVLink_servo_output_raw_message(round(f.t * 1e6) & 0xFFFFFFFF, 0, *f.pulses, 0, 0, 0, 0)


def _position(f: Flight) -> Any:
    v = [round(float(x) * 100) for x in f.now.v]
    heading = round(degrees(f.now.euler[2]) * 100) % 36_000
    return mav.MAVLink_global_position_int_message(_boot_ms(f.t), *f.place, round(f.height * 1e3), *v, heading)


def _hud(f: Flight) -> Any:
    heading = int(degrees(f.now.euler[2])) % 360
    ground = hypot(f.now.v[0], f.now.v[1])
    return mav.MAVLink_vfr_hud_message(
        f.now.Va, ground, heading, round(f.delta_t * 100), f.place[2] * 1e-3, -float(f.now.v[2])
    )


def _nav(f: Flight) -> Any:
    bearing = round(degrees(atan2(f.target[1], f.target[0])))
    distance = min(round(hypot(*f.target)), 65_535)
    Va_error = f.Va_error * 100  # ArduPlane sends centimetres per second here, unlike the dialect documentation
    return mav.MAVLink_nav_controller_output_message(
        degrees(f.phi_c), degrees(f.theta_c), bearing, bearing, distance, f.alt_error, Va_error, f.xtrack_error
    )


def _mission_current(f: Flight) -> Any:
    return mav.MAVLink_mission_current_message(f.seq, f.total, mav.MISSION_STATE_ACTIVE, 1)


def _heartbeat(f: Flight) -> Any:
    del f
    return mav.MAVLink_heartbeat_message(
        mav.MAV_TYPE_FIXED_WING, mav.MAV_AUTOPILOT_ARDUPILOTMEGA, _ARMED, AUTO, mav.MAV_STATE_ACTIVE, 3
    )


def _sys_status(f: Flight) -> Any:
    present = mav.MAV_SYS_STATUS_SENSOR_3D_GYRO | mav.MAV_SYS_STATUS_SENSOR_3D_ACCEL | mav.MAV_SYS_STATUS_AHRS
    volts = round(48_000 - 2_000 * f.delta_t)
    return mav.MAVLink_sys_status_message(
        present, present, present, 250, volts, round(2_000 * f.delta_t), 80, 0, 0, 0, 0, 0, 0
    )


def _heartbeat_px4(f: Flight) -> Any:
    del f
    mode = _ARMED | mav.MAV_MODE_FLAG_AUTO_ENABLED
    return mav.MAVLink_heartbeat_message(
        mav.MAV_TYPE_FIXED_WING, mav.MAV_AUTOPILOT_PX4, mode, MISSION, mav.MAV_STATE_ACTIVE, 3
    )


def _attitude_target(f: Flight) -> Any:
    (cf, ct, cp), (sf, st, sp) = ([wave(a / 2) for a in (f.phi_c, f.theta_c, f.now.euler[2])] for wave in (cos, sin))
    q = [
        cf * ct * cp + sf * st * sp,
        sf * ct * cp - cf * st * sp,
        cf * st * cp + sf * ct * sp,
        cf * ct * sp - sf * st * cp,
    ]
    return mav.MAVLink_attitude_target_message(_boot_ms(f.t), 0, q, 0.0, 0.0, 0.0, f.delta_t)


def _home(f: Flight) -> Any:
    nowhere = [nan] * 4
    return mav.MAVLink_home_position_message(*f.home, 0.0, 0.0, 0.0, nowhere, nan, nan, nan, round(f.t * 1e6))


def _wind_cov(f: Flight) -> Any:
    altitude = f.place[2] * 1e-3
    return mav.MAVLink_wind_cov_message(round(f.t * 1e6), *f.wind, 0.0, 0.2, 0.0, altitude, 0.4, 0.0)


def _local(f: Flight) -> Any:
    return mav.MAVLink_local_position_ned_message(_boot_ms(f.t), *map(float, f.now.p), *map(float, f.now.v))


def _pressure(f: Flight) -> Any:
    felt = 0.5 * SEA_LEVEL_RHO * f.now.Va**2  # [Pa]
    warmth = round((f.now.warmth - 273.15) * 100)
    return mav.MAVLink_scaled_pressure_message(_boot_ms(f.t), f.now.pressure * 0.01, felt * 0.01, warmth)


def _satellites(f: Flight) -> Any:
    height = f.home[2] + round(f.now.satellites * 1e3)
    ground, course = hypot(f.now.v[0], f.now.v[1]), round(degrees(atan2(f.now.v[1], f.now.v[0])) * 100) % 36_000
    return mav.MAVLink_gps_raw_int_message(
        round(f.t * 1e6), mav.GPS_FIX_TYPE_3D_FIX, *f.place[:2], height, 80, 120, round(ground * 100), course, 14
    )


Table = tuple[tuple[float, int, Callable[[Flight], Any]], ...]
"""Rate [Hz], phase [ticks], message function."""

_COMMON: Table = (
    (25, 0, _attitude),
    (25, 2, _imu),
    (20, 1, _servos),
    (10, 0, _position),
    (10, 5, _hud),
)
TELEMETRY: Table = (
    *_COMMON,
    (5, 7, _nav),
    (1, 11, _mission_current),
    (1, 23, _heartbeat),
    (1, 37, _sys_status),
)
TELEMETRY_PX4: Table = (
    *_COMMON,
    (10, 7, _attitude_target),
    (1, 11, _mission_current),
    (1, 23, _heartbeat_px4),
    (1, 37, _sys_status),
    (1, 43, _wind_cov),
    (0.5, 53, _home),
)
_RECORDED: Table = (  # onboard log, without the bandwidth limit of a radio
    (25, 0, _attitude),
    (25, 2, _imu),
    (25, 1, _servos),
    (10, 0, _position),
    (10, 2, _local),
    (10, 5, _hud),
    (10, 6, _pressure),
    (5, 8, _satellites),
    (5, 7, _nav),
    (1, 11, _mission_current),
    (1, 23, _heartbeat),
)
_WHOLE = ("PWM_MAIN_", "CA_SV_CS", "FW_ARSP_SCALE_EN", "NPFG_LB_PERIOD")  # prefixes of integer parameters of PX4


class Dialect(NamedTuple):
    """MAVLink behaviour of one autopilot."""

    telemetry: Table
    version: int  # encoded as in AUTOPILOT_VERSION
    whole: tuple[str, ...]  # name prefixes of integers, sent as raw bytes


DIALECTS = {
    "ardupilot": Dialect(TELEMETRY, 0x040600FF, ()),  # 4.6.0, official release
    "px4": Dialect(TELEMETRY_PX4, 0x011000FF, _WHOLE),  # 1.16.0
}


RECORDED = Dialect(_RECORDED, 0x040600FF, ())


def value_message(name: str, value: float, counts: tuple[int, int], dialect: Dialect) -> Any:
    """Create PARAM_VALUE; counts: number of parameters and index of this one."""
    if dialect.whole and name.startswith(dialect.whole):
        (bits,) = struct.unpack("<f", struct.pack("<i", round(value)))
        return mav.MAVLink_param_value_message(name.encode(), bits, mav.MAV_PARAM_TYPE_INT32, *counts)
    return mav.MAVLink_param_value_message(name.encode(), value, mav.MAV_PARAM_TYPE_REAL32, *counts)
