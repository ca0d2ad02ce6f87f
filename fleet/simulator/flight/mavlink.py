"""MAVLink 2 interface of a simulated aircraft (ArduPlane or PX4): telemetry, replies to requests, received commands.

`mavlink_messages` defines the telemetry streams.
Source: MAVLink common and ardupilotmega dialects.
"""

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from math import isfinite, lcm
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.contract import Item
from fleet.simulator.flight.mavlink_messages import (
    ARDUPLANE_MODES,
    DIALECTS,
    PX4_AUTO,
    PX4_MODES,
    MavlinkDialect,
    TelemetryState,
    param_value_message,
)
from fleet.simulator.flight.mission_server import MissionServer, UploadedMission

TICK_HZ = 100
COMPONENT = mav.MAV_COMP_ID_AUTOPILOT1
MAX_AIRCRAFT = 250  # system ids 1..250 belong to vehicles
_CAPABILITIES = (
    mav.MAV_PROTOCOL_CAPABILITY_MISSION_FLOAT
    | mav.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | mav.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    | mav.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mav.MAV_PROTOCOL_CAPABILITY_MAVLINK2
)
_RELATIVE_FRAMES = (mav.MAV_FRAME_GLOBAL_RELATIVE_ALT, mav.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT)
_PARAMS_PER_TICK = 2  # rate limit of the parameter stream


class ModeRequest(NamedTuple):
    """A commanded mode, and the point to fly to: latitude, longitude, height above home [1e-7 deg, 1e-7 deg, m]."""

    mode: str
    target: tuple[int, int, float] | None = None


class SpeedRequest(NamedTuple):
    """A commanded speed, airspeed of a fixed wing and ground speed of a multirotor; 0: the default [m/s]."""

    speed: float


class ItemRequest(NamedTuple):
    """A commanded mission item."""

    seq: int


