"""Convert the bytes of one link to contract messages, without sockets or wall clock."""

from collections import Counter
from collections.abc import Callable, Hashable
from functools import partial
from typing import Any

import msgspec
import numpy as np

from fleet.bus.codec import EncodedMessage
from fleet.config import MAX_UAVS
from fleet.contract import Alert, Mission, Params, Sample, Status
from fleet.telemetry.mavlink.aircraft_link import LINK_LOST_S, AircraftLink
from fleet.telemetry.mavlink.arrays.counts import LAST_ARRIVAL
from fleet.telemetry.mavlink.arrays.fleet_arrays import NOT_REPEATED, AircraftArrays
from fleet.telemetry.mavlink.batch import process_table_rows
from fleet.telemetry.mavlink.heartbeat import SenderConflict, is_aircraft
from fleet.telemetry.mavlink.microservices.route import MISSION_MESSAGES
from fleet.telemetry.mavlink.parsing.decode import (
    IDS,
    MESSAGE_NAMES,
    Decoder,
    Frames,
    joined_frames,
    message_kinds,
    restore_message,
)
from fleet.telemetry.mavlink.parsing.received import ReceivedBytes, merge_received
from fleet.telemetry.mavlink.parsing.scan import COMPONENT, EXTRA, ID, PAYLOAD, SEQ, SIZE, SYSTEM
from fleet.telemetry.mavlink.targets import queue_targets
from fleet.telemetry.mavlink.timing import update_timings

SECOND_SENDER = "second sender for a live id"
NO_HEARTBEAT = "no aircraft heartbeat yet"
MAX_EARLY = 4096  # messages of one system buffered until its first heartbeat
MAX_EARLY_TOTAL = 32_768  # the same for all systems of a link, about 5 MB
EARLY_S = 15.0  # maximum age of buffered messages; heartbeats arrive every second [s]
SILENCE_LIMIT_S = 30.0  # silence after which an aircraft may be removed [s]
PROBATION_S = 30.0  # an aircraft received for this long is only removed for a new aircraft [s]

TelemetryMessage = Sample | Status | Mission | Params | Alert
EARLY_MESSAGES = MISSION_MESSAGES | {"PARAM_VALUE", "HOME_POSITION"}  # sent once, therefore buffered; rows are repeated
IS_SINGLE = np.zeros(len(EXTRA), bool)  # by message id: processed individually, not as table rows
IS_SINGLE[[IDS[name] for name in (*EARLY_MESSAGES, "HEARTBEAT", "STATUSTEXT", "AUTOPILOT_VERSION")]] = True
IS_SINGLE[[IDS[name] for name in ("COMMAND_ACK", "MISSION_REQUEST", "MISSION_REQUEST_INT")]] = True
_REPEATED = np.full(len(EXTRA), NOT_REPEATED)  # state messages, which an aircraft sends again and again
_REPEATED[[IDS["HEARTBEAT"], IDS["MISSION_CURRENT"]]] = 0, 1


