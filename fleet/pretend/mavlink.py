"""The voice of a pretend aircraft: MAVLink 2 as ArduPlane speaks it, telemetry out, questions in, answers out.

Degrees, centimetres and whole percent begin and end in this file.
Source: MAVLink common and ardupilotmega dialects; rates as an ArduPlane telemetry link streams them.
"""

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from math import atan2, degrees, hypot
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.contract import Item
from fleet.pretend.sensors import Estimate

TICK_HZ = 100
COMPONENT = mav.MAV_COMP_ID_AUTOPILOT1
AUTO = 10  # ArduPlane custom_mode
MOST_AIRCRAFT = 250  # system ids 1..250 belong to vehicles
_ARMED = (
    mav.MAV_MODE_FLAG_SAFETY_ARMED
    | mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    | mav.MAV_MODE_FLAG_STABILIZE_ENABLED
    | mav.MAV_MODE_FLAG_GUIDED_ENABLED
)
_CAPABILITIES = (
    mav.MAV_PROTOCOL_CAPABILITY_MISSION_FLOAT
    | mav.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | mav.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    | mav.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mav.MAV_PROTOCOL_CAPABILITY_MAVLINK2
)
_VERSION = 0x040600FF  # 4.6.0, official release
_ANSWERS_PER_TICK = 2  # parameters are streamed, not thrown


class Flight(NamedTuple):
    """What one aircraft has to tell at one instant."""

    t: float  # since boot [s]
    now: Estimate
    place: tuple[int, int, int]  # believed position [1e-7 deg, 1e-7 deg, mm above mean sea level]
    height: float  # above home [m]
    pulses: tuple[int, int, int, int]  # servos 1..4 [us]
    delta_t: float  # [-]
    phi_c: float  # [rad]
    theta_c: float  # [rad]
    target: tuple[float, float]  # horizontal, from the aircraft to the waypoint, NED [m]
    alt_error: float  # [m]
    Va_error: float  # [m/s]
    xtrack_error: float  # [m]
    seq: int  # mission item in force
    total: int  # items in the mission


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
    Va_error = f.Va_error * 100  # ArduPlane sends centimetres per second here, against the dialect's text
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


TELEMETRY: tuple[tuple[int, int, Callable[[Flight], Any]], ...] = (
    # rate [Hz], phase [ticks], maker
    (25, 0, _attitude),
    (25, 2, _imu),
    (20, 1, _servos),
    (10, 0, _position),
    (10, 5, _hud),
    (5, 7, _nav),
    (1, 11, _mission_current),
    (1, 23, _heartbeat),
    (1, 37, _sys_status),
)


