"""The working thread: queue -> decode -> intake -> bus, and questions back to the aircraft."""

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
NAP_S = 0.02  # at an empty queue [s]
AT_ONCE = 1 << 20  # bytes heard between two publications; in a flood these come sooner than a tick
ACCOUNT_S = 1.0  # between two counts [s]


class Pump:
    """Everything one gateway does between its links and the bus.

    Args:
        links: opened links, those to aircraft first
        bus: where messages go
        listen_only: send nothing at all to aircraft
        gates: what each link lets in; None: whatever its sieve does, signed or not
        stations: how many of the last links lead to other ground stations
        most: UAVs at a time
        recorder: takes everything heard, and what the gateway itself says; closed by whoever made it
        budget: what the aircraft of one link may send together, as on the command line; empty: what suits the link
        cache: what aircraft told before; None: nothing is kept
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
        self._heard: set[int] = set()  # links with something to forward
        self._fresh = 0  # bytes heard since the last publication
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
        self._players: set[int] = set()  # UAV ids heard of in recordings

    def run(self, stop: threading.Event) -> None:
        """Work until `stop` is set or every recording has ended; the links' threads end with it."""
        for number, link in enumerate(self.links):
            link.start(number, self._queue, stop)
        try:
            tick = account = time.monotonic()
            while self._open and not stop.is_set():
                self._drain(tick, stop)
                mono = time.monotonic()
                if mono >= tick or self._fresh >= AT_ONCE:
                    self._tick(mono)
                    tick = max(tick + TICK_S, time.monotonic() + TICK_S / 2)  # the queue always gets its turn
                if mono >= account:
                    account = mono + ACCOUNT_S
                    self._tell()
            self._tell()
        finally:
            stop.set()
            for link in self.links:
                link.close()

    def take(self, batch: Batch) -> None:
        """Work through one batch."""
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
        """Work through the queue until the next tick is due, or `AT_ONCE` is there.

        Args:
            until: on the monotonic clock [s]
        """
        while (left := until - time.monotonic()) > 0 and self._open and self._fresh < AT_ONCE:
            try:
                self.take(self._queue.get_nowait())
            except queue.Empty:
                self._pass_on()
                stop.wait(min(left, NAP_S))  # waking up for every datagram would cost more than decoding it

    def _pass_on(self) -> None:
        """Forward what has been heard since the last time; without a station there is no hurry to look at it."""
        for number in self._heard if self._stations else ():
            frames = self.intakes[number].sort(keep=number not in self._stations)
            for aircraft, said in self.forward.take(number, frames) if frames is not None else ():
                self.intakes[aircraft].overhear(said)  # it may be a new mission
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
        """Forget who is silent, as far as the intakes of live links do; `now` is fleet time [s since 1970]."""
        gone = {uav for number in self._live for uav in self.intakes[number].forget(now)}
        if gone:
            self.publisher.forget(gone - self._claims.keys())
            gc.collect()  # an aircraft and its parts refer to each other, and cycles are looked for rarely

    def _tell(self) -> None:
        now = wall() if self._live else self._recorded
        self._forget(wall())
        self.forward.tidy(wall())
        shares = [onboard.share for onboard in self._onboards]
        account = self.tally.account(now, self.intakes, self._players, self.publisher.way, shares)
        refused, kept = {**account.refused, **self.forward.refused}, self.publisher.history.size
        self.publisher.account(msgspec.structs.replace(account, refused=refused, history_bytes=kept))