class MavlinkReceiver:
    """Convert the bytes received on one link to contract messages.

    Args:
        offset: UAV id = MAVLink system id + offset
        id_owners: aircraft that owns a UAV id, shared by the links of a gateway to detect an id used on two links
        max_uavs: maximum number of UAVs over all these links
        admit: removes frames that are not admitted, and counts them by reason; None: all are admitted
    """

    def __init__(
        self,
        offset: int = 0,
        id_owners: dict[int, AircraftLink] | None = None,
        max_uavs: int = MAX_UAVS,
        admit: Callable[[Frames, Counter[str]], Frames] | None = None,
    ) -> None:
        self.offset = offset
        self.rejected: Counter[str] = Counter()  # valid frames rejected, by reason
        self.aircraft: dict[int, AircraftLink] = {}  # by MAVLink system id
        self.decoder = Decoder()
        self.arrays = AircraftArrays(MESSAGE_NAMES)
        self._id_owners = {} if id_owners is None else id_owners
        self._number_by_address = np.full(1 << 16, -1)  # aircraft number by system and component
        self._max_uavs, self._admit = max_uavs, admit
        self._received: list[ReceivedBytes] = []
        self._pending_frames: list[Frames] = []  # admitted, not yet processed
        self._conflicts: dict[int, SenderConflict] = {}  # by UAV id
        self._first_heartbeat: dict[int, int] = {}  # in this batch: frame number of the first heartbeat, by system
        self._conflicting_systems: set[int] = set()  # systems whose UAV id another link owns
        self._early: dict[int, list[bytes]] = {}  # packed messages before the first heartbeat, by system id
        self._early_count = 0  # number of these messages
        self._aircraft_by_number: list[AircraftLink] = []  # by number in the arrays, including removed aircraft
        self._registered_t: dict[int, float] = {}  # registration time by system id [s since 1970]
        self._number_by_system: dict[int, int] = {}  # aircraft number by system id, also of removed aircraft

    def receive(self, arrival: float, data: bytes, source: Hashable = None) -> None:
        """Receive bytes that arrived together; the next `flush` processes them.

        Args:
            arrival: fleet time of arrival [s since 1970]
            data: any bytes
            source: the sender, e.g. its UDP address; None on a stream with a single remote end
        """
        self.receive_batch(ReceivedBytes.from_pieces([(arrival, source, data)]))

    def receive_batch(self, received: ReceivedBytes) -> None:
        """Receive many pieces of bytes; the next `flush` processes them."""
        self._received.append(received)

    def flush(self, now: float) -> list[TelemetryMessage]:
        """Return the new messages; `now` is fleet time [s since 1970]."""
        return unpacked(self.flush_packed(now))

    def flush_packed(self, now: float) -> list[TelemetryMessage | EncodedMessage]:
        """Return the new messages with encoded samples; `now` is fleet time [s since 1970]."""
        self.decode()
        self._process_pending()
        return self._collect_packed(now)

    def decode(self, process_later: bool = True) -> Frames | None:
        """Decode the bytes received since the last call and return the admitted frames; None if there are none.

        Args:
            process_later: process them at the next `flush`
        """
        if not self._received:
            return None
        frames = self.decoder.decode(merge_received(self._received))
        self._received.clear()
        if self._admit is not None:
            frames = self._admit(frames, self.rejected)
        if not len(frames.headers):
            return None
        if process_later:
            self._pending_frames.append(frames)
        return frames

    def process_uplink(self, frames: Frames) -> None:
        """Process frames from ground stations to the aircraft of this link, without registering aircraft or senders."""
        frame_numbers = np.flatnonzero(IS_SINGLE[frames.headers[:, ID]])
        if len(frame_numbers):
            self._process_pending()  # the target may be registered by a pending frame
        for i, message in zip(frame_numbers.tolist(), frames.messages(frame_numbers), strict=True):
            link, arrival = self.aircraft.get(message.get_srcSystem()), float(frames.arrival[i])
            if link is not None and link.component == message.get_srcComponent():
                self._report_conflict(link, arrival, frames.senders[frames.sender[i]])
            elif message.get_type() in MISSION_MESSAGES:
                target = self.aircraft.get(getattr(message, "target_system", 0))
                if target is not None:
                    self.arrays.forget_payloads(target.number)
                    target.queue(arrival, target.process_uplink, message)

    def release_sender(self, source: Hashable) -> None:
        """Release the aircraft of a sender that disconnected: the next sender of their ids takes over."""
        self.decode()
        self._process_pending()
        for link in self.aircraft.values():
            if link.source == source:
                link.source = self.arrays.sources = None

    def _process_pending(self) -> None:
        if self._pending_frames:
            self.process(joined_frames(self._pending_frames))
            self._pending_frames.clear()

    def remove_silent(self, now: float) -> list[int]:
        """Remove silent aircraft at `now` [s since 1970]; return their UAV ids.

        An aircraft received for less than `PROBATION_S` is removed after `SILENCE_LIMIT_S` of silence, any other when a
        new aircraft replaces it.
        """
        oldest = {system: msgspec.msgpack.decode(buffered[0])[0] for system, buffered in self._early.items()}
        for system in [system for system, arrival in oldest.items() if now - arrival > EARLY_S]:
            self.rejected[NO_HEARTBEAT] += len(self._pop_early(system))
        removed = []
        for system, link in list(self.aircraft.items()):
            is_silent = now - link.last_arrival > SILENCE_LIMIT_S
            is_transient = is_silent and link.last_arrival - self._registered_t[system] < PROBATION_S
            if is_transient or self._id_owners.get(link.uav) is None:
                self._remove(system, link)
                removed.append(link.uav)
        return removed

    def _remove(self, system: int, link: AircraftLink) -> None:
        """Remove one aircraft; its number stays reserved for its system id."""
        del self.aircraft[system], self._registered_t[system]
        if self._id_owners.get(link.uav) is link:
            del self._id_owners[link.uav]
        self._conflicts.pop(link.uav, None)
        self._conflicting_systems.discard(system)
        self._number_by_address[(system << 8) + link.component] = -1
        self.arrays.reset_aircraft(link.number)
        self.arrays.sources = None
        removed = AircraftLink(self.arrays, link.uav, system, link.component, number=link.number)
        self._aircraft_by_number[link.number] = removed

    def collect(self, now: float) -> list[TelemetryMessage]:
        """Return the messages of processed frames that arrived up to `now` [s since 1970]."""
        return unpacked(self._collect_packed(now))

    def _collect_packed(self, now: float) -> list[TelemetryMessage | EncodedMessage]:
        messages: list[TelemetryMessage | EncodedMessage] = [
            alert for conflict in self._conflicts.values() for alert in conflict.take_alerts(now)
        ]
        samples, due = self.arrays.take_samples(now), np.flatnonzero(self.arrays.next_due_t <= now).tolist()
        owners, links = self._id_owners, self._aircraft_by_number
        messages += [wire for number, wire in samples.items() if owners.get(wire.uav) is links[number]]
        for link in [links[number] for number in due if owners.get(links[number].uav) is links[number]]:
            messages += link.collect(now)
        return messages

    def process(self, frames: Frames) -> None:
        """Process a batch of frames; `collect` returns the resulting messages."""
        if not len(frames.headers):
            return
        known = self._known_owners(frames)
        singles = np.flatnonzero(IS_SINGLE[frames.headers[:, ID]])
        headers = frames.headers[singles]
        payloads, kind = np.ascontiguousarray(headers[:, [PAYLOAD, SIZE]]), _REPEATED[headers[:, ID]]
        is_repeated = self.arrays.find_repeated(frames.buf, payloads, known[singles], kind)
        if not is_repeated.all():
            self._dispatch_all(frames, singles[~is_repeated])
            before, known = known[singles], self._known_owners(frames)
            is_changed = known[singles] != before  # of a new aircraft or sender nothing is a repetition
            if is_changed.any():
                self.arrays.forget_payloads(slice(None))
                self._dispatch_all(frames, singles[is_repeated & is_changed])
                known = self._known_owners(frames)
        owner = self._frame_owners(frames, known)
        self._first_heartbeat.clear()
        owned = np.flatnonzero(owner >= 0)
        if len(owned):
            self.arrays.counts.add_messages(
                owner[owned], message_kinds(frames)[owned], frames.arrival[owned], frames.headers[owned, SEQ]
            )
            process_table_rows(frames, owner, self._aircraft_by_number, self.arrays)
            queue_targets(frames, owner, self._aircraft_by_number)
            update_timings(frames, owner, self._aircraft_by_number)

    def _dispatch_all(self, frames: Frames, frame_numbers: np.ndarray) -> None:
        for i, message in zip(frame_numbers.tolist(), frames.messages(frame_numbers), strict=True):
            self._dispatch(i, float(frames.arrival[i]), message, frames.senders[frames.sender[i]])

    def _known_owners(self, frames: Frames) -> np.ndarray:
        """Return the number of the aircraft that each frame's sender owns, -1 without, (n,)."""
        if self.arrays.sources is None:
            index: dict[Hashable, int] = {}
            owners, links = self._id_owners, self._aircraft_by_number
            numbers = [index.setdefault(k.source, len(index)) if owners.get(k.uav) is k else -1 for k in links]
            self.arrays.sources = index, np.array([*numbers, -1])
        index, expected = self.arrays.sources
        sender = np.array([index.get(source, -2) for source in frames.senders])[frames.sender]
        owner = self._number_by_address[(frames.headers[:, SYSTEM] << 8) + frames.headers[:, COMPONENT]]
        owner[expected[owner] != sender] = -1
        return owner

    def _set_owner(self, uav: int, owner: AircraftLink) -> None:
        """Assign a UAV id to an aircraft, or update its sender."""
        self._id_owners.get(uav, owner).arrays.sources = owner.arrays.sources = None
        self._id_owners[uav] = owner

    def _frame_owners(self, frames: Frames, owner: np.ndarray) -> np.ndarray:
        """Return the aircraft number of each frame, -1 without owner, (n,); `owner`: as far as it is known."""
        counters, owned = self.arrays.counts.state, np.flatnonzero(owner >= 0)
        counters[owner[owned], LAST_ARRIVAL] = frames.arrival[owned]
        for group in _group_by_sender(frames, np.flatnonzero(owner < 0)):
            craft = self._group_owner(frames, group)
            if craft is not None:
                owner[group] = craft.number
                counters[craft.number, LAST_ARRIVAL] = frames.arrival[group[-1]]
        for system, i in self._first_heartbeat.items():
            owner[:i][frames.headers[:i, SYSTEM] == system] = -1
        return owner

    def _group_owner(self, frames: Frames, frame_numbers: np.ndarray) -> AircraftLink | None:
        """Return the owner of frames from one component of one sender; count them as rejected without owner."""
        system, component = frames.headers[frame_numbers[0], (SYSTEM, COMPONENT)].tolist()
        source, arrival = frames.senders[frames.sender[frame_numbers[0]]], float(frames.arrival[frame_numbers[-1]])
        link = self.aircraft.get(system)
        row_count = int((~IS_SINGLE[frames.headers[frame_numbers, ID]]).sum())
        if link is not None and link.component == component:
            return link if self._accept_sender(link, source, arrival, row_count) else None
        if row_count:
            reason = "not an autopilot" if link else NO_HEARTBEAT
            self.rejected[SECOND_SENDER if system in self._conflicting_systems else reason] += row_count
        return None

    def _dispatch(self, i: int, arrival: float, message: Any, source: Hashable) -> None:
        system, component = message.get_srcSystem(), message.get_srcComponent()
        link = self.aircraft.get(system)
        if link is not None and link.component == component:
            if self._accept_sender(link, source, arrival):
                link.queue(arrival, link.process, message)
        elif link is None and message.get_type() == "HEARTBEAT" and is_aircraft(message):
            self._register(i, arrival, message, source)
        else:
            self._process_foreign(arrival, message)

    def _register(self, i: int, arrival: float, message: Any, source: Hashable) -> None:
        system = message.get_srcSystem()
        uav = system + self.offset
        owner = self._id_owners.get(uav)
        if system == 0 or uav < 0:
            self.rejected["id out of range"] += 1
        elif owner is None and len(self._id_owners) >= self._max_uavs and not self._evict_oldest(arrival):
            self.rejected[f"more than {self._max_uavs} aircraft; raise --most-uavs"] += 1
        elif owner is not None and arrival - owner.last_arrival < LINK_LOST_S:
            self._conflicting_systems.add(system)
            self._report_conflict(owner, arrival, source)
        else:
            self._conflicting_systems.discard(system)
            link = self._create_aircraft(uav, system, message.get_srcComponent(), source)
            self._set_owner(uav, link)
            self.aircraft[system] = link
            self._registered_t[system] = self.arrays.counts.state[link.number, LAST_ARRIVAL] = arrival
            self._number_by_address[(system << 8) + link.component] = link.number
            self._first_heartbeat[system] = i
            link.update_identity(message)
            for early_arrival, early in self._pop_early(system):
                if early.get_srcComponent() == link.component:
                    link.queue(early_arrival, link.process, early)
            link.queue(arrival, link.process, message)

    def _create_aircraft(self, uav: int, system: int, component: int, source: Hashable) -> AircraftLink:
        """Create an aircraft; reuse the previous number of its system id, if any."""
        number = self._number_by_system.get(system)
        created = AircraftLink(self.arrays, uav, system, component, source, number=number)
        if number is None:
            self._aircraft_by_number.append(created)
            self._number_by_system[system] = created.number
        else:
            self._aircraft_by_number[number] = created
            self.arrays.next_due_t[number] = -np.inf
        return created

    def _evict_oldest(self, arrival: float) -> bool:
        """Evict the aircraft silent for longest on any link, if silent for more than `SILENCE_LIMIT_S`."""
        oldest = min(self._id_owners.values(), key=lambda link: link.last_arrival)
        if arrival - oldest.last_arrival <= SILENCE_LIMIT_S:
            return False
        del self._id_owners[oldest.uav]  # the receiver of its link removes it
        oldest.arrays.sources = None
        return True

    def _accept_sender(self, link: AircraftLink, source: Hashable, arrival: float, count: int = 1) -> bool:
        """Return whether this sender owns its id; a second sender takes over when the first is silent."""
        owner = self._id_owners.get(link.uav, link)
        if owner is link and link.source == source:
            return True
        is_released = owner is link and link.source is None  # its sender disconnected
        if arrival - owner.last_arrival < LINK_LOST_S and not is_released:
            self._report_conflict(owner, arrival, source, count)
            return False
        link.source = source
        self._set_owner(link.uav, link)
        return True

    def _report_conflict(self, link: AircraftLink, arrival: float, source: Hashable, count: int = 1) -> None:
        self.rejected[SECOND_SENDER] += count
        self._conflicts.setdefault(link.uav, SenderConflict(link.uav)).record_conflict(arrival, link.source, source)
        text = "a second sender uses this id and is rejected; give every aircraft its own MAVLink system id"
        link.queue(arrival, partial(link.set_operator_text, text))

    def _process_foreign(self, arrival: float, message: Any) -> None:
        name = message.get_type()
        target = self.aircraft.get(getattr(message, "target_system", 0))
        if name in MISSION_MESSAGES and target is not None:
            self.arrays.forget_payloads(target.number)
            target.queue(arrival, target.process_uplink, message)
        elif name == "HEARTBEAT":
            reason = "a second autopilot on one system id" if is_aircraft(message) else "not an aircraft"
            self.rejected[reason] += 1
        elif message.get_srcSystem() in self._conflicting_systems:
            self.rejected[SECOND_SENDER] += 1
        elif message.get_srcSystem() in self.aircraft:
            self.rejected["not an autopilot"] += 1
        else:
            self._buffer_early(arrival, message)

    def _buffer_early(self, arrival: float, message: Any) -> None:
        system = message.get_srcSystem()
        has_room = len(self._early.get(system, ())) < MAX_EARLY and self._early_count < MAX_EARLY_TOTAL
        if has_room and message.get_type() in EARLY_MESSAGES:
            packed = msgspec.msgpack.encode((arrival, message.get_type(), *message))
            self._early.setdefault(system, []).append(packed)
            self._early_count += 1
        else:
            self.rejected[NO_HEARTBEAT] += 1

    def _pop_early(self, system: int) -> list[tuple[float, Any]]:
        buffered, decode = self._early.pop(system, []), msgspec.msgpack.decode
        self._early_count -= len(buffered)
        return [(arrival, restore_message(name, values)) for arrival, name, *values in map(decode, buffered)]


def unpacked(messages: list[TelemetryMessage | EncodedMessage]) -> list[TelemetryMessage]:
    """Decode the encoded messages."""
    return [message.message() if isinstance(message, EncodedMessage) else message for message in messages]


def _group_by_sender(frames: Frames, frame_numbers: np.ndarray) -> list[np.ndarray]:
    """Group frame numbers by sender, system and component, in order."""
    if not len(frame_numbers):
        return []
    headers = frames.headers[frame_numbers]
    key = (frames.sender[frame_numbers] << 16) + (headers[:, SYSTEM] << 8) + headers[:, COMPONENT]
    order = np.argsort(key, kind="stable")
    return np.split(frame_numbers[order], np.flatnonzero(np.diff(key[order])) + 1)
