"""Everything between the bytes of one link and contract messages: no sockets, no wall clock."""

from collections import Counter, OrderedDict
from collections.abc import Hashable
from typing import Any

from fleet.contract import Mission, Params, Sample, Status
from fleet.telemetry.craft import LOST_S, Craft
from fleet.telemetry.decode import Decoder
from fleet.telemetry.heartbeat import is_aircraft
from fleet.telemetry.route import MESSAGES

MOST_UAVS = 250
SECOND = "second sender for a live id"
MOST_EARLY = 4096  # messages of one system kept until its first heartbeat; a recording may begin anywhere
MOST_SENDERS = 512  # addresses with a decoder of their own on one link

News = Sample | Status | Mission | Params
EARLY = MESSAGES | {"PARAM_VALUE"}  # said once, so worth keeping; rows come again
Claims = dict[int, Craft]
"""Which aircraft holds a UAV id, over all links of a gateway."""


class Intake:
    """Turn what one link heard into messages of the contract.

    Args:
        offset: UAV id = MAVLink system id + offset
        claims: shared by the links of one gateway, so that an id heard on two of them is noticed
    """

    def __init__(self, offset: int = 0, claims: Claims | None = None) -> None:
        self.offset = offset
        self.refused: Counter[str] = Counter()  # good frames refused, by reason
        self.crafts: dict[int, Craft] = {}  # by MAVLink system id
        self._claims: Claims = {} if claims is None else claims
        self._decoders: OrderedDict[Hashable, Decoder] = OrderedDict()
        self._rivals: set[int] = set()  # systems whose UAV id another link holds
        self._early: dict[int, list[tuple[float, Any]]] = {}  # before the first heartbeat, by system id
        self._gone: Counter[str] = Counter()  # counters of decoders no longer kept

    def hear(self, arrival: float, data: bytes, source: Hashable = None) -> None:
        """Take bytes that arrived together.

        Args:
            arrival: fleet time of arrival [s since 1970]
            data: any bytes
            source: who sent them, e.g. the UDP address; None on a stream with a single far end
        """
        for message in self._decoder(source).feed(data):
            self._route(arrival, message, source)

    def flush(self, now: float) -> list[News]:
        """Hand over what is new; `now` is fleet time [s since 1970]."""
        mine = [craft for craft in self.crafts.values() if self._claims.get(craft.uav) is craft]
        return [news for craft in mine for news in craft.take(now)]

    def counters(self) -> Counter[str]:
        """Give messages, bad_bytes and bad_frames over all senders."""
        total = Counter(self._gone)
        for decoder in self._decoders.values():
            total.update(_counters(decoder))
        return total

    def _decoder(self, source: Hashable) -> Decoder:
        decoder = self._decoders.get(source)
        if decoder is None:
            if len(self._decoders) >= MOST_SENDERS:
                self._gone.update(_counters(self._decoders.popitem(last=False)[1]))
            decoder = self._decoders[source] = Decoder()
        self._decoders.move_to_end(source)
        return decoder

    def _route(self, arrival: float, message: Any, source: Hashable) -> None:
        system, component = message.get_srcSystem(), message.get_srcComponent()
        craft = self.crafts.get(system)
        if craft is not None and craft.component == component:
            if self._may_speak(craft, source, arrival):
                craft.hear(arrival, message)
        elif craft is None and message.get_type() == "HEARTBEAT" and is_aircraft(message):
            self._meet(arrival, message, source)
        else:
            self._overhear(arrival, message)

    def _meet(self, arrival: float, message: Any, source: Hashable) -> None:
        system = message.get_srcSystem()
        uav = system + self.offset
        holder = self._claims.get(uav)
        if system == 0 or uav < 0:
            self.refused["id out of range"] += 1
        elif len(self.crafts) >= MOST_UAVS:
            self.refused[f"more than {MOST_UAVS} aircraft on one link"] += 1
        elif holder is not None and arrival - holder.heard < LOST_S:
            self._rivals.add(system)
            self._alarm(holder, arrival)
        else:
            self._rivals.discard(system)
            craft = Craft(uav, system, message.get_srcComponent(), source)
            self.crafts[system] = self._claims[uav] = craft
            craft.hear(arrival, message)
            for when, early in self._early.pop(system, ()):
                if early.get_srcComponent() == craft.component:
                    craft.hear(when, early)

    def _may_speak(self, craft: Craft, source: Hashable, arrival: float) -> bool:
        """Tell whether this is the one sender of its id; another takes over once that one is silent."""
        holder = self._claims.get(craft.uav, craft)
        if holder is craft and craft.source == source:
            return True
        if arrival - holder.heard < LOST_S:
            self._alarm(holder, arrival)
            return False
        self._claims[craft.uav], craft.source = craft, source
        return True

    def _alarm(self, craft: Craft, arrival: float) -> None:
        self.refused[SECOND] += 1
        craft.say(
            "a second sender uses this id and was refused; give every aircraft its own MAVLink system id", arrival
        )

    def _overhear(self, arrival: float, message: Any) -> None:
        name = message.get_type()
        target = self.crafts.get(getattr(message, "target_system", 0))
        if name in MESSAGES and target is not None:
            target.route.hear(message, up=True, now=arrival)
        elif name == "HEARTBEAT":
            reason = "a second autopilot on one system id" if is_aircraft(message) else "not an aircraft"
            self.refused[reason] += 1
        elif message.get_srcSystem() in self._rivals:
            self.refused[SECOND] += 1
        elif message.get_srcSystem() in self.crafts:
            self.refused["not an autopilot"] += 1
        else:
            self._keep_early(arrival, message)

    def _keep_early(self, arrival: float, message: Any) -> None:
        """Keep what a system says before it says what it is, in case it turns out to be an aircraft."""
        kept = self._early.setdefault(message.get_srcSystem(), [])
        if len(kept) < MOST_EARLY and message.get_type() in EARLY:
            kept.append((arrival, message))
        else:
            self.refused["no aircraft heartbeat yet"] += 1


def _counters(decoder: Decoder) -> dict[str, int]:
    return {"messages": decoder.messages, "bad_bytes": decoder.bad_bytes, "bad_frames": decoder.bad_frames}