class MavlinkEndpoint:
    """One MAVLink system with mission and parameters, which sends telemetry and replies to requests."""

    def __init__(
        self,
        system: int,
        items: tuple[Item, ...],
        params: Mapping[str, float],
        dialect: MavlinkDialect = DIALECTS["ardupilot"],
    ):
        """Create a MAVLink system.

        Args:
            system: MAVLink system id, 1..250
            items: the mission on board
            params: parameters in the names and units of the autopilot
            dialect: message set of the autopilot
        """
        self._out = mav.MAVLink(None, srcSystem=system, srcComponent=COMPONENT)
        self._in = mav.MAVLink(None)
        self._in.robust_parsing = True
        self.missions = MissionServer(items, dialect.is_px4)
        self._poll_t = 0.0  # time of the simulation [s]
        self._names = sorted(params)
        self._params, self._dialect = params, dialect
        self._pending_params: deque[int] = deque()  # indices of parameters to send
        self.requests: deque[ModeRequest | SpeedRequest | ItemRequest | UploadedMission] = deque()  # not yet executed
        schedule = [(round(TICK_HZ / rate), phase, build) for rate, phase, build in dialect.telemetry]
        self._due = [  # message functions of each tick, repeated
            [build for period, phase, build in schedule if (tick - phase) % period == 0]
            for tick in range(lcm(*(period for period, _, _ in schedule)))
        ]

    def _pack(self, message: Any) -> bytes:
        packed = bytes(message.pack(self._out))
        self._out.seq = (self._out.seq + 1) % 256
        return packed

    def telemetry(self, tick: int, state: Callable[[], TelemetryState]) -> list[bytes]:
        """Return the frames due at this tick of 10 ms; `state` is called only if one is due."""
        due = self._due[tick % len(self._due)]
        snapshot = state() if due else None
        messages = [make(snapshot) for make in due if snapshot is not None]
        frames = [self._pack(message) for message in messages if message is not None]
        return frames + self.stream_parameters(_PARAMS_PER_TICK) + self.poll(tick / TICK_HZ)

    def poll(self, t: float) -> list[bytes]:
        """Return the repeated requests of an upload at `t` since the start of the simulation [s]."""
        self._poll_t = t
        return [self._pack(message) for message in self.missions.poll(t)]

    def stream_parameters(self, limit: int) -> list[bytes]:
        """Return up to `limit` requested parameters as frames."""
        count = min(limit, len(self._pending_params))
        return [self._pack(self._param(self._pending_params.popleft())) for _ in range(count)]

    def receive(self, data: bytes, t: float) -> list[bytes]:
        """Process bytes from the ground at `t` since boot [s] and return the replies; ignore invalid data."""
        try:
            messages: Iterable[Any] = self._in.parse_buffer(data) or ()
        except (mav.MAVError, ValueError):  # wrong checksum or invalid text
            return []
        replies: list[Any] = []
        for message in messages:
            handler = _HANDLERS.get(message.get_type())
            if handler is not None and getattr(message, "target_system", 0) in (0, self._out.srcSystem):
                replies += handler(self, message, t)
        return [self._pack(answer) for answer in replies]

    def _param(self, index: int, by_name: bool = False) -> Any:
        name = self._names[index]
        index_field = 65_535 if by_name else index
        return param_value_message(name, self._params[name], (len(self._names), index_field), self._dialect)

    def _param_list(self, message: Any, t: float) -> list[Any]:
        self._pending_params = deque(range(len(self._names)))
        return []

    def _param_read(self, message: Any, t: float) -> list[Any]:
        if message.param_index >= 0:
            return [self._param(message.param_index)] if message.param_index < len(self._names) else []
        name = message.param_id
        return [self._param(self._names.index(name), by_name=True)] if name in self._params else []

    def _mission(self, message: Any, t: float) -> list[Any]:
        replies = self.missions.receive(message, self._poll_t)
        if (uploaded := self.missions.take_upload()) is not None:
            self.requests.append(uploaded)
        return replies

    def _set_current(self, message: Any, t: float) -> list[Any]:
        """Process MISSION_SET_CURRENT; MISSION_CURRENT follows with the telemetry."""
        self._request_item(message.seq)
        return []

    def _request_item(self, seq: float) -> bool:
        """Store a commanded mission item; return whether it exists."""
        exists = isfinite(seq) and 0 <= seq < len(self.missions.items)
        if exists:
            self.requests.append(ItemRequest(int(seq)))
        return exists

    def _request_speed(self, speed: float) -> bool:
        """Store a commanded speed; return whether the autopilot accepts it.

        ArduPlane: airspeeds within its limits, -2 for the default; ArduCopter: positive speeds; PX4: any, the default
        where it is not positive. Source: MAV_CMD_DO_CHANGE_SPEED; ArduPlane, ArduCopter, PX4 Navigator.
        """
        low, high = self._speed_limits()
        is_default = (self._dialect.is_px4 and not speed > 0) or (speed == -2.0 and isfinite(high))
        accepted = is_default or (isfinite(speed) and low <= speed <= high and speed > 0)
        if accepted:
            self.requests.append(SpeedRequest(0.0 if is_default else float(speed)))
        return accepted

    def _speed_limits(self) -> tuple[float, float]:
        """Return the range of commanded speeds that the autopilot accepts [m/s]."""
        if self._dialect.is_px4:
            return 0.0, float("inf")
        get = self._params.get
        return get("AIRSPEED_MIN", get("ARSPD_FBW_MIN", 9.0)), get("AIRSPEED_MAX", get("ARSPD_FBW_MAX", 22.0))

    def _request_mode(self, mode: str | None, target: tuple[int, int, float] | None = None) -> bool:
        """Store a commanded mode; return whether it is one that is simulated."""
        if mode is not None:
            self.requests.append(ModeRequest(mode, target))
        return mode is not None

    def _set_mode(self, message: Any, t: float) -> list[Any]:
        self._request_mode(self._mode_name(message.custom_mode))
        return []

    def _mode_name(self, custom_mode: int) -> str | None:
        """Return the name of a custom mode; None: not simulated."""
        if self._dialect.is_px4:
            names = {sub << 24 | PX4_AUTO << 16: name for name, sub in PX4_MODES.items() if name != "LAND"}
        else:
            names = {number: name for name, number in ARDUPLANE_MODES.items()}
        return names.get(custom_mode)

    def _command_int(self, message: Any, t: float) -> list[Any]:
        """Process DO_REPOSITION: fly to a point at a height above home, in GUIDED (ArduPlane) or Hold (PX4)."""
        accepted = message.command == mav.MAV_CMD_DO_REPOSITION and message.frame in _RELATIVE_FRAMES
        if accepted:
            mode = "LOITER" if self._dialect.is_px4 else "GUIDED"
            self._request_mode(mode, (message.x, message.y, float(message.z)))
        result = mav.MAV_RESULT_ACCEPTED if accepted else mav.MAV_RESULT_UNSUPPORTED
        return [mav.MAVLink_command_ack_message(message.command, result, 0, 0, *_sender(message))]

    def _command(self, message: Any, t: float) -> list[Any]:
        version_id = mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION
        is_version_request = message.command == mav.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES or (
            message.command == mav.MAV_CMD_REQUEST_MESSAGE and message.param1 == version_id  # may be nan
        )
        accepted = is_version_request or message.command == mav.MAV_CMD_SET_MESSAGE_INTERVAL  # rates are fixed
        if message.command == mav.MAV_CMD_DO_SET_MODE and all(map(isfinite, (message.param2, message.param3))):
            custom, sub = int(message.param2), int(message.param3)
            mode = self._mode_name((sub << 24 | custom << 16) if self._dialect.is_px4 else custom)
            accepted = self._request_mode(mode)
        rejection = mav.MAV_RESULT_UNSUPPORTED
        if message.command == mav.MAV_CMD_DO_CHANGE_SPEED:
            accepted, rejection = self._request_speed(message.param2), mav.MAV_RESULT_DENIED
        elif message.command == mav.MAV_CMD_DO_SET_MISSION_CURRENT and not self._dialect.is_px4:
            accepted, rejection = self._request_item(message.param1), mav.MAV_RESULT_DENIED
        result = mav.MAV_RESULT_ACCEPTED if accepted else rejection
        ack = mav.MAVLink_command_ack_message(message.command, result, 0, 0, *_sender(message))
        if not is_version_request:
            return [ack]
        zeros, uid = [0] * 8, self._out.srcSystem
        version = self._dialect.version
        return [
            ack,
            mav.MAVLink_autopilot_version_message(_CAPABILITIES, version, 0, 0, 0, zeros, zeros, zeros, 0, 0, uid),
        ]

    def _timesync(self, message: Any, t: float) -> list[Any]:
        return [mav.MAVLink_timesync_message(round(t * 1e9), message.ts1)] if message.tc1 == 0 else []


