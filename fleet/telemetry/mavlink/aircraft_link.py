"""MAVLink state of one aircraft: rows, mode, losses, parameters, mission; received in batches, returned in steps."""

import bisect
from collections import deque
from collections.abc import Callable, Hashable
from math import isfinite
from operator import itemgetter
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet import vehicles
from fleet.contract import Link, Mission, Params, Status
from fleet.telemetry.mavlink import heartbeat
from fleet.telemetry.mavlink.arrays.counts import LAST_ARRIVAL, LAST_COUNTED, MISSED, RECEIVED
from fleet.telemetry.mavlink.arrays.fleet_arrays import AircraftArrays
from fleet.telemetry.mavlink.microservices.fence import FENCE_TYPE, FenceCollector
from fleet.telemetry.mavlink.microservices.params import ParamCollector
from fleet.telemetry.mavlink.microservices.route import MISSION_MESSAGES, MissionCollector
from fleet.telemetry.mavlink.onboard_log import OnboardEvent
from fleet.telemetry.mavlink.timing import LinkTiming

LINK_LOST_S = 3.0  # silence after which the link is lost [s]
STATUS_PERIOD_S = 0.95  # period of status messages; below 1 s because it is checked every 0.1 s [s]
TEXT_LIFETIME_S = 30.0  # display time of an operator text [s]
MAX_ERROR_SEVERITY = 3  # texts up to this severity are shown to the operator (MAV_SEVERITY_ERROR)
MISSION_RECEIVED = "Flight plan received"  # text of ArduPilot after an upload by any ground station
MAX_TEXTS = 2_000
_FIRMWARE_TEXTS = ("ArduPlane V", "ArduCopter V", "APM:", "PX4 v", "Blimp V", "ArduRover V")  # autopilot and version
_MISSION_MODES = ("AUTO", "MISSION", "AUTO.MISSION")
_ARRIVAL: Callable[[tuple[Any, ...]], float] = itemgetter(0)  # of an entry of the queue
_ABSOLUTE_FRAMES = (0, 5)  # MAV_FRAME: altitude above sea level
_ON_EARTH = (900_000_000, 1_800_000_000, 100_000_000)  # largest latitude, longitude, altitude [1e-7 deg, 1e-7 deg, mm]


