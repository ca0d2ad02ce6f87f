"""The twins one worker keeps: where messages wait for them, how they come, and how they go."""

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
INBOX = 4096  # messages waiting per UAV; the oldest go first and are counted
_QUIET_S = 1.0  # after which one that came is written for, or has nothing to be written of it [s]
_BUSY_S = 0.3  # for a twin that is just being worked on; it is asked for again [s]


@dataclass(eq=False)
class Held:
    """One UAV this worker holds: its twin, its inbox and its claim."""

    twin: Twin
    epoch: int
    inbox: deque[Message] = field(default_factory=lambda: deque(maxlen=INBOX))
    arrived: float = float("nan")  # wall time of the newest sample [s, monotonic]
    placed: Rows | None = None  # positions heard last
    stood: float = float("-inf")  # data time of what was said without the twin, here or elsewhere [s since 1970]
    published: float = float("-inf")  # when a prediction was, last [s, monotonic]
    shed: int = 0
    failed: str = ""  # what went wrong last, a defect of ours
    lock: threading.Lock = field(default_factory=threading.Lock)  # held while the twin changes, or is copied
    filling: threading.Lock = field(default_factory=threading.Lock)  # held while the inbox is appended to, or replaced
    ready: bool = True  # its twin is here
    bare: bool = False  # without the telemetry of before
    since: float = float("-inf")  # when its twin came [s, monotonic]
    written: bool = False  # a prediction was published, or nobody else publishes any
    told: tuple[Prediction, Wire] | None = None  # one that was asked for, and the same with law and parameters, packed


class Extras(Protocol):
    """Who keeps what belongs to an aircraft besides its twin."""

    def take(self, uav: int, load: Load) -> None:
        """Keep what came with a twin."""

    def show(self, uav: int) -> tuple[Ledger, Mismatch | None]:
        """Return it: open conflicts, and the mismatch found last."""

    def forget(self, uav: int) -> None:
        """Return it up."""


