"""Store the twins of one worker: queue messages, acquire and release twins, query their history."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from math import isfinite
from typing import Protocol

import msgspec

import fleet
from fleet.bus.bus_protocol import EpochFence
from fleet.bus.codec import EncodedMessage, Stamp
from fleet.bus.session import Bus
from fleet.contract import (
    Handover,
    Message,
    Mismatch,
    Model,
    Prediction,
    Rows,
    Sample,
)
from twin_worker.alerts.hysteresis import AlertState
from twin_worker.ownership.cold_start import (
    LATCHED_TYPES,
    continue_prediction,
    query_history,
    restore_model,
    stagger_work,
)
from twin_worker.ownership.handover import Snapshot, decode_snapshot, encode_snapshot
from twin_worker.twin.state.state import Twin, ingest

_log = logging.getLogger(__name__)
INBOX_SIZE = 4096  # queued messages per UAV; the oldest are dropped and counted
_PUBLISH_GRACE_S = 1.0  # after this time an acquired snapshot counts as published, with or without a prediction [s]
SILENT_S = 1.0  # wall time without a sample after which data time follows the wall clock [s]
_LOCK_TIMEOUT_S = 0.3  # wait for a busy twin; the requester tries again [s]


@dataclass(eq=False)
class OwnedTwin:
    """One UAV owned by this worker: its twin, inbox and epoch."""

    twin: Twin
    epoch: int
    inbox: deque[Message] = field(default_factory=lambda: deque(maxlen=INBOX_SIZE))
    last_arrival: float = float("nan")  # wall time of the newest sample [s, monotonic]
    processed_at: float = float("-inf")  # wall time of the last step [s, monotonic]
    last_position: Rows | None = None  # newest received positions
    fallback_t: float = float("-inf")  # data time of the newest prediction without the twin [s since 1970]
    published_at: float = float("-inf")  # wall time of the newest published prediction [s, monotonic]
    dropped: int = 0
    defect: str = ""  # newest internal error
    lock: threading.Lock = field(default_factory=threading.Lock)  # protects changes and copies of the twin
    inbox_lock: threading.Lock = field(default_factory=threading.Lock)  # protects the inbox
    ready: bool = True  # the twin is available
    without_history: bool = False  # no past telemetry
    ready_since: float = float("-inf")  # when the twin became ready [s, monotonic]
    publishing: bool = False  # a prediction was published, or no other worker publishes
    encoded: tuple[Prediction, EncodedMessage] | None = (
        None  # newest prediction, and the same encoded with law and parameters
    )

    def collects(self, now: float, period: float) -> bool:
        """Return whether a predicting twin still collects samples, for `period` since its last step [s]."""
        return (
            now - self.processed_at < period
            and self.twin.prediction.latest is not None
            and all(isinstance(message, Sample) for message in tuple(self.inbox))
        )


def data_time(owned: OwnedTwin) -> float:
    """Return the UAV's current data time [s]: its newest sample, plus the wall time since it fell silent."""
    silence_s = time.monotonic() - owned.last_arrival
    newest = owned.twin.telemetry.history.newest
    return newest + silence_s if silence_s > SILENT_S else newest


class Companion(Protocol):
    """Stores data of an aircraft besides its twin."""

    def import_state(self, uav: int, snapshot: Snapshot) -> None:
        """Store the data received with a twin."""

    def export_state(self, uav: int) -> tuple[AlertState, Mismatch | None]:
        """Return the open traffic alerts and the newest mismatch."""

    def discard(self, uav: int) -> None:
        """Discard the data of an aircraft."""