class AircraftLink:
    """State of one aircraft; frequent data are in the shared arrays, all other messages pass through `queue`.

    Args:
        arrays: shared arrays of all aircraft
        uav: UAV id
        system, component: MAVLink ids
        source: sender of its messages
        number: number in the arrays of a removed aircraft; None: a new number
    """

    def __init__(
        self,
        arrays: AircraftArrays,
        uav: int,
        system: int,
        component: int,
        source: Hashable = None,
        *,
        number: int | None = None,
    ) -> None:
        self.uav, self.system, self.component, self.source = uav, system, component, source
        self.arrays = arrays
        self.number = arrays.add_aircraft(uav) if number is None else number
        self.link = Link.LIVE
        self.autopilot, self.mode, self.armed = "generic", "", False
        self.custom_mode = 0  # of the last heartbeat
        self._observer: Callable[[Any, float], None] | None = None
        self.vehicle_type = vehicles.UNKNOWN  # vehicle type from the heartbeat
        self.firmware = ""
        self.board_id = ""  # hardware id and firmware version of the autopilot, or empty
        self.texts: deque[tuple[float, int, str]] = deque(maxlen=MAX_TEXTS)  # fleet time, severity, text
        self.params, self.mission, self.fence = ParamCollector(uav), MissionCollector(uav), FenceCollector()
        self.home: tuple[int, int, int] | None = None  # latitude, longitude, altitude [1e-7 deg, 1e-7 deg, mm]
        self.rates: dict[str, float] = {}
        self.timing = LinkTiming(lambda: arrays.clocks[self.number])
        self._queue: list[tuple[float, Callable[..., None], tuple[Any, ...]]] = []
        self._queue_done = 0  # processed entries of the queue
        self._rejected_values = 0
        self._operator_text, self._operator_text_t = "", float("-inf")
        self._clock_jumps, self._clock_advance_s = 0, 0.0
        self._published_state: tuple[Any, ...] = ()
        self._published_t = float("-inf")

    @property
    def vehicle(self) -> str:
        """Return the vehicle type; an ArduPlane quadplane also sends MAV_TYPE_FIXED_WING."""
        is_quadplane = self.vehicle_type == vehicles.FIXED_WING and self.params.values.get("Q_ENABLE", 0.0) > 0
        return vehicles.QUADPLANE if is_quadplane else self.vehicle_type

    @property
    def observer(self) -> Callable[[Any, float], None] | None:
        """Return the function that receives each processed message, and its arrival."""
        return self._observer

    @observer.setter
    def observer(self, observer: Callable[[Any, float], None] | None) -> None:
        """Set it, or remove it with None; an observed aircraft's repeated messages are processed too."""
        self._observer = observer
        self.arrays.observed[self.number] = observer is not None

    @property
    def last_arrival(self) -> float:
        """Return the arrival of the last message, fleet time [s since 1970]."""
        return float(self.arrays.counts.state[self.number, LAST_ARRIVAL])

    def queue(self, arrival: float, callback: Callable[..., None], *arguments: Any) -> None:
        """Call `callback` with `arrival` as its last argument when `collect` reaches that time."""
        if self._queue_done:
            del self._queue[: self._queue_done]
            self._queue_done = 0
        bisect.insort(self._queue, (arrival, callback, arguments), key=_ARRIVAL)
        self.arrays.next_due_t[self.number] = min(arrival, self.arrays.next_due_t[self.number])

    def collect(self, now: float) -> list[Status | Mission | Params]:
        """Return the new mission, parameters and status at `now` [s since 1970]."""
        while self._queue_done < len(self._queue) and self._queue[self._queue_done][0] <= now:
            arrival, callback, arguments = self._queue[self._queue_done]
            self._queue_done += 1
            callback(*arguments, arrival)
        if self._queue_done == len(self._queue):  # free the processed messages
            self._queue.clear()
            self._queue_done = 0
        updates = (self.mission.take_update(now, self.fence.items), self.params.take_update(now), self._status(now))
        self.arrays.next_due_t[self.number] = self._next_due(now)
        return [message for message in updates if message is not None]

    def _next_due(self, now: float) -> float:
        """Return the latest time of the next `collect`, `now` if the link is lost [s since 1970]."""
        if self.link is Link.LOST:
            return now
        next_queued = self._queue[self._queue_done][0] if self._queue_done < len(self._queue) else float("inf")
        return min(
            next_queued,
            self._published_t + STATUS_PERIOD_S,
            float(self.arrays.counts.state[self.number, LAST_COUNTED]) + LINK_LOST_S,
        )

    def set_operator_text(self, text: str, now: float) -> None:
        """Set the operator text; it expires after `TEXT_LIFETIME_S`."""
        self._operator_text, self._operator_text_t = f"uav-{self.uav}: {text}", now

    def update_identity(self, message: Any) -> None:
        """Set autopilot and vehicle type from a heartbeat."""
        self.autopilot, self.vehicle_type = heartbeat.autopilot(message), heartbeat.vehicle(message)
        self.arrays.autopilots[self.number] = heartbeat.AUTOPILOTS.index(self.autopilot)

    def process(self, message: Any, now: float) -> None:
        """Process one MAVLink message that is not a table row."""
        name = message.get_type()
        if name == "HEARTBEAT":
            self.update_identity(message)
            self.mode, self.custom_mode = heartbeat.mode(message), message.custom_mode
            self.armed = bool(message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)
        elif name == "PARAM_VALUE":
            self.params.process(message, self.autopilot, now)
        elif name in MISSION_MESSAGES:
            self._process_mission(message, is_upload=False, now=now)
        elif name == "HOME_POSITION":
            self._process_home(message)
        elif name == "STATUSTEXT":
            self._process_text(message.severity, str(message.text).strip(), now)
        elif name == "AUTOPILOT_VERSION":
            self.board_id = heartbeat.board_id(message)
            if message.flight_sw_version:
                self.firmware = self.firmware or heartbeat.firmware(message)
        if self._observer is not None:
            self._observer(message, now)

    def _process_home(self, message: Any) -> None:
        """Process HOME_POSITION: item 0 of an ArduPilot mission, the reference of relative altitudes of PX4."""
        altitude_m = message.altitude * 1e-3
        self._set_home(message.latitude, message.longitude, message.altitude)
        if self.autopilot == "px4":
            self.mission.set_home_altitude(altitude_m)
        elif self.autopilot == "ardupilot":
            self.mission.set_home(message.latitude, message.longitude, altitude_m)

    def _set_home(self, lat_e7: int, lon_e7: int, alt_mm: int) -> None:
        """Store home, unless it is no position on earth: an autopilot sends zeros before it has one."""
        home = (lat_e7, lon_e7, alt_mm)
        if (lat_e7 or lon_e7) and all(abs(x) <= limit for x, limit in zip(home, _ON_EARTH, strict=True)):
            self.home = home

    def process_uplink(self, message: Any, now: float) -> None:
        """Process one mission protocol message from a ground station to this aircraft."""
        self._process_mission(message, is_upload=True, now=now)

    def _process_mission(self, message: Any, *, is_upload: bool, now: float) -> None:
        if getattr(message, "mission_type", 0) == FENCE_TYPE:
            self.fence.process(message, is_upload=is_upload)
        else:
            self.mission.process(message, is_upload=is_upload, now=now)

    def process_target(self, message: Any, now: float) -> None:
        """Process one POSITION_TARGET_GLOBAL_INT of an aircraft without mission list."""
        if self.mode in _MISSION_MODES and message.coordinate_frame in _ABSOLUTE_FRAMES:
            self.mission.add_target(message.lat_int, message.lon_int, message.alt, now)

    def process_log_event(self, event: OnboardEvent, now: float) -> None:
        """Process one event of an onboard log."""
        if event.kind == "mode":
            self.mode = event.value
        elif event.kind == "armed":
            self.armed = event.value
        elif event.kind == "param":
            self.params.set_value(*event.value)
        elif event.kind == "mission":
            self.mission.set_items(event.value)
        elif event.kind == "partial mission":
            self.mission.set_partial(*event.value)
        elif event.kind == "home":
            lat, lon, altitude_m = event.value
            self.mission.set_home_altitude(altitude_m)
            if isfinite(lat) and isfinite(lon):
                self._set_home(round(lat * 1e7), round(lon * 1e7), round(altitude_m * 1e3))
        elif event.kind == "text":
            severity, text = event.value
            self._process_text(severity, text, now)

    def reject_values(self, name: str, count: int, now: float) -> None:
        """Count rows with implausible values."""
        self._rejected_values += count
        self.set_operator_text(
            f"{name} with a value that is not finite or out of range was rejected; check the sensor", now
        )

    def _process_text(self, severity: int, text: str, now: float) -> None:
        self.texts.append((now, severity, text))
        if text.startswith(MISSION_RECEIVED):
            self.mission.mark_replaced()
        if text.startswith(_FIRMWARE_TEXTS):
            self.firmware = self.firmware or text
        if severity <= MAX_ERROR_SEVERITY:
            self.set_operator_text(text, now)

    def apply_clock_jump(self, count: int, now: float) -> None:
        """Set the number of jumps of the aircraft's clock."""
        self._clock_jumps = count
        self.mission.needs_download = self.fence.needs_download = True  # they may differ after a restart
        self.set_operator_text(f"the aircraft's clock jumped ({count} times so far), time was re-anchored", now)

    def apply_reanchor(self, step_s: float, now: float) -> None:
        """Add a forward re-anchoring of the telemetry times by `step_s`."""
        self._clock_advance_s += step_s
        self.set_operator_text(
            f"telemetry times were {step_s:.1f} s behind arrival for 15 to 30 s and were re-anchored; "
            "expected real time; check for a slow or paused simulator",
            now,
        )

    def count_rejected(self, count: int, _: float) -> None:
        """Count rejected rows."""
        self._rejected_values += count

    def _status(self, now: float) -> Status | None:
        counters = self.arrays.counts.state[self.number].tolist()
        self.link = Link.LOST if now - counters[LAST_COUNTED] > LINK_LOST_S else Link.LIVE
        state = (self.link, self.mode, self.armed, self._clock_jumps, self._clock_advance_s, self.home)
        elapsed = now - self._published_t
        if state == self._published_state and 0 <= elapsed < STATUS_PERIOD_S:
            return None
        if not 0 <= elapsed < STATUS_PERIOD_S:
            self.rates = self.arrays.counts.rates(self.number, elapsed)
            self._published_t = now
        self._published_state = state
        overflow = int(self.arrays.pending.dropped[self.number])
        return Status(
            uav=self.uav,
            t=now,
            link=self.link,
            mode=self.mode,
            armed=self.armed,
            autopilot=self.autopilot,
            vehicle=self.vehicle,
            rates_hz=self.rates,
            received=int(counters[RECEIVED]),
            missed=int(counters[MISSED]),
            rejected=self._rejected_values + overflow + self.params.rejected + self.mission.rejected,
            **self.timing.status_fields(now),
            clock_jumps=self._clock_jumps,
            clock_advance_s=self._clock_advance_s,
            home=self.home,
            sentence=self._status_text(now),
        )

    def _status_text(self, now: float) -> str:
        if self.link is Link.LOST:
            silent_s = now - self.arrays.counts.state[self.number, LAST_COUNTED]
            return f"uav-{self.uav}: no message for {silent_s:.0f} s; check the radio link"
        return self._operator_text if now - self._operator_text_t < TEXT_LIFETIME_S else ""
