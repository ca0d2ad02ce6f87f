"""Main thread of the gateway: queue -> decode -> intake -> bus, and requests to the aircraft."""

import gc
import queue
import threading
import time
from collections.abc import Hashable, Sequence

import msgspec

from fleet.bus.bus_protocol import Bus
from fleet.bus.codec import Wire
from fleet.contract import Message
from fleet.telemetry.mavlink.aircraft_link import Craft
from fleet.telemetry.mavlink.intake import MOST_UAVS, Intake
from fleet.telemetry.mavlink.parsing.received import Heard
from gateway.admission.admission import Gate, gates_of
from gateway.forwarding.forward import Forward
from gateway.links.link import QUEUE, Batch, Link, wall
from gateway.onboard import Onboard
from gateway.onboard.cache import Cache
from gateway.onboard.rates import budget_of
from gateway.publication.publish import Publisher
from gateway.record.recorder import Recorder, Tapped
from gateway.status.link_statistics import Tally

TICK_S = 0.1  # between two publications of a live link [s]
NAP_S = 0.02  # wait at an empty queue [s]
AT_ONCE = 1 << 20  # bytes received that trigger a publication before the next tick, as in a flood
ACCOUNT_S = 1.0  # between two publications of statistics [s]


class Pump:
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
        links: Sequence[Link],
        bus: Bus,
        listen_only: bool = False,
        *,
        gates: Sequence[Gate] | None = None,
        stations: int = 0,
        most: int = MOST_UAVS,
        recorder: Recorder | None = None,
        budget: str = "",
        cache: Cache | None = None,
    ) -> None:
        self.links = links
        self.forward = Forward(links, stations, listen_only)
        self._gates = gates_of([link.spec for link in links], stations) if gates is None else gates
        self._heard: set[int] = set()  # links with frames to forward
        self._fresh = 0  # bytes received since the last publication
        self._stations = range(len(links) - stations, len(links))
        self.tally = Tally(links, recorder)
        self.publisher = Publisher(bus, results=any(link.spec.results for link in links))
        claims = self._claims = dict[int, Craft]()
        self.intakes = [
            Intake(link.spec.offset, claims, most, gate.admit) for link, gate in zip(links, self._gates, strict=True)
        ]
        self._onboards = [Onboard(budget_of(link.spec, budget), cache) for link in links]
        self._listen_only = listen_only
        self._recorder = recorder
        self._queue: queue.Queue[Batch] = Tapped(QUEUE, recorder)
        self._open = set(range(len(links)))
        to_aircraft = links[: self._stations.start]
        self._live = [number for number, link in enumerate(to_aircraft) if link.spec.kind != "replay"]
        self._recorded = float("-inf")  # newest recorded time [s since 1970]
        self._players: set[int] = set()  # UAV ids of recordings

    def run(self, stop: threading.Event) -> None:
        """Run until `stop` is set or every recording has ended; then stop the threads of the links."""
        for number, link in enumerate(self.links):
            link.start(number, self._queue, stop)
        try:
            tick = account = time.monotonic()
            while self._open and not stop.is_set():
                self._drain(tick, stop)
                mono = time.monotonic()
                if mono >= tick or self._fresh >= AT_ONCE:
                    self._tick(mono)
                    tick = max(tick + TICK_S, time.monotonic() + TICK_S / 2)  # leave time for the queue
                if mono >= account:
                    account = mono + ACCOUNT_S
                    self._tell()
            self._tell()
        finally:
            stop.set()
            for link in self.links:
                link.close()

    def take(self, batch: Batch) -> None:
        """Process one batch."""
        intake = self.intakes[batch.link]
        if batch.heard is not None:
            self.tally.add(batch.link, batch.heard)
            intake.listen(batch.heard)
            self._fresh += batch.size
            self._heard.add(batch.link)
        if batch.gone is not None:
            self._pass_on()
            intake.part(batch.gone)
            self.forward.part(batch.link, batch.gone)
        if batch.news:
            self._recorded = max(self._recorded, *(news.t for news in batch.news))
            self._players.update(news.uav for news in batch.news if isinstance(news, Message))
            self.publisher.publish(batch.news)
        if batch.copies:
            self._players.update(wire.uav for wire in batch.copies)
            self.publisher.put(batch.copies)
        if batch.ended:
            self._open.discard(batch.link)

    def _drain(self, until: float, stop: threading.Event) -> None:
        """Process the queue until the next tick is due, or `FLUSH_BYTES` were received.

        Args:
            until: on the monotonic clock [s]
        """
        while (left := until - time.monotonic()) > 0 and self._open and self._fresh < AT_ONCE:
            try:
                self.take(self._queue.get_nowait())
            except queue.Empty:
                self._pass_on()
                stop.wait(min(left, NAP_S))  # a wake-up per datagram costs more than its decoding

    def _pass_on(self) -> None:
        """Forward frames received since the last call; do nothing without stations."""
        for number in self._heard if self._stations else ():
            frames = self.intakes[number].sort(keep=number not in self._stations)
            for aircraft, said in self.forward.take(number, frames) if frames is not None else ():
                self.intakes[aircraft].overhear(said)  # it may contain a new mission
        self._heard.clear()

    def _tick(self, mono: float) -> None:
        self._pass_on()
        self._fresh = 0
        for number in self._live:
            intake, link, gate, now = self.intakes[number], self.links[number], self._gates[number], wall()
            news = intake.pack(now)
            self.publisher.put([one for one in news if isinstance(one, Wire)])
            self.publisher.publish([one for one in news if not isinstance(one, Wire)])
            if not self._listen_only:
                for where, data in self._onboards[number].tick(now, intake.crafts.values(), link.greets):
                    self._say(number, where, gate.sign(data))
        self.publisher.repeat(mono)

    def _say(self, number: int, where: Hashable, data: bytes) -> None:
        self.links[number].send(where, data)
        self.tally.sent(number, len(data))
        if self._recorder is not None:
            self._recorder.hear(number, Heard.of([(wall(), ("sent", where), data)]))

    def _forget(self, now: float) -> None:
        """Remove silent aircraft of live links; `now` is fleet time [s since 1970]."""
        gone = {uav for number in self._live for uav in self.intakes[number].forget(now)}
        if gone:
            self.publisher.forget(gone - self._claims.keys())
            gc.collect()  # an aircraft forms reference cycles, and automatic collection is rare

    def _tell(self) -> None:
        now = wall() if self._live else self._recorded
        self._forget(wall())
        self.forward.tidy(wall())
        shares = [onboard.share for onboard in self._onboards]
        account = self.tally.account(now, self.intakes, self._players, self.publisher.way, shares)
        refused, kept = {**account.refused, **self.forward.refused}, self.publisher.history.size
        self.publisher.account(msgspec.structs.replace(account, refused=refused, history_bytes=kept))
