"""MAVLink interface of a simulated multirotor: telemetry messages and their rates, for ArduCopter and PX4.

Source: MAVLink common and ardupilotmega dialects; streams of ArduCopter 4.7 as recorded; PX4 MAVLink documentation.
"""

from math import atan2, degrees, hypot
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.simulator.flight.mavlink import MavlinkEndpoint
from fleet.simulator.flight.mavlink_messages import (
    COMMON,
    ONBOARD_SENSORS,
    PX4_AUTO,
    PX4_MODES,
    MavlinkDialect,
    MessageSchedule,
    home_position,
    quaternion,
)
from fleet.simulator.vehicle.sensors import Estimate

COPTER_MODES = {"STABILIZE": 0, "AUTO": 3, "GUIDED": 4, "LOITER": 5, "RTL": 6, "LAND": 9, "BRAKE": 17}
FULL_CURRENT = 60.0  # of the battery at full power [A]
_CELLS_MV = 12_600  # of a full battery [mV]
_ENABLED = (
    mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mav.MAV_MODE_FLAG_STABILIZE_ENABLED | mav.MAV_MODE_FLAG_GUIDED_ENABLED
)


class MultirotorState(NamedTuple):
    """Telemetry values of one aircraft at one instant; the first ones as those of a fixed wing."""

    t: float  # since boot [s]
    estimate: Estimate
    position: tuple[int, int, int]  # estimated position [1e-7 deg, 1e-7 deg, mm above mean sea level]
    height: float  # above home [m]
    pulses: tuple[int, int, int, int]  # motors 1..4 [us]
    delta_t: float  # throttle [-]
    command: tuple[float, float, float]  # commanded roll, pitch, heading [rad]
    reference: tuple[tuple[float, ...], ...]  # commanded position, velocity, acceleration, NED [m, m/s, m/s2]
    target: tuple[float, float]  # horizontal, from the aircraft to the waypoint, NED [m]
    seq: int
    n_items: int
    home: tuple[int, int, int]  # [1e-7 deg, 1e-7 deg, mm above mean sea level]
    mode: str
    armed: bool
    landed: bool
    load: float  # power over full power [-]
    charge: float  # remaining battery charge [-]


def _ms(t: float) -> int:
    return round(t * 1e3) & 0xFFFFFFFF


def _heartbeat_of(autopilot: int, mode: int, base_mode: int, f: MultirotorState) -> Any:
    base_mode |= mav.MAV_MODE_FLAG_SAFETY_ARMED if f.armed else 0
    status = mav.MAV_STATE_STANDBY if f.landed else mav.MAV_STATE_ACTIVE
    return mav.MAVLink_heartbeat_message(mav.MAV_TYPE_QUADROTOR, autopilot, base_mode, mode, status, 3)


def _heartbeat(f: MultirotorState) -> Any:
    return _heartbeat_of(mav.MAV_AUTOPILOT_ARDUPILOTMEGA, COPTER_MODES[f.mode], _ENABLED, f)


def _heartbeat_px4(f: MultirotorState) -> Any:
    mode = PX4_MODES[f.mode] << 24 | PX4_AUTO << 16
    return _heartbeat_of(mav.MAV_AUTOPILOT_PX4, mode, _ENABLED | mav.MAV_MODE_FLAG_AUTO_ENABLED, f)


def _nav(f: MultirotorState) -> Any:
    bearing, alt_error = round(degrees(atan2(f.target[1], f.target[0]))), f.estimate.p[2] - f.reference[0][2]
    distance = min(round(hypot(*f.target)), 65_535)
    return mav.MAVLink_nav_controller_output_message(
        degrees(f.command[0]), degrees(f.command[1]), bearing, bearing, distance, float(alt_error), 0.0, 0.0
    )


def _local(f: MultirotorState) -> Any:
    return mav.MAVLink_local_position_ned_message(_ms(f.t), *map(float, f.estimate.p), *map(float, f.estimate.v))


def _mission_current(f: MultirotorState) -> Any:
    return mav.MAVLink_mission_current_message(f.seq, f.n_items, mav.MISSION_STATE_ACTIVE, 1)


def _sys_status(f: MultirotorState) -> Any:
    present = mav.MAV_SYS_STATUS_SENSOR_3D_GYRO | mav.MAV_SYS_STATUS_SENSOR_3D_ACCEL | mav.MAV_SYS_STATUS_AHRS
    volts = round(_CELLS_MV * (0.86 + 0.14 * f.charge - 0.08 * f.load))
    rest = (round(100 * FULL_CURRENT * f.load), round(100 * f.charge), 0, 0, 0, 0, 0, 0)
    return mav.MAVLink_sys_status_message(present, present, present, 250, volts, *rest)


def _landed(f: MultirotorState) -> Any:
    state = mav.MAV_LANDED_STATE_ON_GROUND if f.landed else mav.MAV_LANDED_STATE_IN_AIR
    return mav.MAVLink_extended_sys_state_message(0, state)


def _attitude_target(f: MultirotorState) -> Any:
    return mav.MAVLink_attitude_target_message(_ms(f.t), 0, quaternion(*f.command), 0.0, 0.0, 0.0, f.delta_t)


def _local_target(f: MultirotorState) -> Any:
    values = [float(x) for part in f.reference for x in part]
    frame = mav.MAV_FRAME_LOCAL_NED
    return mav.MAVLink_position_target_local_ned_message(_ms(f.t), frame, 0, *values, f.command[2], 0.0)


_SHARED: MessageSchedule = (
    *COMMON,
    (10, 3, _local),
    (1, 11, _mission_current),
    (1, 37, _sys_status),
    (0.2, 53, home_position),
)
DIALECTS = {
    "ardupilot": MavlinkDialect((*_SHARED, (5, 7, _nav), (1, 23, _heartbeat)), 0x040600FF, ()),
    "px4": MavlinkDialect(
        (
            *_SHARED,
            *((10, 7, _attitude_target), (10, 8, _local_target), (1, 23, _heartbeat_px4), (1, 29, _landed)),
        ),
        0x011000FF,
        ("PWM_MAIN_", "CA_ROTOR_COUNT", "CA_AIRFRAME", "MPC_POS_MODE", "MPC_YAW_MODE"),
        is_px4=True,
    ),
}

ONBOARD_DIALECTS = {  # onboard log, without the bandwidth limit of a radio
    name: dialect._replace(telemetry=(*ONBOARD_SENSORS, *(row for row in dialect.telemetry if row not in COMMON)))
    for name, dialect in DIALECTS.items()
}


class MultirotorEndpoint(MavlinkEndpoint):
    """One MAVLink system with the flight modes of a multirotor."""

    def item_changed(self, state: MultirotorState) -> list[bytes]:
        """Return what the autopilot sends at once when the current mission item changes: PX4 the item."""
        return [self._pack(_mission_current(state))] if self._dialect.is_px4 else []

    def _mode_name(self, custom_mode: int) -> str | None:
        if self._dialect.is_px4:
            return super()._mode_name(custom_mode)
        return {number: name for name, number in COPTER_MODES.items() if name != "STABILIZE"}.get(custom_mode)

    def _speed_limits(self) -> tuple[float, float]:
        return 0.0, float("inf")