class Voice:
    """One MAVLink system: counts its frames, knows its mission and parameters, answers."""

    def __init__(self, system: int, items: tuple[Item, ...], params: Mapping[str, float]):
        """Speak as `system`.

        Args:
            system: MAVLink system id, 1..250
            items: the mission on board
            params: parameters in ArduPilot's names and units
        """
        self._out = mav.MAVLink(None, srcSystem=system, srcComponent=COMPONENT)
        self._in = mav.MAVLink(None)
        self._in.robust_parsing = True
        self._items = items
        self._names = sorted(params)
        self._params = params
        self._waiting: deque[int] = deque()  # parameters still to be streamed

    def _frame(self, message: Any) -> bytes:
        packed = bytes(message.pack(self._out))
        self._out.seq = (self._out.seq + 1) % 256
        return packed

    def telemetry(self, tick: int, flight: Callable[[], Flight]) -> list[bytes]:
        """Give the frames due at this tick of 10 ms; `flight` is asked only when one is."""
        due = [make for rate, phase, make in TELEMETRY if (tick - phase) % (TICK_HZ // rate) == 0]
        now = flight() if due else None
        frames = [self._frame(make(now)) for make in due if now is not None]
        return frames + self.stream(_ANSWERS_PER_TICK)

    def stream(self, most: int) -> list[bytes]:
        """Give up to `most` of the parameters that were asked for."""
        count = min(most, len(self._waiting))
        return [self._frame(self._param(self._waiting.popleft())) for _ in range(count)]

    def hear(self, data: bytes, t: float) -> list[bytes]:
        """Listen to bytes from the ground at `t` since boot [s] and give the answers; noise is passed over."""
        try:
            messages: Iterable[Any] = self._in.parse_buffer(data) or ()
        except (mav.MAVError, ValueError):  # a wrong checksum, or text that is no text
            return []
        answers: list[Any] = []
        for message in messages:
            answer = _ANSWERS.get(message.get_type())
            if answer is not None and getattr(message, "target_system", 0) in (0, self._out.srcSystem):
                answers += answer(self, message, t)
        return [self._frame(answer) for answer in answers]

    def _param(self, index: int, asked_by_name: bool = False) -> Any:
        name = self._names[index]
        shown = 65_535 if asked_by_name else index
        kind = mav.MAV_PARAM_TYPE_REAL32
        return mav.MAVLink_param_value_message(name.encode(), self._params[name], kind, len(self._names), shown)

    def _param_list(self, message: Any, t: float) -> list[Any]:
        del message, t
        self._waiting = deque(range(len(self._names)))
        return []

    def _param_read(self, message: Any, t: float) -> list[Any]:
        del t
        if message.param_index >= 0:
            return [self._param(message.param_index)] if message.param_index < len(self._names) else []
        name = message.param_id
        return [self._param(self._names.index(name), asked_by_name=True)] if name in self._params else []

    def _mission_list(self, message: Any, t: float) -> list[Any]:
        del t
        count = len(self._items) if message.mission_type == 0 else 0  # no fence, no rally points
        return [mav.MAVLink_mission_count_message(*_sender(message), count, message.mission_type)]

    def _mission_item(self, message: Any, t: float) -> list[Any]:
        del t
        if message.mission_type != 0 or message.seq >= len(self._items):
            kind = mav.MAV_MISSION_INVALID_SEQUENCE
            return [mav.MAVLink_mission_ack_message(*_sender(message), kind, message.mission_type)]
        i = self._items[message.seq]
        head = (*_sender(message), i.seq, i.frame, i.command, 0, 1, i.param1, i.param2, i.param3, i.param4)
        if message.get_type() == "MISSION_REQUEST_INT":
            return [mav.MAVLink_mission_item_int_message(*head, i.lat_e7, i.lon_e7, i.alt_m)]
        return [mav.MAVLink_mission_item_message(*head, i.lat_e7 * 1e-7, i.lon_e7 * 1e-7, i.alt_m)]

    def _command(self, message: Any, t: float) -> list[Any]:
        del t
        wanted = mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION
        asks_version = message.command == mav.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES or (
            message.command == mav.MAV_CMD_REQUEST_MESSAGE and message.param1 == wanted  # which may be no number
        )
        fine = asks_version or message.command == mav.MAV_CMD_SET_MESSAGE_INTERVAL  # the rates are as they should be
        result = mav.MAV_RESULT_ACCEPTED if fine else mav.MAV_RESULT_UNSUPPORTED
        ack = mav.MAVLink_command_ack_message(message.command, result, 0, 0, *_sender(message))
        return [ack, self._version()] if asks_version else [ack]

    def _version(self) -> Any:
        none = [0] * 8
        uid = self._out.srcSystem
        return mav.MAVLink_autopilot_version_message(_CAPABILITIES, _VERSION, 0, 0, 0, none, none, none, 0, 0, uid)

    def _timesync(self, message: Any, t: float) -> list[Any]:
        return [mav.MAVLink_timesync_message(round(t * 1e9), message.ts1)] if message.tc1 == 0 else []


def _sender(message: Any) -> tuple[int, int]:
    return message.get_srcSystem(), message.get_srcComponent()


_ANSWERS: dict[str, Callable[[Voice, Any, float], list[Any]]] = {
    "PARAM_REQUEST_LIST": Voice._param_list,
    "PARAM_REQUEST_READ": Voice._param_read,
    "MISSION_REQUEST_LIST": Voice._mission_list,
    "MISSION_REQUEST_INT": Voice._mission_item,
    "MISSION_REQUEST": Voice._mission_item,
    "COMMAND_LONG": Voice._command,
    "TIMESYNC": Voice._timesync,
}


class Ground:
    """The few questions a recording begins with, so that it holds mission and parameters by itself."""

    def __init__(self, system: int):
        """Speak to `system` as a ground station."""
        self._mav = mav.MAVLink(None, srcSystem=255, srcComponent=mav.MAV_COMP_ID_MISSIONPLANNER)
        self._to = (system, COMPONENT)

    def questions(self, items: int) -> list[bytes]:
        """Ask for the version, every mission item and the parameter list, in this order."""
        version = (mav.MAV_CMD_REQUEST_MESSAGE, 0, mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION, 0, 0, 0, 0, 0, 0)
        asked = [
            mav.MAVLink_command_long_message(*self._to, *version),
            mav.MAVLink_mission_request_list_message(*self._to),
            *(mav.MAVLink_mission_request_int_message(*self._to, seq) for seq in range(items)),
            mav.MAVLink_param_request_list_message(*self._to),
        ]
        return [bytes(message.pack(self._mav)) for message in asked]
