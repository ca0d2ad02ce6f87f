"""Requests to the aircraft of one link, limited to the capacity of the link."""

from collections.abc import Hashable, Iterable, Sequence
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.contract import Link
from fleet.telemetry.mavlink.aircraft_link import Craft
from gateway.onboard.cache import Cache
from gateway.onboard.questions import Questions
from gateway.onboard.rates import Share

# Other ground stations use 255: they must not receive our answers, and an aircraft must detect the loss of theirs.
SYSTEM, COMPONENT = 254, dialect.MAV_COMP_ID_MISSIONPLANNER
HEARTBEAT_S = 1.0


class Onboard:
    """Sender of heartbeats and requests on one link.

    Args:
        budget: rate at which its aircraft may send together [bytes/s]
        cache: parameters and missions of earlier connections; None: no cache
    """

    def __init__(self, budget: float = float("inf"), cache: Cache | None = None) -> None:
        self.share = Share(budget)
        self._cache = cache
        self._mav = dialect.MAVLink(None, srcSystem=SYSTEM, srcComponent=COMPONENT)
        self._questions: dict[int, Questions] = {}
        self._beat = float("-inf")

    def tick(
        self, now: float, crafts: Iterable[Craft], greets: Sequence[Hashable] = ()
    ) -> list[tuple[Hashable, bytes]]:
        """Return the messages to send now: (peer, bytes).

        Args:
            now: fleet time [s since 1970]
            all_aircraft: the aircraft of the link
            known_peers: peers that get a heartbeat before they send
        """
        live = [craft for craft in crafts if craft.link is Link.LIVE and craft.source is not None]
        out: list[tuple[Hashable, bytes]] = []
        if now - self._beat >= HEARTBEAT_S:
            self._beat = now
            kind, none = dialect.MAV_TYPE_GCS, dialect.MAV_AUTOPILOT_INVALID
            beat = dialect.MAVLink_heartbeat_message(kind, none, 0, 0, dialect.MAV_STATE_ACTIVE, 3)
            out += [(source, self._pack(beat)) for source in dict.fromkeys([*greets, *(c.source for c in live)])]
        share = self.share.weigh(live)
        for craft in live:
            asked = self._questions.get(craft.system)
            if asked is None or asked.craft is not craft:
                asked = self._questions[craft.system] = Questions(craft, now, self._cache)
            out += [(craft.source, self._pack(message)) for message in asked.ask(now, share)]
        return out

    def _pack(self, message: Any) -> bytes:
        packed = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        return packed
