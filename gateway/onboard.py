"""What the gateway asks of an aircraft: parameters, mission, message rates; with patience, and never in a rush.

Source: MAVLink services "Parameter Protocol", "Mission Protocol", "Message interval".
"""

from collections.abc import Hashable, Iterable, Sequence
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.contract import Link
from fleet.telemetry.craft import Craft

# Other ground stations are 255: answers to us are not for them, and an aircraft that has lost them must notice.
SYSTEM, COMPONENT = 254, dialect.MAV_COMP_ID_MISSIONPLANNER
HEARTBEAT_S = 1.0
RETRY_S = 0.5  # for one item or a handful of parameters [s]
ITEM_TRIES = 20  # in vain, then the list is asked for again: it may have become shorter
FIRST_WAIT_S, LONGEST_WAIT_S = 1.0, 60.0  # for a whole list, doubled at every try [s]
ITEMS_AT_ONCE = {"ardupilot": 5}  # the others want one request at a time
PARAMS_AT_ONCE = 10
LIST_AGAIN = 200  # so many parameters missing are asked for as a list
RATES_AFTER_S = 5.0  # the first judgement of rates [s]
RATE_TRIES = 3
WANTED_HZ: dict[str, float] = {  # [Hz]
    "ATTITUDE": 25,
    "SERVO_OUTPUT_RAW": 20,
    "GLOBAL_POSITION_INT": 10,
    "VFR_HUD": 10,
    "NAV_CONTROLLER_OUTPUT": 5,
    "MISSION_CURRENT": 1,
}
TOO_LOW = 0.4  # share of the wanted rate below which a message is asked for
_IDS = {kind.msgname: number for number, kind in dialect.mavlink_map.items()}


class Patience:
    """When to try again: soon at first, then ever later."""

    def __init__(self, first_s: float = FIRST_WAIT_S) -> None:
        self._wait = self._first = first_s
        self._next = float("-inf")

    def due(self, now: float) -> bool:
        """Tell whether to try now; if so the next wait is doubled."""
        if now < self._next:
            return False
        self._next, self._wait = now + self._wait, min(2 * self._wait, LONGEST_WAIT_S)
        return True

    def reset(self) -> None:
        """Forget earlier failures."""
        self._wait, self._next = self._first, float("-inf")


class Questions:
    """What is still to be asked of one aircraft."""

    def __init__(self, craft: Craft, now: float) -> None:
        self.craft = craft
        self._to = (craft.system, craft.component)
        self._since = now
        self._param_list, self._mission_list = Patience(3.0), Patience()
        self._rate_wait, self._rate_tries = Patience(10.0), 0
        self._params_at = self._items_at = float("-inf")
        self._items_left: int | None = None
        self._item_tries = 0  # since the last item that came

    def ask(self, now: float) -> list[Any]:
        """Give the messages to send now."""
        return self._mission(now) + self._params(now) + self._rates(now)

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
            wanted = missing[: ITEMS_AT_ONCE.get(self.craft.autopilot, 1)]
            return [dialect.MAVLink_mission_request_int_message(*self._to, seq) for seq in wanted]
        if self._items_left is not None and not route.stale:
            self._items_left = None
            return [dialect.MAVLink_mission_ack_message(*self._to, dialect.MAV_MISSION_ACCEPTED)]
        if route.stale and self._mission_list.due(now):
            return [dialect.MAVLink_mission_request_list_message(*self._to)]
        return []

    def _params(self, now: float) -> list[Any]:
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

    def _rates(self, now: float) -> list[Any]:
        if now - self._since < RATES_AFTER_S or self._rate_tries >= RATE_TRIES:
            return []
        low = [name for name, hz in WANTED_HZ.items() if self.craft.rates.get(name, 0.0) < TOO_LOW * hz]
        if not low or not self._rate_wait.due(now):
            return []
        self._rate_tries += 1
        command = dialect.MAV_CMD_SET_MESSAGE_INTERVAL
        return [
            dialect.MAVLink_command_long_message(
                *self._to, command, 0, _IDS[name], 1e6 / WANTED_HZ[name], 0, 0, 0, 0, 0
            )
            for name in low
        ]


class Onboard:
    """The talking half of one link."""

    def __init__(self) -> None:
        self._mav = dialect.MAVLink(None, srcSystem=SYSTEM, srcComponent=COMPONENT)
        self._questions: dict[int, Questions] = {}
        self._beat = float("-inf")

    def tick(
        self, now: float, crafts: Iterable[Craft], greets: Sequence[Hashable] = ()
    ) -> list[tuple[Hashable, bytes]]:
        """Give (where to, bytes) of what is to be sent now.

        Args:
            now: fleet time [s since 1970]
            crafts: the aircraft of the link
            greets: far ends to greet even before they speak
        """
        live = [craft for craft in crafts if craft.link is Link.LIVE and craft.source is not None]
        out: list[tuple[Hashable, bytes]] = []
        if now - self._beat >= HEARTBEAT_S:
            self._beat = now
            kind, none = dialect.MAV_TYPE_GCS, dialect.MAV_AUTOPILOT_INVALID
            beat = dialect.MAVLink_heartbeat_message(kind, none, 0, 0, dialect.MAV_STATE_ACTIVE, 3)
            out += [(source, self._pack(beat)) for source in dict.fromkeys([*greets, *(c.source for c in live)])]
        for craft in live:
            asked = self._questions.get(craft.system)
            if asked is None or asked.craft is not craft:
                asked = self._questions[craft.system] = Questions(craft, now)
            out += [(craft.source, self._pack(message)) for message in asked.ask(now)]
        return out

    def _pack(self, message: Any) -> bytes:
        packed = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        return packed
