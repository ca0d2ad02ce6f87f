"""Schedule of requests to an aircraft: parameters, mission, message rates, time; with retries at limited rate.

Source: MAVLink services "Parameter Protocol", "Mission Protocol", "Message interval".
"""

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.telemetry.mavlink.aircraft_link import Craft
from gateway.onboard.cache import Cache
from gateway.onboard.dialects import ANY, DIALECTS, STREAMS, Dialect
from gateway.onboard.parameter_cache_check import Recall
from gateway.onboard.rates import WANTED_HZ
from gateway.onboard.retry_timer import Patience

RETRY_S = 0.5  # for one item or a few parameters [s]
ITEM_TRIES = 20  # unsuccessful attempts after which the list is requested again: it may have become shorter
WATCH_S, PROOF_S = 15.0, 1.0  # between two checks of an item: verified; from the cache and not yet verified [s]
AGAIN_S, AGAIN_ITEM_S = 60.0, 2.0  # between two downloads where single items cannot be requested, and per item [s]
KEEP_S, SOON_S = 60.0, 15.0  # between two updates of the cache, and before the first [s]
TRIP_S = 10.0  # between two time requests [s]
PARAMS_AT_ONCE = 10
LIST_AGAIN = 200  # if more parameters are missing, the list is requested
RATES_AFTER_S = 5.0  # before the first check of rates [s]
RATE_TRIES = 3
TOO_LOW, TOO_HIGH = 0.4, 1.6  # bounds of received over fitting rate; the upper one applies only on a full link [-]
_IDS = {kind.msgname: number for number, kind in dialect.mavlink_map.items()}


class Questions:
    """Pending requests to one aircraft."""

    def __init__(self, craft: Craft, now: float, cache: Cache | None = None) -> None:
        self.craft = craft
        self._recall = None if cache is None else Recall(craft, cache)
        self._share = 1.0
        self._watch_at = self._trip_at = now
        self._keep_at = now - KEEP_S + SOON_S
        self._watched = 0
        self._to = (craft.system, craft.component)
        self._since = now
        self._param_list, self._mission_list = Patience(3.0), Patience()
        self._rate_wait, self._rate_tries = Patience(10.0), 0
        self._params_at = self._items_at = float("-inf")
        self._items_left: int | None = None
        self._item_tries = 0  # since the last item received

    def ask(self, now: float, share: float = 1.0) -> list[Any]:
        """Return the messages to send now; `share` of the wanted rates fits the link."""
        if self._recall is not None and now - self._keep_at >= KEEP_S:
            self._keep_at = now
            self._recall.keep()
        return self._mission(now) + self._params(now) + self._rates(now, share) + self._time(now)

    @property
    def _dialect(self) -> Dialect:
        return DIALECTS.get(self.craft.autopilot, ANY)

    def _mission(self, now: float) -> list[Any]:
        route, missing = self.craft.route, self.craft.route.missing()
        if missing:
            if self._items_left == len(missing) and now - self._items_at < RETRY_S:
                return []
            if self._items_left != len(missing):
                self._mission_list.reset()
                self._item_tries = 0
            self._item_tries += 1
            if self._item_tries > ITEM_TRIES:
                self._item_tries = 0
                route.drop_download()
                return []
            self._items_left, self._items_at = len(missing), now
            wanted = missing[: self._dialect.items_at_once]
            return [dialect.MAVLink_mission_request_int_message(*self._to, seq) for seq in wanted]
        if self._items_left is not None and not route.stale:
            self._items_left = None
            return [dialect.MAVLink_mission_ack_message(*self._to, dialect.MAV_MISSION_ACCEPTED)]
        if route.stale and self._mission_list.due(now):
            return [dialect.MAVLink_mission_request_list_message(*self._to)]
        return self._watch(now) if route.complete and not route.stale else []

    def _watch(self, now: float) -> list[Any]:
        """Return requests that check periodically whether the stored mission is still the one on board."""
        route, count = self.craft.route, len(self.craft.route.items)
        if not self._dialect.probe:
            if now - self._watch_at > max(AGAIN_S, AGAIN_ITEM_S * count):
                self._watch_at, route.stale = now, True
                self._mission_list.reset()
            return []
        if not count or now - self._watch_at < (PROOF_S if route.unproven else WATCH_S):
            return []
        self._watch_at, self._watched = now, (self._watched + 1) % count
        seq = min(route.unproven, default=self._watched)
        return [dialect.MAVLink_mission_request_int_message(*self._to, seq)]

    def _params(self, now: float) -> list[Any]:
        if self._recall is not None and not self._recall.over:
            return self._recall.ask(now)
        book, missing = self.craft.params, self.craft.params.missing()
        if book.complete or now - max(book.heard, self._params_at) < RETRY_S:
            return []
        if missing is None or len(missing) > LIST_AGAIN:
            if not self._param_list.due(now):
                return []
            self._params_at = now
            return [dialect.MAVLink_param_request_list_message(*self._to)]
        self._params_at = now
        return [dialect.MAVLink_param_request_read_message(*self._to, b"", index) for index in missing[:PARAMS_AT_ONCE]]

    def _rates(self, now: float, share: float) -> list[Any]:
        if share != self._share:
            self._share, self._rate_tries = share, 0
            self._rate_wait.reset()
        if now - self._since < RATES_AFTER_S or self._rate_tries >= RATE_TRIES:
            return []
        got, most = self.craft.rates, TOO_HIGH if share < 1.0 else float("inf")
        fitting = {name: hz * share for name, hz in WANTED_HZ.items()}
        wrong = [name for name, hz in fitting.items() if not TOO_LOW * hz <= got.get(name, 0.0) <= most * hz]
        if not wrong or not self._rate_wait.due(now):
            return []
        self._rate_tries += 1
        asked = [self._interval(name, fitting[name]) for name in wrong]
        if self._rate_tries == RATE_TRIES and self._dialect.streams:
            groups = {STREAMS[name]: round(max(fitting[name], 1.0)) for name in reversed(wrong)}
            asked += [dialect.MAVLink_request_data_stream_message(*self._to, *pair, 1) for pair in groups.items()]
        return asked

    def _interval(self, name: str, hz: float) -> Any:
        command = dialect.MAV_CMD_SET_MESSAGE_INTERVAL
        return dialect.MAVLink_command_long_message(*self._to, command, 0, _IDS[name], 1e6 / hz, 0, 0, 0, 0, 0)

    def _time(self, now: float) -> list[Any]:
        """Return a time request when due, to measure the round-trip time."""
        if now - self._trip_at < TRIP_S:
            return []
        self._trip_at = now
        return [dialect.MAVLink_timesync_message(0, round(now * 1e9))]
