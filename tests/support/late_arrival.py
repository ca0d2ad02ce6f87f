"""One simulated flight whose telemetry arrives as from a simulator that is slow, fast or paused; heard by a worker."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fleet.bus.codec import EncodedMessage
from fleet.contract import Alert, AlertKind, Message, Prediction, Sample, Status
from fleet.simulator.flight.uav import SimulatedUav
from fleet.telemetry.mavlink.intake import MavlinkReceiver, unpacked
from tests.support.memory_bus import MemoryBus
from twin_worker.service.worker import Worker

T0 = 1_700_000_000.0  # arrival of the first datagram [s since 1970]
TICK_S = 0.1  # between two publications of a gateway [s]
BEGIN_S = 10.0  # after which predictions are expected [s]
Datagram = tuple[float, bytes]


@dataclass(frozen=True)
class Arrival:
    """When what is simulated at a time arrives.

    Attributes:
        speed: simulated seconds per second of real time
        pauses: simulated time and length of pauses in which simulated time stands still [s]
    """

    speed: float = 1.0
    pauses: tuple[tuple[float, float], ...] = ()

    def at(self, t: float) -> float:
        """Give the arrival of what is simulated at `t` [s], since the first."""
        return t / self.speed + sum(length for begin, length in self.pauses if t >= begin)


ARRIVALS = {
    "1": Arrival(),
    "0.5": Arrival(0.5),
    "0.8": Arrival(0.8),
    "0.97": Arrival(0.97),
    "1.5": Arrival(1.5),
    "pauses of 10 s": Arrival(pauses=((40.0, 10.0), (80.0, 10.0))),
    "lag of 30 s": Arrival(pauses=((30.0, 30.0),)),
}


def flight(seconds: float, seed: int = 1, uav_id: int = 0) -> list[Datagram]:
    """Simulate one fixed wing: what it sends, and when [s]."""
    uav = SimulatedUav(uav_id, seed)
    sent = [(0.0, frame) for frame in uav.initial_frames()]
    for k in range(1, int(seconds / 0.05)):
        sent += [(0.05 * k, frame) for frame in uav.step(0.05 * k)]
    return sent


def relayed(sent: Iterable[Datagram], arrival: Arrival) -> Iterator[tuple[float, list[Message]]]:
    """Give what a gateway publishes of it, tick by tick: fleet time [s since 1970], messages."""
    intake, now = MavlinkReceiver(), T0
    for t, frame in sent:
        came = T0 + arrival.at(t)
        while now + TICK_S <= came:
            now += TICK_S
            yield now, _parted(intake.flush_packed(now))
        intake.receive(came, frame)
    yield now + TICK_S, _parted(intake.flush_packed(now + TICK_S))


def _parted(news: list[Message | EncodedMessage]) -> list[Message]:
    """Put packed samples first, as a gateway does."""
    return unpacked(
        [n for n in news if isinstance(n, EncodedMessage)] + [n for n in news if not isinstance(n, EncodedMessage)]
    )


@dataclass
class Outcome:
    """What came of one flight.

    Attributes:
        false_losses: arrival at which a link was called lost although telemetry arrived within the second before [s]
        losses: at which it was called lost in all [s]
        recovery_s: from the first telemetry after a pause to the first prediction from it [s]
        gap_s: longest time between predictions while telemetry arrived, after the first 10 s [s]
        predictions: how many were made from telemetry
        methods: ways in which they were made
        steps: by which the gateway dated telemetry anew [s]
    """

    false_losses: list[float] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)
    recovery_s: list[float] = field(default_factory=list)
    gap_s: float = 0.0
    predictions: int = 0
    methods: dict[str, int] = field(default_factory=dict)
    steps: list[float] = field(default_factory=list)

    def figures(self) -> dict[str, Any]:
        """Give it as numbers for programs."""
        return {
            "lost_by_mistake": len(self.false_losses),
            "lost": len(self.losses),
            "longest_gap_s": round(self.gap_s, 2),
            "back_after_s": round(max(self.recovery_s), 2) if self.recovery_s else None,
            "predictions": self.predictions,
        }

    def row(self) -> str:
        """Give it as cells of a table."""
        recovery = f"{max(self.recovery_s):.1f}" if self.recovery_s else "–"
        methods = ", ".join(f"{n} {method}" for method, n in sorted(self.methods.items()))
        steps = ", ".join(f"{step:.1f}" for step in self.steps) or "–"
        lost = f"{len(self.false_losses)} | {len(self.losses)}"
        return f"{lost} | {self.gap_s:.1f} | {recovery} | {self.predictions} ({methods}) | {steps}"


class Judge:
    """Take down what a worker says of one aircraft while its telemetry arrives."""

    def __init__(self) -> None:
        self.found = Outcome()
        self.made: list[Prediction] = []
        self._sampled, self._begun, self._resumed, self._predicted = -np.inf, np.inf, -np.inf, np.inf
        self._advance = 0.0

    def hear(self, now: float, message: Message) -> None:
        """Take a message of the gateway or the worker at arrival `now` [s]."""
        if isinstance(message, Sample):
            self._begun = min(self._begun, now)
            if now - self._sampled > 1.0 and self.made:
                self._resumed = self._predicted = now
            self._sampled = now
        elif isinstance(message, Status) and message.clock_advance_s != self._advance:
            self.found.steps.append(message.clock_advance_s - self._advance)
            self._advance = message.clock_advance_s
        elif isinstance(message, Alert) and message.kind is AlertKind.LINK_LOST and message.active:
            self.found.losses.append(now)
            self.found.false_losses += [now] if now - self._sampled < 1.0 else []
        elif isinstance(message, Prediction) and not message.coast_s:
            self._predict(now, message)

    def _predict(self, now: float, made: Prediction) -> None:
        self.made.append(made)
        self.found.predictions += 1
        self.found.methods[made.method] = self.found.methods.get(made.method, 0) + 1
        if self._resumed > -np.inf:
            self.found.recovery_s.append(now - self._resumed)
            self._resumed = -np.inf
        self._predicted = now

    def tick(self, now: float) -> None:
        """Look at arrival `now` how long nothing was predicted [s]."""
        if now - self._begun > BEGIN_S and now - self._sampled < 1.0:
            since = self._predicted if np.isfinite(self._predicted) else self._begun
            self.found.gap_s = max(self.found.gap_s, now - since)


def lived(ticks: Iterable[tuple[float, list[Message]]], set_clock: Callable[[float], None]) -> Judge:
    """Let a worker hear what a gateway publishes, its clock set to the time of each tick."""
    bus, judge, now = MemoryBus(), Judge(), [0.0]
    for kind in (Sample, Status, Alert, Prediction):
        bus.subscribe(kind, lambda message, _: judge.hear(now[0], message))
    worker = Worker(bus, range(1, 256), omega=0.0)
    set_clock(T0)
    worker.connect()
    for at, messages in ticks:
        now[0] = at
        set_clock(at)
        for message in messages:
            bus.publish(message)
        worker.sweep()
        judge.tick(at)
    assert not any(held.defect for held in worker.owned_twins())
    return judge