def _sender(message: Any) -> tuple[int, int]:
    return message.get_srcSystem(), message.get_srcComponent()


_HANDLERS: dict[str, Callable[[MavlinkEndpoint, Any, float], list[Any]]] = {
    "PARAM_REQUEST_LIST": MavlinkEndpoint._param_list,
    "PARAM_REQUEST_READ": MavlinkEndpoint._param_read,
    **dict.fromkeys(
        ("MISSION_REQUEST_LIST", "MISSION_REQUEST_INT", "MISSION_REQUEST", "MISSION_COUNT", "MISSION_ITEM_INT"),
        MavlinkEndpoint._mission,
    ),
    "MISSION_ITEM": MavlinkEndpoint._mission,
    "MISSION_SET_CURRENT": MavlinkEndpoint._set_current,
    "COMMAND_LONG": MavlinkEndpoint._command,
    "COMMAND_INT": MavlinkEndpoint._command_int,
    "SET_MODE": MavlinkEndpoint._set_mode,
    "TIMESYNC": MavlinkEndpoint._timesync,
}


def ground_requests(system: int, items: int) -> list[bytes]:
    """Return a ground station's requests to `system`: version, every mission item, parameter list, in this order."""
    ground = mav.MAVLink(None, srcSystem=255, srcComponent=mav.MAV_COMP_ID_MISSIONPLANNER)
    target = (system, COMPONENT)
    version = (mav.MAV_CMD_REQUEST_MESSAGE, 0, mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION, 0, 0, 0, 0, 0, 0)
    messages = [
        mav.MAVLink_command_long_message(*target, *version),
        mav.MAVLink_mission_request_list_message(*target),
        *(mav.MAVLink_mission_request_int_message(*target, seq) for seq in range(items)),
        mav.MAVLink_param_request_list_message(*target),
    ]
    return [bytes(message.pack(ground)) for message in messages]