class Twins:
    """What is kept; a `Keeper`.

    Args:
        bus: joined
        ids: that may come
        make: makes the twin of an id
        extras: takes and gives what belongs to an aircraft besides its twin
    """

    def __init__(self, bus: Bus, ids: range, make: Callable[[int], Twin], extras: Extras) -> None:
        self.held: dict[int, Held] = {}
        self.lock = threading.Lock()
        self.ids = ids
        self.paced: Callable[[Callable[[], None]], None] = _at_once  # does what others need not wait for
        self._bus, self._make, self._extras = bus, make, extras
        self._models: dict[int, Model] = {}  # last published by others, of ids of ours
        self._predictions: dict[int, Prediction] = {}
        self._said: dict[int, dict[type, Message]] = {}  # by gateways, of aircraft that others hold
        self._fence = Fence()

    # --- what is heard -----------------------------------------------------------------------------------------------

    def hear(self, message: Message) -> bool:
        """Let a message wait for its twin; tell whether there is one."""
        held = self.held.get(message.uav)
        if held is None:
            if isinstance(message, SELDOM) and message.uav in self.ids:
                self._said.setdefault(message.uav, {})[type(message)] = message
            return False
        if isinstance(message, Sample):
            held.arrived, held.placed = time.monotonic(), message.position or held.placed
        with held.filling:  # never `lock`, which is held for as long as an identification takes
            held.shed += len(held.inbox) == INBOX
            held.inbox.append(message)
        return True

    def overhear(self, said: Model | Prediction, stamp: Stamp | None) -> bool:
        """Keep what another worker published of an aircraft of its own; tell whether that is believed."""
        if said.uav in self.held or not self._fence.believes(said.uav, stamp):
            return False
        if isinstance(said, Model):
            self._models[said.uav] = said
        elif said.uav in self.ids:
            self._predictions[said.uav] = said
        return True

    def ready(self) -> list[Held]:
        """Return those whose twins are here, by UAV id."""
        with self.lock:
            return [held for _, held in sorted(self.held.items()) if held.ready]

    # --- how they come -----------------------------------------------------------------------------------------------

    def expect(self, uavs: Iterable[int]) -> None:
        """Begin to collect what is heard of these, before their twins are here."""
        for uav in uavs:
            self._place(uav)

    def adopt(self, uav: int, epoch: int, twin: Handover | None) -> None:
        """Hold one from now on, with its twin or without."""
        held = self._place(uav)
        held.epoch, held.bare = epoch, twin is None and not held.ready
        if twin is None:
            held.written = True
            return
        try:
            if twin.code != fleet.SOURCES:
                raise ValueError(f"uav-{uav}: found a twin of other sources, expected ours; start all workers alike")
            load = unpacked(twin.load, uav)
        except ValueError as error:
            _log.warning("%s", error)
            self.recall([uav])
            return
        self._extras.take(uav, load)
        fresh = self._make(uav)
        load.twin.pace, load.twin.quota = fresh.pace, fresh.quota
        if (said := self._predictions.pop(uav, None)) is not None:
            held.stood = max(held.stood, said.t)  # a copy that was long on its way has nothing to add to that
        for kept in (self._models, self._said):
            kept.pop(uav, None)  # type: ignore[attr-defined]
        self._begin(held, load.twin, load.inbox)

    def recall(self, uavs: list[int]) -> None:
        """Begin some without their twins: with the gateway's last minutes, and the model published last.

        All of them go on at once. The past comes one by one, first to those whose future is known for the shortest
        time, and what follows from it is spread over the usual periods. Where CPU time is short those that are
        renewed meanwhile wait for theirs.
        """
        begun = [(uav, twin) for uav in uavs if (twin := self._go_on(uav)) is not None]
        begun.sort(key=lambda one: one[1].prediction.horizon_s if one[1].prediction else 0.0)
        for k, (uav, twin) in enumerate(begun):
            (self.paced if twin.prediction else _at_once)(partial(self._recall, uav, twin, k / len(begun)))

    def _go_on(self, uav: int) -> Twin | None:
        """Make a twin that writes at once where another worker published a prediction; None where there is a twin."""
        held = self.held.get(uav)
        if held is None or held.ready:
            return None
        twin = self._make(uav)
        if (made := self._predictions.pop(uav, None)) is not None and go_on(twin, made):
            self._begin(held, twin, [], bare=True)
        return twin

    def _recall(self, uav: int, twin: Twin, share: float) -> None:
        """Let a twin hear what was said before, and believe what was published."""
        held = self.held.get(uav)
        if held is None:
            return
        try:
            past = recall(self._bus, uav, self._said.pop(uav, {}))
        except ConnectionError:  # we are leaving
            return
        model = self._models.pop(uav, None)
        with held.lock:
            base = twin.base
            for message in past:
                hear(twin, message)
            twin.base = base  # mission and parameters are news to this twin alone: the path it renews was flown by them
            known = model is not None and revive(twin, model)
            wait(twin, share, fly=held.ready and isfinite(twin.pace.renew), learn=known)
        if self.held.get(uav) is not held:  # it was lost meanwhile
            return
        if held.ready:
            held.bare = False
        else:
            self._begin(held, twin, [])

    def renew(self, uav: int, epoch: int) -> None:
        """Write under another epoch from now on."""
        if (held := self.held.get(uav)) is not None:
            held.epoch = epoch

    def _place(self, uav: int) -> Held:
        with self.lock:
            return self.held.setdefault(uav, Held(self._make(uav), 0, ready=False))

    @staticmethod
    def _begin(held: Held, twin: Twin, before: list[Message], *, bare: bool = False) -> None:
        """Go on with a twin, and with what came since: telemetry it has already taken in is not taken in again."""
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

    # --- how they go -------------------------------------------------------------------------------------------------

    def drop(self, uavs: Iterable[int]) -> None:
        """Hold these no longer."""
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
        """Copy one's twin, between two of its turns; None where there is none yet, or it is worked on for longer."""
        held = self.held.get(uav)
        if held is None or not held.lock.acquire(timeout=_BUSY_S):
            return None
        try:
            if not held.ready or held.bare:
                return None
            with held.filling:
                waiting = list(held.inbox)
            load = packed(Load(held.twin, waiting, *self._extras.show(uav)))
        except TypeError:  # a defect: its new owner begins cold
            _log.exception("uav-%d cannot be handed over; report it", uav)
            load = b""
        finally:
            held.lock.release()
        return Handover(t=time.time(), uav=uav, epoch=epoch, code=fleet.SOURCES, load=load)

    @property
    def kept(self) -> dict[int, bool]:
        """Tell of each that is held or expected whether its twin is here."""
        with self.lock:
            return {uav: held.ready for uav, held in self.held.items()}

    @property
    def quiet(self) -> frozenset[int]:
        """Name those whose holder of before is still the one that writes."""
        since = time.monotonic() - _QUIET_S
        with self.lock:
            return frozenset(
                uav for uav, held in self.held.items() if not held.written and (not held.ready or held.since > since)
            )

    @property
    def bare(self) -> tuple[int, ...]:
        """Name those without the telemetry of before."""
        with self.lock:
            return tuple(uav for uav, held in self.held.items() if held.bare)


def _at_once(work: Callable[[], None]) -> None:
    work()
