"""Main thread of the gateway: queue -> decode -> intake -> bus, and requests to the aircraft."""

import gc
import queue
import threading
import time
from collections.abc import Callable, Hashable, Sequence
from functools import partial

import msgspec

from fleet.bus.codec import EncodedMessage
from fleet.bus.session import Bus
from fleet.config import MAX_UAVS
from fleet.contract import Message
from fleet.process.logs import report_status
from fleet.telemetry.mavlink.aircraft_link import AircraftLink
from fleet.telemetry.mavlink.intake import MavlinkReceiver
from fleet.telemetry.mavlink.parsing.received import ReceivedBytes
from gateway.admission import Admission, make_admissions
from gateway.commands.audit import AuditLog
from gateway.commands.executor import CommandExecutor
from gateway.forwarding import FrameForwarder
from gateway.links.link import QUEUE, Batch, Endpoint, wall
from gateway.onboard import RequestSender
from gateway.onboard.parameter_cache_check import Cache
from gateway.onboard.questions import budget_of
from gateway.publication import Publisher
from gateway.record.recorder import LinkRecorder, RecordedQueue
from gateway.status import StatisticsCollector

TICK_S = 0.1  # between two publications of a live link [s]
TICK_LAG_S = 0.01  # from a multiple of `TICK_S`, at which busy links receive, to the publication [s]
IDLE_WAIT_S = 0.02  # wait at an empty queue [s]
FLUSH_BYTES = 1 << 20  # bytes received that trigger a publication before the next tick, as in a flood
STATISTICS_S = 1.0  # between two publications of statistics [s]


