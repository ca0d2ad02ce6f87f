"""Schedule of requests to an aircraft: parameters, mission, message rates, time; with retries at limited rate.

Source: MAVLink services "Parameter Protocol", "Mission Protocol", "Message interval".
"""

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.telemetry.mavlink.aircraft_link import AircraftLink
from fleet.telemetry.mavlink.microservices.fence import FENCE_TYPE
from fleet.telemetry.mavlink.parsing.decode import IDS, layout
from gateway import DEFAULT_BUDGET
from gateway.link_spec import LinkSpec
from gateway.onboard.parameter_cache_check import ANY, DIALECTS, STREAMS, Cache, CacheCheck, RequestDialect
from gateway.record.tape import read_size

WANTED_HZ: dict[str, float] = {  # [Hz]
    "ATTITUDE": 25,
    "SERVO_OUTPUT_RAW": 20,
    "GLOBAL_POSITION_INT": 10,
    "VFR_HUD": 10,
    "NAV_CONTROLLER_OUTPUT": 5,
    "MISSION_CURRENT": 1,
}
IMU_HZ = 25.0  # for diagnosis [Hz]
IMU_MESSAGES = {"ardupilot": "RAW_IMU", "px4": "SCALED_IMU"}  # requested, by autopilot
DIAGNOSIS_HZ: dict[str, float] = {**dict.fromkeys(IMU_MESSAGES.values(), IMU_HZ), "LOCAL_POSITION_NED": 10}
"""Rates that only diagnosis needs; an aircraft is asked for one of the IMU messages [Hz]."""
_FRAME_BYTES = 12  # bytes of a frame without payload
_SERIAL_SHARE = 0.7  # share of a serial line that telemetry may fill


def budget_of(spec: LinkSpec, text: str = "") -> float:
    """Return the rate that aircraft may send on a link [bytes/s]: as specified, or the default of its kind.

    Raises:
        ValueError: when `text` is not a size.
    """
    if text or spec.kind != "serial":
        return float(read_size(text or DEFAULT_BUDGET, "--budget"))
    return _SERIAL_SHARE * spec.port / 10  # ten bits per byte


def size_of(name: str) -> int:
    """Return the length of a message on the wire without truncation [bytes]."""
    return _FRAME_BYTES + layout(name).itemsize


FIRST_WAIT_S, LONGEST_WAIT_S = 1.0, 60.0  # for a complete list, doubled at every attempt [s]


class RetryTimer:
    """Timer of retries with exponential back-off."""

    def __init__(self, first_s: float = FIRST_WAIT_S) -> None:
        self._wait_s = self._first_s = first_s
        self._due_t = float("-inf")

    def due(self, now: float) -> bool:
        """Return whether to retry now; if so, double the next wait."""
        if now < self._due_t:
            return False
        self._due_t, self._wait_s = now + self._wait_s, min(2 * self._wait_s, LONGEST_WAIT_S)
        return True

    def reset(self) -> None:
        """Reset the wait to its first value."""
        self._wait_s, self._due_t = self._first_s, float("-inf")


RETRY_S = 0.5  # for one item or a few parameters [s]
ITEM_TRIES = 20  # unsuccessful attempts after which the list is requested again: it may have become shorter
WATCH_S, CONFIRM_S = 15.0, 1.0  # between two checks of an item: verified; from the cache and not yet verified [s]
REDOWNLOAD_S = 60.0  # between two downloads where single items cannot be requested [s]
REDOWNLOAD_ITEM_S = 2.0  # the same, per item [s]
STORE_S, FIRST_STORE_S = 60.0, 15.0  # between two updates of the cache, and before the first [s]
TIMESYNC_S = 10.0  # between two time requests [s]
PARAMS_AT_ONCE = 10
MAX_SINGLE_PARAMS = 200  # if more parameters are missing, the list is requested
RATES_AFTER_S = 5.0  # before the first check of rates [s]
RATE_TRIES = 3
_STOP = -1.0  # interval of a message that is not to be sent
TOO_LOW, TOO_HIGH = 0.4, 1.6  # bounds of received over fitting rate; the upper one applies only on a full link [-]