class TwinStore:
    """Stores the twins of the owned aircraft.

    Args:
        bus: connected bus
        ids: UAV ids this worker may own
        create: creates the twin of an id
        companion: stores data of an aircraft besides its twin
    """

    def __init__(self, bus: Bus, ids: range, create: Callable[[int], Twin], companion: Companion) -> None:
        self.by_uav: dict[int, OwnedTwin] = {}
        self.lock = threading.Lock()
        self.ids = ids
        self.run_paced: Callable[[Callable[[], None]], None] = _run_now  # runs low-priority tasks
        self._bus, self._create, self._companion = bus, create, companion
        self._models: dict[int, Model] = {}  # newest published by other workers, of ids in range
        self._predictions: dict[int, Prediction] = {}
        self._last_messages: dict[int, dict[type, Message]] = {}  # from gateways, of aircraft owned by others
        self._fence = EpochFence()

    # --- reception ---------------------------------------------------------------------------------------------------

    def enqueue(self, message: Message) -> bool:
        """Queue a message for its twin; return whether there is one."""
        owned = self.by_uav.get(message.uav)
        if owned is None:
            if isinstance(message, LATCHED_TYPES) and message.uav in self.ids:
                self._last_messages.setdefault(message.uav, {})[type(message)] = message
            return False
        if isinstance(message, Sample):
            owned.last_arrival, owned.last_position = time.monotonic(), message.position or owned.last_position
        with owned.inbox_lock:  # never `lock`, which an identification holds for its whole duration
            owned.dropped += len(owned.inbox) == INBOX_SIZE
            owned.inbox.append(message)
        return True

    def cache_result(self, result: Model | Prediction, stamp: Stamp | None) -> bool:
        """Store another worker's result for its own aircraft; return whether its stamp is valid."""
        if result.uav in self.by_uav or not self._fence.accepts(result.uav, stamp):
            return False
        if isinstance(result, Model):
            self._models[result.uav] = result
        elif result.uav in self.ids:
            self._predictions[result.uav] = result
        return True

    def ready(self) -> list[OwnedTwin]:
        """Return the aircraft with a ready twin, by UAV id."""
        with self.lock:
            return [owned for _, owned in sorted(self.by_uav.items()) if owned.ready]

    # --- acquisition -------------------------------------------------------------------------------------------------

    def expect(self, uavs: Iterable[int]) -> None:
        """Queue messages of these aircraft before their twins arrive."""
        for uav in uavs:
            self._reserve(uav)

    def acquire(self, uav: int, epoch: int, twin: Handover | None) -> None:
        """Acquire one aircraft, with a snapshot of its twin or without."""
        owned = self._reserve(uav)
        owned.epoch, owned.without_history = epoch, twin is None and not owned.ready
        if twin is None:
            owned.publishing = True
            return
        try:
            if twin.code != fleet.SOURCES:
                raise ValueError(f"uav-{uav}: found a snapshot of another version, expected ours; update all workers")
            snapshot = decode_snapshot(twin.snapshot, uav)
        except ValueError as error:
            _log.warning("%s", error)
            self.rehydrate([uav])
            return
        self._companion.import_state(uav, snapshot)
        fresh = self._create(uav)
        config = msgspec.structs.replace(snapshot.twin.config, schedule=fresh.config.schedule)
        snapshot.twin.config, snapshot.twin.budget, snapshot.twin.terrain = config, fresh.budget, fresh.terrain
        if (prediction := self._predictions.pop(uav, None)) is not None:
            owned.fallback_t = max(owned.fallback_t, prediction.t)  # for a delayed snapshot
        for cache in (self._models, self._last_messages):
            cache.pop(uav, None)  # type: ignore[attr-defined]
        self._start(owned, snapshot.twin, snapshot.inbox)

    def rehydrate(self, uavs: list[int]) -> None:
        """Start twins without snapshots: from the gateway's last minutes, and the last published model.

        All continue their last prediction at once. Past telemetry is queried one by one, shortest horizon first.
        Subsequent work is spread over the usual periods. If CPU time is short, aircraft with a propagated prediction
        wait.
        """
        started = [(uav, twin) for uav in uavs if (twin := self._continue_prediction(uav)) is not None]
        started.sort(key=lambda entry: entry[1].prediction.latest.horizon_s if entry[1].prediction.latest else 0.0)
        for k, (uav, twin) in enumerate(started):
            (self.run_paced if twin.prediction.latest else _run_now)(
                partial(self._rehydrate_one, uav, twin, k / len(started))
            )

    def _continue_prediction(self, uav: int) -> Twin | None:
        """Create a twin that continues another worker's prediction; return None if a twin exists."""
        owned = self.by_uav.get(uav)
        if owned is None or owned.ready:
            return None
        twin = self._create(uav)
        if (prediction := self._predictions.pop(uav, None)) is not None and continue_prediction(twin, prediction):
            self._start(owned, twin, [], without_history=True)
        return twin

    def _rehydrate_one(self, uav: int, twin: Twin, phase: float) -> None:
        """Ingest the queried past messages into a twin, and restore the published model."""
        owned = self.by_uav.get(uav)
        if owned is None:
            return
        try:
            past = query_history(self._bus, uav, self._last_messages.pop(uav, {}))
        except ConnectionError:  # shutdown
            return
        model = self._models.pop(uav, None)
        with owned.lock:
            rollout, is_continued = twin.prediction.last_rollout, twin.prediction.is_continued
            for message in past:
                ingest(twin, message)
            # mission and parameters are new only to this twin: the continued path used them already
            twin.prediction.set_rollout(rollout, is_continued=is_continued)
            restored = model is not None and restore_model(twin, model)
            stagger_work(
                twin, phase, has_prediction=owned.ready and isfinite(twin.config.schedule.renew), has_model=restored
            )
        if self.by_uav.get(uav) is not owned:  # released meanwhile
            return
        if owned.ready:
            owned.without_history = False
        else:
            self._start(owned, twin, [])

    def set_epochs(self, epochs: Mapping[int, int]) -> None:
        """Publish these aircraft under other epochs from now on."""
        for uav, epoch in epochs.items():
            if (owned := self.by_uav.get(uav)) is not None:
                owned.epoch = epoch

    def _reserve(self, uav: int) -> OwnedTwin:
        with self.lock:
            return self.by_uav.setdefault(uav, OwnedTwin(self._create(uav), 0, ready=False))

    @staticmethod
    def _start(owned: OwnedTwin, twin: Twin, queued: list[Message], *, without_history: bool = False) -> None:
        """Start a twin with the messages queued meanwhile; skip telemetry it has already ingested."""
        with owned.lock:
            known_t = twin.telemetry.data_t if twin.telemetry.data_t > 0 else twin.telemetry.history.newest
            known_t = max([known_t, *(message.t for message in queued)])
            with owned.inbox_lock:
                newer = [item for item in owned.inbox if not isinstance(item, Sample) or item.t > known_t]
                owned.inbox.clear()
                owned.inbox.extend([*queued, *newer])
            owned.twin = twin
            owned.without_history, owned.ready, owned.ready_since = without_history, True, time.monotonic()
            if owned.last_arrival != owned.last_arrival and twin.telemetry.history.newest > 0:
                owned.last_arrival = time.monotonic()

    # --- release -----------------------------------------------------------------------------------------------------

    def release(self, uavs: Iterable[int]) -> None:
        """Release these aircraft."""
        with self.lock:
            released = {uav: self.by_uav.pop(uav) for uav in uavs if uav in self.by_uav}
        for uav, owned in released.items():
            owned.ready = False
            if owned.twin.identification.message is not None:
                self._models[uav] = owned.twin.identification.message
            if owned.twin.prediction.latest is not None:
                self._predictions[uav] = owned.twin.prediction.latest
            self._companion.discard(uav)

    def snapshot(self, uav: int, epoch: int) -> Handover | None:
        """Return a snapshot of one twin between two steps; None if it is not ready or busy for longer."""
        owned = self.by_uav.get(uav)
        if owned is None or not owned.lock.acquire(timeout=_LOCK_TIMEOUT_S):
            return None
        try:
            if not owned.ready or owned.without_history:
                return None
            with owned.inbox_lock:
                waiting = list(owned.inbox)
            payload = encode_snapshot(Snapshot(owned.twin, waiting, *self._companion.export_state(uav)))
        except TypeError:  # internal error: the new owner starts without a snapshot
            _log.exception("uav-%d cannot be handed over; report it", uav)
            payload = b""
        finally:
            owned.lock.release()
        return Handover(t=time.time(), uav=uav, epoch=epoch, code=fleet.SOURCES, snapshot=payload)

    @property
    def ready_by_uav(self) -> dict[int, bool]:
        """Return for each owned or expected aircraft whether its twin is ready."""
        with self.lock:
            return {uav: owned.ready for uav, owned in self.by_uav.items()}

    @property
    def not_publishing(self) -> frozenset[int]:
        """Return the acquired aircraft whose previous owner still publishes."""
        cutoff = time.monotonic() - _PUBLISH_GRACE_S
        with self.lock:
            return frozenset(
                uav
                for uav, owned in self.by_uav.items()
                if not owned.publishing and (not owned.ready or owned.ready_since > cutoff)
            )

    @property
    def without_history(self) -> tuple[int, ...]:
        """Return the aircraft without past telemetry."""
        with self.lock:
            return tuple(uav for uav, owned in self.by_uav.items() if owned.without_history)


def _run_now(task: Callable[[], None]) -> None:
    task()
