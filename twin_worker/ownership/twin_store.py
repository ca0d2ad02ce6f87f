"""Store the twins of one worker: queue messages, acquire and release twins."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from math import isfinite
from typing import Protocol

import fleet
from fleet.bus.bus_protocol import Bus
from fleet.bus.codec import Stamp, Wire
from fleet.bus.epoch_fence import Fence
from fleet.contract import Handover, Message, Mismatch, Model, Prediction, Rows, Sample
from twin_worker.alerts.hysteresis import Ledger
from twin_worker.ownership.cold_start import go_on, revive, wait
from twin_worker.ownership.handover import Load, packed, unpacked
from twin_worker.ownership.history_query import SELDOM, recall
from twin_worker.twin.state.state import Twin, hear

_log = logging.getLogger(__name__)
INBOX = 4096  # queued messages per UAV; the oldest are dropped and counted
_QUIET_S = 1.0  # after this time an acquired snapshot counts as published, with or without a prediction [s]
_BUSY_S = 0.3  # wait for a busy twin; the requester tries again [s]


@dataclass(eq=False)
class Held:
    """One UAV owned by this worker: its twin, inbox and epoch."""

    twin: Twin
    epoch: int
    inbox: deque[Message] = field(default_factory=lambda: deque(maxlen=INBOX))
    arrived: float = float("nan")  # wall time of the newest sample [s, monotonic]
    placed: Rows | None = None  # newest received positions
    stood: float = float("-inf")  # data time of the newest prediction without the twin [s since 1970]
    published: float = float("-inf")  # wall time of the newest published prediction [s, monotonic]
    shed: int = 0
    failed: str = ""  # newest internal error
    lock: threading.Lock = field(default_factory=threading.Lock)  # protects changes and copies of the twin
    filling: threading.Lock = field(default_factory=threading.Lock)  # protects the inbox
    ready: bool = True  # the twin is available
    bare: bool = False  # no past telemetry
    since: float = float("-inf")  # when the twin became ready [s, monotonic]
    written: bool = False  # a prediction was published, or no other worker publishes
    told: tuple[Prediction, Wire] | None = None  # newest prediction, and the same encoded with law and parameters


class Extras(Protocol):
    """Stores data of an aircraft besides its twin."""

    def take(self, uav: int, load: Load) -> None:
        """Store the data received with a twin."""

    def show(self, uav: int) -> tuple[Ledger, Mismatch | None]:
        """Return the open traffic alerts and the newest mismatch."""

    def forget(self, uav: int) -> None:
        """Discard the data of an aircraft."""


class Twins:
    """In-process `TwinStore`.

    Args:
        bus: connected bus
        ids: UAV ids this worker may own
        create: creates the twin of an id
        companion: stores data of an aircraft besides its twin
    """

    def __init__(self, bus: Bus, ids: range, make: Callable[[int], Twin], extras: Extras) -> None:
        self.held: dict[int, Held] = {}
        self.lock = threading.Lock()
        self.ids = ids
        self.paced: Callable[[Callable[[], None]], None] = _at_once  # runs low-priority tasks
        self._bus, self._make, self._extras = bus, make, extras
        self._models: dict[int, Model] = {}  # newest published by other workers, of ids in range
        self._predictions: dict[int, Prediction] = {}
        self._said: dict[int, dict[type, Message]] = {}  # from gateways, of aircraft owned by others
        self._fence = Fence()

    # --- reception ---------------------------------------------------------------------------------------------------

    def hear(self, message: Message) -> bool:
        """Queue a message for its twin; return whether there is one."""
        held = self.held.get(message.uav)
        if held is None:
            if isinstance(message, SELDOM) and message.uav in self.ids:
                self._said.setdefault(message.uav, {})[type(message)] = message
            return False
        if isinstance(message, Sample):
            held.arrived, held.placed = time.monotonic(), message.position or held.placed
        with held.filling:  # never `lock`, which an identification holds for its whole duration
            held.shed += len(held.inbox) == INBOX
            held.inbox.append(message)
        return True

    def overhear(self, said: Model | Prediction, stamp: Stamp | None) -> bool:
        """Store another worker's result for its own aircraft; return whether its stamp is valid."""
        if said.uav in self.held or not self._fence.believes(said.uav, stamp):
            return False
        if isinstance(said, Model):
            self._models[said.uav] = said
        elif said.uav in self.ids:
            self._predictions[said.uav] = said
        return True

    def ready(self) -> list[Held]:
        """Return the aircraft with a ready twin, by UAV id."""
        with self.lock:
            return [held for _, held in sorted(self.held.items()) if held.ready]

    # --- acquisition -------------------------------------------------------------------------------------------------

    def expect(self, uavs: Iterable[int]) -> None:
        """Queue messages of these aircraft before their twins arrive."""
        for uav in uavs:
            self._place(uav)

    def adopt(self, uav: int, epoch: int, twin: Handover | None) -> None:
        """Acquire one aircraft, with a snapshot of its twin or without."""
        held = self._place(uav)
        held.epoch, held.bare = epoch, twin is None and not held.ready
        if twin is None:
            held.written = True
            return
        try:
            if twin.code != fleet.SOURCES:
                raise ValueError(f"uav-{uav}: found a snapshot of another version, expected ours; update all workers")
            load = unpacked(twin.load, uav)
        except ValueError as error:
            _log.warning("%s", error)
            self.recall([uav])
            return
        self._extras.take(uav, load)
        fresh = self._make(uav)
        load.twin.pace, load.twin.quota = fresh.pace, fresh.quota
        if (said := self._predictions.pop(uav, None)) is not None:
            held.stood = max(held.stood, said.t)  # for a delayed snapshot
        for kept in (self._models, self._said):
            kept.pop(uav, None)  # type: ignore[attr-defined]
        self._begin(held, load.twin, load.inbox)

    def recall(self, uavs: list[int]) -> None:
        """Start twins without snapshots: from the gateway's last minutes, and the last published model.

        All continue their last prediction at once. Past telemetry is queried one by one, shortest horizon first.
        Subsequent work is spread over the usual periods. If CPU time is short, aircraft with a propagated prediction
        wait.
        """
        begun = [(uav, twin) for uav in uavs if (twin := self._go_on(uav)) is not None]
        begun.sort(key=lambda one: one[1].prediction.horizon_s if one[1].prediction else 0.0)
        for k, (uav, twin) in enumerate(begun):
            (self.paced if twin.prediction else _at_once)(partial(self._recall, uav, twin, k / len(begun)))

    def _go_on(self, uav: int) -> Twin | None:
        """Create a twin that continues another worker's prediction; return None if a twin exists."""
        held = self.held.get(uav)
        if held is None or held.ready:
            return None
        twin = self._make(uav)
        if (made := self._predictions.pop(uav, None)) is not None and go_on(twin, made):
            self._begin(held, twin, [], bare=True)
        return twin

    def _recall(self, uav: int, twin: Twin, share: float) -> None:
        """Ingest the queried past messages into a twin, and restore the published model."""
        held = self.held.get(uav)
        if held is None:
            return
        try:
            past = recall(self._bus, uav, self._said.pop(uav, {}))
        except ConnectionError:  # shutdown
            return
        model = self._models.pop(uav, None)
        with held.lock:
            base = twin.base
            for message in past:
                hear(twin, message)
            twin.base = base  # mission and parameters are new only to this twin: the continued path used them already
            known = model is not None and revive(twin, model)
            wait(twin, share, fly=held.ready and isfinite(twin.pace.renew), learn=known)
        if self.held.get(uav) is not held:  # released meanwhile
            return
        if held.ready:
            held.bare = False
        else:
            self._begin(held, twin, [])

    def renew(self, uav: int, epoch: int) -> None:
        """Publish under another epoch from now on."""
        if (held := self.held.get(uav)) is not None:
            held.epoch = epoch

    def _place(self, uav: int) -> Held:
        with self.lock:
            return self.held.setdefault(uav, Held(self._make(uav), 0, ready=False))

    @staticmethod
    def _begin(held: Held, twin: Twin, before: list[Message], *, bare: bool = False) -> None:
        """Start a twin with the messages queued meanwhile; skip telemetry it has already ingested."""
        with held.lock:
            known = twin.data_t if twin.data_t > 0 else twin.history.newest
            known = max([known, *(b.t for b in before)])
            with held.filling:
                since = [m for m in held.inbox if not isinstance(m, Sample) or m.t > known]
                held.inbox.clear()
                held.inbox.extend([*before, *since])
            held.twin = twin
            held.bare, held.ready, held.since = bare, True, time.monotonic()
            if held.arrived != held.arrived and twin.history.newest > 0:
                held.arrived = time.monotonic()

    # --- release -----------------------------------------------------------------------------------------------------

    def drop(self, uavs: Iterable[int]) -> None:
        """Release these aircraft."""
        with self.lock:
            gone = {uav: self.held.pop(uav) for uav in uavs if uav in self.held}
        for uav, held in gone.items():
            held.ready = False
            if held.twin.model is not None:
                self._models[uav] = held.twin.model
            if held.twin.prediction is not None:
                self._predictions[uav] = held.twin.prediction
            self._extras.forget(uav)

    def copied(self, uav: int, epoch: int) -> Handover | None:
        """Return a snapshot of one twin between two steps; None if it is not ready or busy for longer."""
        held = self.held.get(uav)
        if held is None or not held.lock.acquire(timeout=_BUSY_S):
            return None
        try:
            if not held.ready or held.bare:
                return None
            with held.filling:
                waiting = list(held.inbox)
            load = packed(Load(held.twin, waiting, *self._extras.show(uav)))
        except TypeError:  # internal error: the new owner starts without a snapshot
            _log.exception("uav-%d cannot be handed over; report it", uav)
            load = b""
        finally:
            held.lock.release()
        return Handover(t=time.time(), uav=uav, epoch=epoch, code=fleet.SOURCES, load=load)

    @property
    def kept(self) -> dict[int, bool]:
        """Return for each owned or expected aircraft whether its twin is ready."""
        with self.lock:
            return {uav: held.ready for uav, held in self.held.items()}

    @property
    def quiet(self) -> frozenset[int]:
        """Return the acquired aircraft whose previous owner still publishes."""
        since = time.monotonic() - _QUIET_S
        with self.lock:
            return frozenset(
                uav for uav, held in self.held.items() if not held.written and (not held.ready or held.since > since)
            )

    @property
    def bare(self) -> tuple[int, ...]:
        """Return the aircraft without past telemetry."""
        with self.lock:
            return tuple(uav for uav, held in self.held.items() if held.bare)


def _at_once(work: Callable[[], None]) -> None:
    work()