class RequestScheduler:
    """Pending requests to one aircraft."""

    def __init__(self, aircraft: AircraftLink, now: float, cache: Cache | None = None) -> None:
        self.aircraft = aircraft
        self._cache_check = None if cache is None else CacheCheck(aircraft, cache)
        self._shares = (1.0, 0.0)
        self._requested: set[str] = set()  # messages for diagnosis that were requested
        self._watch_t = self._timesync_t = now
        self._store_t = now - STORE_S + FIRST_STORE_S
        self._watched_item = 0
        self._needed_download = True
        self._to = (aircraft.system, aircraft.component)
        self._since = now
        self._param_list, self._mission_list, self._home_wait = RetryTimer(3.0), RetryTimer(), RetryTimer()
        self._rate_wait, self._rate_tries = RetryTimer(10.0), 0
        self._params_at = self._items_at = float("-inf")
        self._items_left: int | None = None
        self._item_tries = 0  # since the last item received
        self._fence_list, self._fence_tries, self._fence_left = RetryTimer(), 0, 0
        self._fence_at = self._fence_watch_t = now

    def requests(
        self, now: float, share: float = 1.0, diagnosis_share: float = 0.0, *, mission: bool = True
    ) -> list[Any]:
        """Return the messages to send now.

        Args:
            now: fleet time [s since 1970]
            share, diagnosis_share: of the wanted rates, and of those for diagnosis, that fit the link
            mission: the mission may be requested; false while it is uploaded
        """
        if self._cache_check is not None and now - self._store_t >= STORE_S:
            self._store_t = now
            self._cache_check.store()
        requests = (
            (self._mission(now) or self._fence(now) if mission else [])
            + self._home(now)
            + self._params(now)
            + self._rates(now, share, diagnosis_share)
        )
        if now - self._timesync_t >= TIMESYNC_S:  # to measure the round-trip time
            self._timesync_t = now
            requests.append(dialect.MAVLink_timesync_message(0, round(now * 1e9)))
        return requests

    @property
    def _request_dialect(self) -> RequestDialect:
        return DIALECTS.get(self.aircraft.autopilot, ANY)

    def _mission(self, now: float) -> list[Any]:
        route, missing = self.aircraft.mission, self.aircraft.mission.missing()
        if route.needs_download and not self._needed_download:
            self._mission_list.reset()
        self._needed_download = route.needs_download
        if missing:
            if self._items_left == len(missing) and now - self._items_at < RETRY_S:
                return []
            if self._items_left != len(missing):
                self._mission_list.reset()
                self._item_tries = 0
            self._item_tries += 1
            if self._item_tries > ITEM_TRIES:
                self._item_tries = 0
                route.abort_download()
                return []
            self._items_left, self._items_at = len(missing), now
            batch = missing[: self._request_dialect.items_at_once]
            return [dialect.MAVLink_mission_request_int_message(*self._to, seq) for seq in batch]
        if self._items_left is not None and not route.needs_download:
            self._items_left = None
            return [dialect.MAVLink_mission_ack_message(*self._to, dialect.MAV_MISSION_ACCEPTED)]
        if route.needs_download and self._mission_list.due(now):
            return [dialect.MAVLink_mission_request_list_message(*self._to)]
        return self._watch(now) if route.complete and not route.needs_download else []

    def _watch(self, now: float) -> list[Any]:
        """Return requests that check periodically whether the stored mission is still the one on board."""
        route, count = self.aircraft.mission, len(self.aircraft.mission.items)
        if not self._request_dialect.probe:
            if now - self._watch_t > max(REDOWNLOAD_S, REDOWNLOAD_ITEM_S * count):
                self._watch_t, route.needs_download = now, True
                self._mission_list.reset()
            return []
        if not count or now - self._watch_t < (CONFIRM_S if route.unconfirmed else WATCH_S):
            return []
        self._watch_t, self._watched_item = now, (self._watched_item + 1) % count
        seq = min(route.unconfirmed, default=self._watched_item)
        return [dialect.MAVLink_mission_request_int_message(*self._to, seq)]

    def _fence(self, now: float) -> list[Any]:
        """Return requests for the fence items, once the mission is complete; the list is checked periodically."""
        fence, mission = self.aircraft.fence, self.aircraft.mission
        if not fence.supported or not mission.complete or mission.needs_download:
            return []
        if now - self._fence_watch_t > REDOWNLOAD_S:
            self._fence_watch_t, fence.needs_download = now, True
            self._fence_list.reset()
        if missing := fence.missing():
            is_stalled = len(missing) == self._fence_left
            if is_stalled and now - self._fence_at < RETRY_S:
                return []
            self._fence_tries = self._fence_tries + 1 if is_stalled else 0
            self._fence_left, self._fence_at = len(missing), now
            if self._fence_tries > ITEM_TRIES:
                self._fence_tries = 0
                fence.abort_download()
                return []
            batch = missing[: self._request_dialect.items_at_once]
            return [dialect.MAVLink_mission_request_int_message(*self._to, seq, FENCE_TYPE) for seq in batch]
        if self._fence_left:
            self._fence_left = 0
            return [dialect.MAVLink_mission_ack_message(*self._to, dialect.MAV_MISSION_ACCEPTED, FENCE_TYPE)]
        if fence.needs_download and self._fence_list.due(now):
            return [dialect.MAVLink_mission_request_list_message(*self._to, FENCE_TYPE)]
        return []

    def _home(self, now: float) -> list[Any]:
        """Return a request for HOME_POSITION where the mission came before it, or, with PX4, never contains home."""
        px4_needs_it = self.aircraft.autopilot == "px4" and self.aircraft.home is None
        needs_home = self.aircraft.mission.needs_home or (px4_needs_it and self.aircraft.mission.complete)
        if not needs_home or not self._home_wait.due(now):
            return []
        request = (dialect.MAV_CMD_REQUEST_MESSAGE, 0, dialect.MAVLINK_MSG_ID_HOME_POSITION, 0, 0, 0, 0, 0, 0)
        return [dialect.MAVLink_command_long_message(*self._to, *request)]

    def _params(self, now: float) -> list[Any]:
        if self._cache_check is not None and not self._cache_check.finished:
            return self._cache_check.requests(now)
        params, missing = self.aircraft.params, self.aircraft.params.missing()
        if params.complete or now - max(params.last_arrival, self._params_at) < RETRY_S:
            return []
        if missing is None or len(missing) > MAX_SINGLE_PARAMS:
            if not self._param_list.due(now):
                return []
            self._params_at = now
            return [dialect.MAVLink_param_request_list_message(*self._to)]
        self._params_at = now
        return [dialect.MAVLink_param_request_read_message(*self._to, b"", index) for index in missing[:PARAMS_AT_ONCE]]

    def _diagnosis_hz(self, share: float) -> dict[str, float]:
        """Return the rates for diagnosis to request [Hz]; 0 to stop a message that is not to be sent any more."""
        received, imu = self.aircraft.rates, IMU_MESSAGES.get(self.aircraft.autopilot)
        if imu is None or share == 0.0:
            return dict.fromkeys(self._requested, 0.0)
        has_other = received.get("HIGHRES_IMU", 0.0) >= TOO_LOW * IMU_HZ * share
        return {name: DIAGNOSIS_HZ[name] * share for name in ("LOCAL_POSITION_NED", *([] if has_other else [imu]))}

    def _rates(self, now: float, share: float, diagnosis_share: float) -> list[Any]:
        if (share, diagnosis_share) != self._shares:
            self._shares, self._rate_tries = (share, diagnosis_share), 0
            self._rate_wait.reset()
        if now - self._since < RATES_AFTER_S or self._rate_tries >= RATE_TRIES:
            return []
        received = self.aircraft.rates
        fitting = {name: hz * share for name, hz in WANTED_HZ.items()} | self._diagnosis_hz(diagnosis_share)
        limited = {name: (diagnosis_share if name in DIAGNOSIS_HZ else share) < 1.0 for name in fitting}
        wrong = [name for name, hz in fitting.items() if _is_wrong(received.get(name, 0.0), hz, limited[name])]
        if not wrong or not self._rate_wait.due(now):
            return []
        self._rate_tries += 1
        self._requested.update(name for name in wrong if name in DIAGNOSIS_HZ and fitting[name])
        command, zeros = (*self._to, dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 0), (0, 0, 0, 0, 0)
        intervals = {name: 1e6 / fitting[name] if fitting[name] else _STOP for name in wrong}
        requests = [
            dialect.MAVLink_command_long_message(*command, IDS[name], interval, *zeros)
            for name, interval in intervals.items()
        ]
        wrong = [name for name in wrong if name in STREAMS]  # the group of an IMU message has much more
        if self._rate_tries == RATE_TRIES and self._request_dialect.streams and wrong:
            groups = {STREAMS[name]: round(max(fitting[name], 1.0)) for name in reversed(wrong)}
            requests += [dialect.MAVLink_request_data_stream_message(*self._to, *pair, 1) for pair in groups.items()]
        return requests


def _is_wrong(received_hz: float, wanted_hz: float, is_limited: bool) -> bool:
    """Return whether a rate is too low, or too high on a link that is limited to the wanted rates."""
    return received_hz < TOO_LOW * wanted_hz or (is_limited and received_hz > TOO_HIGH * wanted_hz)
