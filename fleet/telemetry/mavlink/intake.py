"""Convert the bytes of one link to contract messages, without sockets or wall clock."""

from collections import Counter
from collections.abc import Callable, Hashable
from functools import partial
from typing import Any

import numpy as np

from fleet.bus.codec import Wire
from fleet.contract import Alert, Mission, Params, Sample, Status
from fleet.telemetry.mavlink.aircraft_link import LOST_S, Craft
from fleet.telemetry.mavlink.arrays.counts import HEARD
from fleet.telemetry.mavlink.arrays.fleet_arrays import Flock
from fleet.telemetry.mavlink.batch import lay
from fleet.telemetry.mavlink.collision import Collision
from fleet.telemetry.mavlink.heartbeat import is_aircraft
from fleet.telemetry.mavlink.microservices.route import MESSAGES
from fleet.telemetry.mavlink.parsing.decode import IDS, KINDS, Decoder, Frames, joined, kinds
from fleet.telemetry.mavlink.parsing.received import Heard, merged
from fleet.telemetry.mavlink.parsing.scan import COMPONENT, EXTRA, ID, SEQ, SYSTEM
from fleet.telemetry.mavlink.timing import time

MOST_UAVS = 2_000  # over all links
SECOND = "second sender for a live id"
NOT_YET = "no aircraft heartbeat yet"
MOST_EARLY = 4096  # messages of one system buffered until its first heartbeat
MOST_EARLY_ALL = 32_768  # the same for all systems of a link, about 25 MB
EARLY_S = 15.0  # maximum age of buffered messages; heartbeats arrive every second [s]
FORGET_S = 30.0  # silence after which an aircraft may be removed [s]
KNOWN_S = 30.0  # an aircraft received for this long is only removed for a new aircraft [s]

News = Sample | Status | Mission | Params | Alert
EARLY = MESSAGES | {"PARAM_VALUE", "HOME_POSITION"}  # sent once, therefore buffered; rows are repeated
SINGLE = np.zeros(len(EXTRA), bool)  # by message id: processed individually, not as table rows
SINGLE[[IDS[name] for name in (*EARLY, "HEARTBEAT", "STATUSTEXT", "AUTOPILOT_VERSION")]] = True
SINGLE[IDS["MISSION_CURRENT"]] = True  # also a table row
Claims = dict[int, Craft]
"""Aircraft that owns a UAV id, over all links of a gateway."""
Admit = Callable[[Frames, Counter[str]], Frames]
"""Remove frames that are not admitted, and count them by reason."""