class Pipeline:
    """Processing between the links and the bus.

    Args:
        links: opened links, those to aircraft first
        bus: destination of messages
        listen_only: send nothing to aircraft
        admissions: admission of each link; None: message filters only, without signatures
        stations: number of links to other ground stations, the last ones
        max_uavs: maximum number of UAVs
        recorder: records everything received and sent; the caller closes it
        budget: bytes/s that the aircraft of one link may send together; empty: default of the link kind
        cache: parameters and missions of earlier connections; None: no cache
    """

    def __init__(
        self,
        links: Sequence[Endpoint],
        bus: Bus,
        listen_only: bool = False,
        *,
        admissions: Sequence[Admission] | None = None,
        stations: int = 0,
        max_uavs: int = MAX_UAVS,
        recorder: LinkRecorder | None = None,
        budget: str = "",
        cache: Cache | None = None,
    ) -> None:
        self.links = links
        self.forwarder = FrameForwarder(links, stations, listen_only)
        self._admissions = admissions or make_admissions([link.spec for link in links], stations)
        self._unforwarded: set[int] = set()  # links with frames to forward
        self._new_bytes = 0  # bytes received since the last publication
        self._stations = range(len(links) - stations, len(links))
        self.statistics = StatisticsCollector(links, recorder)
        self.publisher = Publisher(bus, results=any(link.spec.results for link in links))
        self._aircraft_by_uav: dict[int, AircraftLink] = {}
        self.intakes = [
            MavlinkReceiver(link.spec.offset, self._aircraft_by_uav, max_uavs, admission.admit)
            for link, admission in zip(links, self._admissions, strict=True)
        ]
        self._requesters = [RequestSender(budget_of(link.spec, budget), cache) for link in links]
        self._listen_only = listen_only
        self.executor: CommandExecutor | None = None  # sends approved commands
        self._recorder = recorder
        self._queue: queue.Queue[Batch] = RecordedQueue(QUEUE, recorder)
        self._open = set(range(len(links)))
        to_aircraft = links[: self._stations.start]
        self._live = [number for number, link in enumerate(to_aircraft) if link.spec.kind != "replay"]
        self._newest_recorded_t = float("-inf")  # newest recorded time [s since 1970]
        self._replayed_uavs: set[int] = set()  # UAV ids of recordings

    def run(self, stop: threading.Event) -> None:
        """Run until `stop` is set or every recording has ended; then stop the threads of the links."""
        for number, link in enumerate(self.links):
            link.start(number, self._queue, stop)
        try:
            statistics_due = time.monotonic()
            tick_due = statistics_due - statistics_due % TICK_S + TICK_LAG_S
            while self._open and not stop.is_set():
                self._drain(tick_due, stop)
                now = time.monotonic()
                if now >= tick_due or self._new_bytes >= FLUSH_BYTES:
                    self._tick(now)
                    tick_due = max(tick_due + TICK_S, time.monotonic() + TICK_S / 2)  # leave time for the queue
                if now >= statistics_due:
                    statistics_due = now + STATISTICS_S
                    self._publish_statistics()
            self._publish_statistics()
        finally:
            stop.set()
            for link in self.links:
                link.close()

    def take(self, batch: Batch) -> None:
        """Process one batch."""
        intake = self.intakes[batch.link]
        if batch.received is not None:
            self.statistics.add(batch.link, batch.received)
            intake.receive_batch(batch.received)
            self._new_bytes += batch.size
            self._unforwarded.add(batch.link)
        if batch.left_peer is not None:
            self._forward_pending()
            intake.release_sender(batch.left_peer)
            self.forwarder.remove_peer(batch.link, batch.left_peer)
        if batch.messages:
            self._newest_recorded_t = max(self._newest_recorded_t, *(message.t for message in batch.messages))
            self._replayed_uavs.update(news.uav for news in batch.messages if isinstance(news, Message))
            self.publisher.publish(batch.messages)
        if batch.copies:
            self._replayed_uavs.update(wire.uav for wire in batch.copies)
            self.publisher.put(batch.copies)
        if batch.ended:
            self._open.discard(batch.link)

    def _drain(self, until: float, stop: threading.Event) -> None:
        """Process the queue until the next tick is due, or `FLUSH_BYTES` were received.

        Args:
            until: on the monotonic clock [s]
        """
        while (remaining := until - time.monotonic()) > 0 and self._open and self._new_bytes < FLUSH_BYTES:
            try:
                self.take(self._queue.get_nowait())
            except queue.Empty:
                self._forward_pending()
                stop.wait(min(remaining, IDLE_WAIT_S))  # a wake-up per datagram costs more than its decoding

    def _forward_pending(self) -> None:
        """Forward frames received since the last call; do nothing without stations."""
        for number in self._unforwarded if self._stations else ():
            frames = self.intakes[number].decode(process_later=number not in self._stations)
            for aircraft, addressed in self.forwarder.forward(number, frames) if frames is not None else ():
                self.intakes[aircraft].process_uplink(addressed)  # it may contain a new mission
        self._unforwarded.clear()

    def _tick(self, mono: float) -> None:
        self._forward_pending()
        self._new_bytes = 0
        for number in self._live:
            intake, now = self.intakes[number], wall()
            messages = intake.flush_packed(now)
            if self.executor is not None:
                self.executor.observe(messages)
            self.publisher.put([message for message in messages if isinstance(message, EncodedMessage)])
            self.publisher.publish([one for one in messages if not isinstance(one, EncodedMessage)])
            if not self._listen_only:
                self._send_requests(number, now)
        if self.executor is not None and not self._listen_only:
            self._send_commands(self.executor, wall())
        self.publisher.repeat(mono)

    def enable_commands(
        self, bus: Bus, is_allowed: Callable[[int], bool], audit: AuditLog, *, dry_run: bool = False
    ) -> None:
        """Execute approved proposals.

        Args:
            bus: source of proposals and approvals
            is_allowed: whether a UAV may be commanded
            audit: audit of all commands
            dry_run: print the messages instead of sending them
        """
        report = partial(report_status, "gateway") if dry_run else None
        self.executor = CommandExecutor(bus, self._aircraft_by_uav, is_allowed, audit, report)

    def _send_requests(self, number: int, now: float) -> None:
        link, aircraft = self.links[number], self.intakes[number].aircraft.values()
        self._requesters[number].suspended = self.executor.transferring if self.executor is not None else ()
        for where, unsigned in self._requesters[number].tick(now, aircraft, link.known_peers):
            self._send(number, where, unsigned)

    def _send_commands(self, executor: CommandExecutor, now: float) -> None:
        """Send the messages of approved proposals; live links only."""
        for aircraft, message in executor.tick(now):
            for number in self._live:
                if self.intakes[number].aircraft.get(aircraft.system) is aircraft and aircraft.source is not None:
                    self._send(number, aircraft.source, self._requesters[number].pack(message))

    def _send(self, number: int, where: Hashable, unsigned: bytes) -> None:
        data = self._admissions[number].sign(unsigned)
        self.links[number].send(where, data)
        self.statistics.sent(number, len(data))
        if self._recorder is not None:
            self._recorder.add(number, ReceivedBytes.from_pieces([(wall(), ("sent", where), data)]))

    def _remove_silent(self, now: float) -> None:
        """Remove silent aircraft of live links; `now` is fleet time [s since 1970]."""
        removed = {uav for number in self._live for uav in self.intakes[number].remove_silent(now)}
        if removed:
            self.publisher.remove(removed - self._aircraft_by_uav.keys())
            gc.collect()  # an aircraft forms reference cycles, and automatic collection is rare

    def _publish_statistics(self) -> None:
        now = wall() if self._live else self._newest_recorded_t
        self._remove_silent(wall())
        self.forwarder.remove_silent(wall())
        account = self.statistics.account(
            now, self.intakes, self._replayed_uavs, self.publisher.session, self._requesters
        )
        refused, history_bytes = {**account.refused, **self.forwarder.refused}, self.publisher.history.size
        self.publisher.account(msgspec.structs.replace(account, refused=refused, history_bytes=history_bytes))