class Intake:
    """Convert the bytes received on one link to contract messages.

    Args:
        offset: UAV id = MAVLink system id + offset
        id_owners: shared by the links of one gateway, to detect an id used on two links
        max_uavs: maximum number of UAVs over all these links
        admit: admission filter; None: no filter
    """

    def __init__(
        self, offset: int = 0, claims: Claims | None = None, most: int = MOST_UAVS, admit: Admit | None = None
    ) -> None:
        self.offset = offset
        self.refused: Counter[str] = Counter()  # valid frames rejected, by reason
        self.crafts: dict[int, Craft] = {}  # by MAVLink system id
        self.decoder = Decoder()
        self.flock = Flock(KINDS)
        self._claims: Claims = {} if claims is None else claims
        self._speakers = np.full(1 << 16, -1)  # aircraft number by system and component
        self._most, self._admit = most, admit
        self._heard: list[Heard] = []
        self._sorted: list[Frames] = []  # admitted, not yet processed
        self._collisions: dict[int, Collision] = {}  # by UAV id
        self._born: dict[int, int] = {}  # in this batch: frame number of the first heartbeat, by system
        self._rivals: set[int] = set()  # systems whose UAV id another link owns
        self._early: dict[int, list[tuple[float, Any]]] = {}  # messages before the first heartbeat, by system id
        self._early_n = 0  # number of these messages
        self._numbered: list[Craft] = []  # by number in the arrays, including removed aircraft
        self._met: dict[int, float] = {}  # registration time by system id [s since 1970]

    def hear(self, arrival: float, data: bytes, source: Hashable = None) -> None:
        """Receive bytes that arrived together; the next `flush` processes them.

        Args:
            arrival: fleet time of arrival [s since 1970]
            data: any bytes
            source: the sender, e.g. its UDP address; None on a stream with a single remote end
        """
        self.listen(Heard.of([(arrival, source, data)]))

    def listen(self, heard: Heard) -> None:
        """Receive many pieces of bytes; the next `flush` processes them."""
        self._heard.append(heard)

    def flush(self, now: float) -> list[News]:
        """Return the new messages; `now` is fleet time [s since 1970]."""
        return unpacked(self.pack(now))

    def pack(self, now: float) -> list[News | Wire]:
        """Return the new messages with encoded samples; `now` is fleet time [s since 1970]."""
        self.sort()
        self._digest_sorted()
        return self._take(now)

    def sort(self, keep: bool = True) -> Frames | None:
        """Decode the bytes received since the last call and return the admitted frames; None if there are none.

        Args:
            process_later: process them at the next `flush`
        """
        if not self._heard:
            return None
        frames = self.decoder.feed(merged(self._heard))
        self._heard.clear()
        if self._admit is not None:
            frames = self._admit(frames, self.refused)
        if not len(frames.at):
            return None
        if keep:
            self._sorted.append(frames)
        return frames

    def overhear(self, frames: Frames) -> None:
        """Process frames from ground stations to the aircraft of this link, without registering aircraft or senders."""
        which = np.flatnonzero(SINGLE[frames.at[:, ID]])
        if len(which):
            self._digest_sorted()  # the target may be registered by a pending frame
        for i, message in zip(which.tolist(), frames.messages(which), strict=True):
            craft, arrival = self.crafts.get(message.get_srcSystem()), float(frames.arrival[i])
            if craft is not None and craft.component == message.get_srcComponent():
                self._alarm(craft, arrival, frames.senders[frames.sender[i]])
            elif message.get_type() in MESSAGES:
                target = self.crafts.get(getattr(message, "target_system", 0))
                if target is not None:
                    target.queue(arrival, target.overhear, message)

    def part(self, source: Hashable) -> None:
        """Release the aircraft of a sender that disconnected: the next sender of their ids takes over."""
        self.sort()
        self._digest_sorted()
        for craft in self.crafts.values():
            if craft.source == source:
                craft.source = None

    def _digest_sorted(self) -> None:
        if self._sorted:
            self.digest(joined(self._sorted))
            self._sorted.clear()

    def forget(self, now: float) -> list[int]:
        """Remove silent aircraft at `now` [s since 1970]; return their UAV ids.

        An aircraft received for less than `PROBATION_S` is removed after `SILENCE_LIMIT_S` of silence, any other when a
        new aircraft replaces it.
        """
        for system in [system for system, kept in self._early.items() if now - kept[0][0] > EARLY_S]:
            self.refused[NOT_YET] += len(self._pop_early(system))
        gone = []
        for system, craft in list(self.crafts.items()):
            brief = craft.heard - self._met[system] < KNOWN_S and now - craft.heard > FORGET_S
            if brief or self._claims.get(craft.uav) is None:
                self._drop(system, craft)
                gone.append(craft.uav)
        return gone

    def _drop(self, system: int, craft: Craft) -> None:
        """Remove one aircraft; its number stays reserved for its system id."""
        del self.crafts[system], self._met[system]
        if self._claims.get(craft.uav) is craft:
            del self._claims[craft.uav]
        self._collisions.pop(craft.uav, None)
        self._rivals.discard(system)
        self._speakers[(system << 8) + craft.component] = -1
        self.flock.reset(craft.number)
        self._numbered[craft.number] = Craft(self.flock, craft.uav, system, craft.component, number=craft.number)

    def take(self, now: float) -> list[News]:
        """Return the messages of processed frames that arrived up to `now` [s since 1970]."""
        return unpacked(self._take(now))

    def _take(self, now: float) -> list[News | Wire]:
        news: list[News | Wire] = [alert for one in self._collisions.values() for alert in one.take(now)]
        samples, crafts, due = self.flock.take(now), self._numbered, set(self.flock.due(now))
        for number in sorted(due.union(samples)):
            craft = crafts[number]
            if self._claims.get(craft.uav) is craft:
                if number in samples:
                    news.append(samples[number])
                if number in due:
                    news += craft.take(now)
        return news

    def digest(self, frames: Frames) -> None:
        """Process a batch of frames; `collect` returns the resulting messages."""
        if not len(frames.at):
            return
        which = np.flatnonzero(SINGLE[frames.at[:, ID]])
        said = (which.tolist(), frames.arrival[which].tolist(), frames.messages(which), frames.sender[which].tolist())
        for i, arrival, message, sender in zip(*said, strict=True):
            self._route(i, arrival, message, frames.senders[sender])
        owner = self._owners(frames)
        self._born.clear()
        mine = np.flatnonzero(owner >= 0)
        if len(mine):
            self.flock.counts.note(owner[mine], kinds(frames)[mine], frames.arrival[mine], frames.at[mine, SEQ])
            lay(frames, owner, self._numbered, self.flock)
            time(frames, owner, [craft.timing for craft in self._numbered])

    def _owners(self, frames: Frames) -> np.ndarray:
        """Return the aircraft number of each frame, -1 without owner, (n,)."""
        crafts = self._numbered
        number = {sender: k for k, sender in enumerate(frames.senders)}
        rightful = [self._claims.get(craft.uav, craft) is craft for craft in crafts]
        pairs = zip(crafts, rightful, strict=True)
        expected = np.array([number.get(craft.source, -1) if holds else -1 for craft, holds in pairs] + [-1])
        owner = self._speakers[(frames.at[:, SYSTEM] << 8) + frames.at[:, COMPONENT]]
        owner[(owner >= 0) & (expected[owner] != frames.sender)] = -1
        heard, known = self.flock.counts.state, np.flatnonzero(owner >= 0)
        heard[owner[known], HEARD] = frames.arrival[known]
        for which in _by_speaker(frames, np.flatnonzero(owner < 0)):
            craft = self._speaker(frames, which)
            if craft is not None:
                owner[which] = craft.number
                heard[craft.number, HEARD] = frames.arrival[which[-1]]
        for system, i in self._born.items():
            owner[:i][frames.at[:i, SYSTEM] == system] = -1
        return owner

    def counters(self) -> Counter[str]:
        """Return messages, bad_bytes and bad_frames over all senders."""
        return self.decoder.counters()

    def _speaker(self, frames: Frames, which: np.ndarray) -> Craft | None:
        """Return the owner of frames from one component of one sender; count them as rejected without owner."""
        system, component = frames.at[which[0], (SYSTEM, COMPONENT)].tolist()
        source, arrival = frames.senders[frames.sender[which[0]]], float(frames.arrival[which[-1]])
        craft = self.crafts.get(system)
        rows = int((~SINGLE[frames.at[which, ID]]).sum())
        if craft is not None and craft.component == component:
            return craft if self._may_speak(craft, source, arrival, rows) else None
        if rows:
            self.refused[SECOND if system in self._rivals else "not an autopilot" if craft else NOT_YET] += rows
        return None

    def _route(self, i: int, arrival: float, message: Any, source: Hashable) -> None:
        system, component = message.get_srcSystem(), message.get_srcComponent()
        craft = self.crafts.get(system)
        if craft is not None and craft.component == component:
            if self._may_speak(craft, source, arrival):
                craft.queue(arrival, craft.hear, message)
        elif craft is None and message.get_type() == "HEARTBEAT" and is_aircraft(message):
            self._meet(i, arrival, message, source)
        else:
            self._overhear(arrival, message)

    def _meet(self, i: int, arrival: float, message: Any, source: Hashable) -> None:
        system = message.get_srcSystem()
        uav = system + self.offset
        holder = self._claims.get(uav)
        if system == 0 or uav < 0:
            self.refused["id out of range"] += 1
        elif holder is None and len(self._claims) >= self._most and not self._make_room(arrival):
            self.refused[f"more than {self._most} aircraft; raise --most-uavs"] += 1
        elif holder is not None and arrival - holder.heard < LOST_S:
            self._rivals.add(system)
            self._alarm(holder, arrival, source)
        else:
            self._rivals.discard(system)
            craft = self._take_in(uav, system, message.get_srcComponent(), source)
            self.crafts[system] = self._claims[uav] = craft
            self._met[system] = self.flock.counts.state[craft.number, HEARD] = arrival
            self._speakers[(system << 8) + craft.component] = craft.number
            self._born[system] = i
            craft.meet(message)
            for early_arrival, early in self._pop_early(system):
                if early.get_srcComponent() == craft.component:
                    craft.queue(early_arrival, craft.hear, early)
            craft.queue(arrival, craft.hear, message)

    def _take_in(self, uav: int, system: int, component: int, source: Hashable) -> Craft:
        """Create an aircraft; reuse the previous number of its system id, if any."""
        number = next((one.number for one in self._numbered if one.system == system), None)
        craft = Craft(self.flock, uav, system, component, source, number=number)
        if number is None:
            self._numbered.append(craft)
        else:
            self._numbered[number] = craft
            self.flock.look[number] = -np.inf
        return craft

    def _make_room(self, arrival: float) -> bool:
        """Evict the aircraft silent for longest on any link, if silent for more than `SILENCE_LIMIT_S`."""
        longest = min(self._claims.values(), key=lambda craft: craft.heard)
        if arrival - longest.heard <= FORGET_S:
            return False
        del self._claims[longest.uav]  # the receiver of its link removes it
        return True

    def _may_speak(self, craft: Craft, source: Hashable, arrival: float, count: int = 1) -> bool:
        """Return whether this sender owns its id; a second sender takes over when the first is silent."""
        holder = self._claims.get(craft.uav, craft)
        if holder is craft and craft.source == source:
            return True
        freed = holder is craft and craft.source is None  # its sender disconnected
        if arrival - holder.heard < LOST_S and not freed:
            self._alarm(holder, arrival, source, count)
            return False
        self._claims[craft.uav], craft.source = craft, source
        return True

    def _alarm(self, craft: Craft, arrival: float, source: Hashable, count: int = 1) -> None:
        self.refused[SECOND] += count
        self._collisions.setdefault(craft.uav, Collision(craft.uav)).note(arrival, craft.source, source)
        words = "a second sender uses this id and is rejected; give every aircraft its own MAVLink system id"
        craft.queue(arrival, partial(craft.say, words))

    def _overhear(self, arrival: float, message: Any) -> None:
        name = message.get_type()
        target = self.crafts.get(getattr(message, "target_system", 0))
        if name in MESSAGES and target is not None:
            target.queue(arrival, target.overhear, message)
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
        """Buffer messages of a system until its heartbeat identifies it."""
        system = message.get_srcSystem()
        room = len(self._early.get(system, ())) < MOST_EARLY and self._early_n < MOST_EARLY_ALL
        if room and message.get_type() in EARLY:
            self._early.setdefault(system, []).append((arrival, message))
            self._early_n += 1
        else:
            self.refused[NOT_YET] += 1

    def _pop_early(self, system: int) -> list[tuple[float, Any]]:
        kept = self._early.pop(system, [])
        self._early_n -= len(kept)
        return kept


def unpacked(news: list[News | Wire]) -> list[News]:
    """Decode the encoded messages."""
    return [one.message() if isinstance(one, Wire) else one for one in news]


def _by_speaker(frames: Frames, which: np.ndarray) -> list[np.ndarray]:
    """Group frame numbers by sender, system and component, in order."""
    if not len(which):
        return []
    at = frames.at[which]
    key = (frames.sender[which] << 16) + (at[:, SYSTEM] << 8) + at[:, COMPONENT]
    order = np.argsort(key, kind="stable")
    return np.split(which[order], np.flatnonzero(np.diff(key[order])) + 1)
