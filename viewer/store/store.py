"""Store of received messages: the latest of every topic per UAV, with bounded memory and without exceptions."""

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from math import isfinite
from typing import Any

import numpy as np

from fleet.bus.bus_protocol import WRITER_TIMEOUT_S, EpochFence, RawMessage, key_of
from fleet.bus.codec import Stamp, decode_for_key, encoding
from fleet.bus.session import Bus
from fleet.contract import (
    Alert,
    Execution,
    FleetState,
    GatewayCounters,
    Mismatch,
    Mission,
    Model,
    Prediction,
    Proposal,
    Sample,
    Samples,
    Status,
    TwinState,
)
from viewer.store.forecast import PastPrediction, check_prediction
from viewer.store.inbox import LARGE_FLEET, CoalescingQueue, Inbox, QueuedMessage, SampleSubset, decode_sample
from viewer.store.place import OutOfRangeError, SceneFrame, checked_origin, first_fix
from viewer.store.proposal import MAX_PROPOSALS, SceneProposal, check_proposal
from viewer.store.sample_layout import SampleReader
from viewer.store.vehicle import ENDED_S, JUMP_S, ProposalKey, Vehicle, mean_fit, stamp_of
from viewer.theme.events import MAX_ALERTS

MAX_VEHICLES = 2_000  # ids are untrusted input: further UAVs are counted, not stored
COASTING_S = 1.0  # a prediction later than this after the last sample is not compared with the flight [s]
MAX_SAMPLE_WAIT_S = 1.2  # longest delay of a sample in a large fleet [s]
COALESCE_S: dict[type, float] = {Prediction: 3.0, Status: 2.0}  # decoding interval in a large fleet, no alert [s]
PAST_S = 65.0  # age up to which past predictions are compared with the flight [s]
MAX_AWAY = 10_000  # rejected UAVs that are counted
MAX_STEPS = 32  # steps of an execution whose aircraft are looked at
MAX_LINKS = 64  # links whose texts are stored
MAX_WRITERS = 16  # workers whose texts are stored; a restarted worker counts as new
# topics requested at the start, so that a late viewer is complete
INITIAL_TOPICS = (Status, Mission, Model, Prediction, Alert, Proposal, Execution, Mismatch, FleetState, GatewayCounters)


class FleetStore:
    """All received data, one `Vehicle` per UAV; written by bus threads, read by the render thread."""

    def __init__(self, bus: Bus, clock: Callable[[], float] = time.monotonic) -> None:
        self._vehicles: dict[int, Vehicle] = {}
        self.inbox, self._reader = Inbox(), SampleReader()
        self._scene_frame: SceneFrame | None = None
        self.sentences: dict[int, str] = {}  # status text of each worker
        self._counts: Counter[str] = Counter()
        self.links: dict[str, str] = {}  # texts of gateways about their links
        self.gateway: GatewayCounters | None = None  # newest statistics of any gateway
        self.rejected_uavs: set[int] = set()  # UAVs beyond MAX_VEHICLES
        self.started = clock()
        self._router_lost_since: float | None = None
        self.lock = threading.Lock()
        self._bus, self._clock, self._fence = bus, clock, EpochFence(clock)
        handlers: dict[type, Callable[[Any, Stamp | None, float], None]] = {
            Sample: self._sample,
            Status: self._latest,
            Mission: self._latest,
            GatewayCounters: self._account,
            Model: self._model,
            Prediction: self._prediction,
            Alert: self._alert,
            Proposal: self._proposal,
            Execution: self._execution,
            Mismatch: self._mismatch,
            FleetState: self._fleet,
        }
        self._handlers = handlers
        self.immediate_uavs: frozenset[int] = frozenset()  # UAVs decoded on arrival, also in a large fleet
        self._coalescing: dict[type, CoalescingQueue] = {kind: CoalescingQueue() for kind in COALESCE_S}
        for kind in handlers:
            bus.subscribe_buffered(kind, self._receiver(kind))

    @property
    def vehicles(self) -> dict[int, Vehicle]:
        """Return all UAVs, after decoding queued samples."""
        with self.lock:
            self._read_samples()
            return self._vehicles

    @property
    def uavs(self) -> set[int]:
        """Return the ids of all UAVs, without decoding queued samples."""
        with self.lock:
            return set(self._vehicles)

    @property
    def scene_frame(self) -> SceneFrame | None:
        """Return the scene frame; None before the first position."""
        with self.lock:
            if self._scene_frame is None or not self.inbox.large_fleet:
                self._read_samples()
            return self._scene_frame

    @property
    def counts(self) -> Counter[str]:
        """Return the number of messages of each class, and of malformed and outdated ones."""
        with self.lock:
            self._read_samples()
            return self._counts

    def poll(self) -> None:
        """Receive the messages since the last call; call it about ten times per second."""
        self._bus.dispatch((Sample,) if self.inbox.large_fleet else ())
        with self.lock:
            for kind, queue in self._coalescing.items():
                for uav, queued in queue.take(queue.waiting_since(self._clock() - COALESCE_S[kind])):
                    self._decode(kind, uav, queued)

    def _receiver(self, kind: type) -> Callable[[list[RawMessage]], None]:
        """Return the callback of one class: it queues samples and messages that may wait and decodes the others."""
        queue, expected_encoding = self._coalescing.get(kind), encoding(kind)

        def receive(messages: list[RawMessage]) -> None:
            now = self._clock()
            valid = [message for message in messages if message[2] == expected_encoding]
            with self.lock:
                self._counts["strange"] += len(messages) - len(valid)
                if kind is Sample:
                    return self.inbox.put(valid, now)
                for uav, payload, _, stamp in valid:
                    message = QueuedMessage(payload, now, stamp)
                    if queue is not None and uav is not None:
                        if self._is_deferrable(kind, uav):
                            queue.add(uav, message)
                            continue
                        queue.take((uav,))  # outdated by this one
                    self._decode(kind, uav, message)

        return receive

    def _is_deferrable(self, kind: type, uav: int) -> bool:
        """Return whether decoding may wait: large fleet, UAV not immediate, an earlier message present."""
        if not self.inbox.large_fleet or uav in self.immediate_uavs:
            return False
        vehicle = self._vehicles.get(uav)
        return vehicle is not None and getattr(vehicle, kind.topic) is not None  # type: ignore[attr-defined]

    def _decode(self, kind: type, uav: int | None, queued: QueuedMessage) -> None:
        """Decode one message, after the samples before it; the caller owns the lock."""
        if not self.inbox.large_fleet:
            self._read_samples()
        try:
            message: Any = decode_for_key(kind, uav, queued.payload)
        except ValueError:
            self._counts["strange"] += 1
            return
        self._handle(kind, message, queued.stamp, queued.now)

    def _read_samples(self, uavs: Iterable[int] | None = None) -> None:
        """Decode the queued samples of all or some UAVs; the caller owns the lock."""
        taken, scene_frame = self.inbox.take(uavs), self._scene_frame
        if self.inbox.large_fleet and scene_frame is not None:
            read, taken = self._reader.read(taken, self._vehicles, scene_frame)
            for vehicle, now, values in read:
                vehicle.update_from_values(values, scene_frame, now)
            self._counts[Sample.__name__] += len(read)
        for uav, queued in taken:
            try:
                sample = decode_sample(queued.payload)
            except ValueError:
                self._counts["strange"] += 1
                continue
            if sample.uav == uav:
                self._handle(Sample, sample, None, queued.now)
            else:
                self._counts["strange"] += 1
        self.inbox.large_fleet = len(self._vehicles) > LARGE_FLEET

    def router_lost_s(self, now: float) -> float | None:
        """Return for how long the router is missing [s], since the first call without it; None while connected."""
        if self._bus.router:
            self._router_lost_since = None
            return None
        self._router_lost_since = now if self._router_lost_since is None else self._router_lost_since
        return now - self._router_lost_since

    @property
    def sample_key(self) -> str:
        """Return the key expression of samples."""
        return key_of(Samples, "*")

    def request_latest(self) -> None:
        """Request the latest messages published before the start; keep newer ones."""
        for kind in INITIAL_TOPICS:
            message: Any
            for message, stamp in self._bus.get(kind):
                with self.lock:
                    current = getattr(self._vehicles.get(getattr(message, "uav", -1)), message.topic, None)
                    if current is not None and current.t >= message.t:
                        continue
                    if not self.inbox.large_fleet:
                        self._read_samples()
                    self._handle(kind, message, stamp, self._clock())

    def all(self) -> list[Vehicle]:
        """Return snapshots of all UAVs in the order of their ids."""
        with self.lock:
            now = self._clock()
            waiting = self.inbox.waiting_since(now - MAX_SAMPLE_WAIT_S) if self.inbox.large_fleet else None
            self._read_samples(waiting)
            return [self._vehicles[uav].snapshot(now) for uav in sorted(self._vehicles)]

    def poses(self, uavs: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return positions, attitudes and arrival times of some UAVs; do not decode others.

        Returns:
            scene ENU (n, 3) [10 m], NaN where unknown; phi theta psi (n, 3) [rad]; monotonic (n,) [s]
        """
        with self.lock:
            self._read_samples(uavs if self.inbox.large_fleet else None)
            vehicles = [self._vehicles[uav] for uav in uavs]
            positions = [vehicle.at if vehicle.at is not None else [np.nan] * 3 for vehicle in vehicles]
            attitudes = [vehicle.attitude for vehicle in vehicles]
            received = [vehicle.sample_received for vehicle in vehicles]
        return np.array(positions).reshape(-1, 3), np.array(attitudes).reshape(-1, 3), np.array(received)

    def get(self, uav: int) -> Vehicle | None:
        """Return a snapshot of one UAV; None when it is unknown."""
        with self.lock:
            self._read_samples((uav,) if self.inbox.large_fleet else None)
            vehicle = self._vehicles.get(uav)
            return vehicle.snapshot(self._clock()) if vehicle is not None else None

    def worker_texts(self) -> list[str]:
        """Return the status texts of the workers."""
        with self.lock:
            return [text for text in self.sentences.values() if text]

    def trail(self, vehicle: Vehicle) -> np.ndarray:
        """Copy the flown trail: (n, 5) data time [s], scene ENU [10 m], Va [m/s]."""
        with self.lock:
            return vehicle.trail_rows()

    def track(self, vehicle: Vehicle) -> np.ndarray:
        """Copy the whole flown path, thinned: (n, 4) data time [s], scene ENU [10 m]."""
        with self.lock:
            return vehicle.track_rows()

    def past(self, vehicle: Vehicle) -> list[PastPrediction]:
        """Copy the past predictions of the last minute, oldest first."""
        with self.lock:
            return list(vehicle.past)

    def fits(self, vehicle: Vehicle) -> np.ndarray:
        """Copy the history of fits: (n, 2) data time [s], mean over the states [%]."""
        with self.lock:
            return np.array(vehicle.fits, float).reshape(-1, 2)

    def _handle(self, kind: type, message: Any, stamp: Stamp | None, now: float) -> None:
        try:
            self._handlers[kind](message, stamp, now)
            self._counts[kind.__name__] += 1
        except (ValueError, IndexError, TypeError, OverflowError) as error:
            self._counts["strange"] += 1
            if (vehicle := self._vehicles.get(getattr(message, "uav", -1))) is not None:
                vehicle.refusal = now, f"A {kind.__name__.lower()} was rejected: {error}"

    def _vehicle(self, uav: int) -> Vehicle:
        if uav not in self._vehicles:
            if len(self._vehicles) >= MAX_VEHICLES or not 0 <= uav < 1_000_000:
                if len(self.rejected_uavs) < MAX_AWAY:
                    self.rejected_uavs.add(uav)
                raise ValueError(
                    f"uav-{uav}: found {len(self._vehicles)} UAVs or an id of 1,000,000 or more, "
                    f"expected at most {MAX_VEHICLES} UAVs; open another viewer"
                )
            self._vehicles[uav] = Vehicle(uav)
        return self._vehicles[uav]

    def _sample(self, sample: SampleSubset, _: Stamp | None, now: float) -> None:
        if self._scene_frame is None and (origin := first_fix(sample)) is not None:
            self._scene_frame = SceneFrame(origin)
        if self._scene_frame is None:
            return
        vehicle = self._vehicle(sample.uav)
        try:
            vehicle.update_from_sample(sample, self._scene_frame, now)
        except OutOfRangeError:
            other_vehicles = (v for v in self._vehicles.values() if v is not vehicle and v.at is not None)
            if (origin := first_fix(sample)) is None or any(
                now - v.sample_received < WRITER_TIMEOUT_S for v in other_vehicles
            ):
                raise
            self._scene_frame = SceneFrame(origin)  # no UAV flies near the old one, as after a wrong first position
            for other in self._vehicles.values():
                other.reset()
            vehicle.update_from_sample(sample, self._scene_frame, now)
        vehicle.process(sample, now)

    def _latest(self, message: Any, _: Stamp | None, now: float) -> None:
        vehicle = self._vehicle(message.uav)
        setattr(vehicle, message.topic, message)
        vehicle.process(message, now)

    def _accept(self, vehicle: Vehicle, stamp: Stamp | None, now: float) -> bool:
        """Return whether the fencing token of a worker message is current for a UAV."""
        if not self._fence.accepts(vehicle.uav, stamp):
            self._counts["outdated"] += 1
            return False
        vehicle.result_accepted = now
        return True

    def _model(self, model: Model, stamp: Stamp | None, now: float) -> None:
        vehicle = self._vehicle(model.uav)
        if not self._accept(vehicle, stamp, now):
            return
        vehicle.model = model
        vehicle.process(model, now)
        fit = mean_fit(model.verdict.fit)
        if fit is not None and isfinite(model.t):
            vehicle.fits.append((model.t, min(max(fit, 0.0), 100.0)))

    def _prediction(self, message: Prediction, stamp: Stamp | None, now: float) -> None:
        vehicle = self._vehicle(message.uav)
        if not self._accept(vehicle, stamp, now):
            return
        if vehicle.prediction is not None and 0 < vehicle.prediction.t - message.t < JUMP_S:
            return  # delayed: a newer one is present
        vehicle.process(message, now)
        vehicle.controller = message.controller or vehicle.controller
        if self._scene_frame is None and message.path.shape[0]:
            self._scene_frame = SceneFrame(checked_origin(message.ned_origin()))
        scene_prediction = check_prediction(message, self._scene_frame, now) if self._scene_frame is not None else None
        vehicle.prediction, vehicle.forecast = message, scene_prediction
        if scene_prediction is None:
            return
        if vehicle.past and scene_prediction.t < vehicle.past[-1].t - JUMP_S:
            vehicle.past.clear()
        coasting = message.coast_s > COASTING_S
        vehicle.last_updated_forecast = vehicle.last_updated_forecast if coasting else scene_prediction
        if not coasting and (not vehicle.past or scene_prediction.t - vehicle.past[-1].t >= 0.9):
            vehicle.past.append(scene_prediction.to_past())
            while vehicle.past[0].t < scene_prediction.t - PAST_S:
                vehicle.past.popleft()

    def _mismatch(self, mismatch: Mismatch, stamp: Stamp | None, now: float) -> None:
        vehicle = self._vehicle(mismatch.uav)
        if self._accept(vehicle, stamp, now) and np.isfinite(mismatch.t):
            vehicle.mismatch = mismatch
            vehicle.process(mismatch, now)

    def _account(self, account: GatewayCounters, _: Stamp | None, now: float) -> None:
        """Update link texts and which UAVs are replayed from a recording."""
        self.gateway = account
        for link in account.per_link[:MAX_LINKS]:
            self.links.pop(link.link, None)
            if link.sentence and len(self.links) < MAX_LINKS:
                self.links[link.link] = link.sentence
        played = bool(account.links) and all(link.startswith("replay:") for link in account.links)
        for uav in account.uavs:
            vehicle = self._vehicles.get(uav)
            if vehicle is not None and (played or now - vehicle.replay_seen > ENDED_S):
                vehicle.replay_seen = now if played else -np.inf

    def _alert(self, alert: Alert, stamp: Stamp | None, now: float) -> None:
        vehicle = self._vehicle(alert.uav)
        if stamp is not None and not self._accept(vehicle, stamp, now):  # no token: from a gateway
            return
        vehicle.process(alert, now)
        others = {about: raised for about, raised in vehicle.alerts.items() if about != alert.about}
        if len(others) < MAX_ALERTS or not alert.active:
            vehicle.alerts = {**others, alert.about: alert} if alert.active else others

    def _proposal(self, message: Proposal, stamp: Stamp | None, now: float) -> None:
        vehicle = self._vehicle(message.uav)
        if self._scene_frame is None or not self._accept(vehicle, stamp, now):
            return
        others: dict[ProposalKey, SceneProposal] = {
            about: one for about, one in vehicle.proposals.items() if about in vehicle.alerts
        }
        if len(others) < MAX_PROPOSALS or message.about in others:
            vehicle.proposals = {**others, message.about: check_proposal(message, self._scene_frame, now)}

    def _execution(self, execution: Execution, stamp: Stamp | None, now: float) -> None:
        for uav in {execution.uav, *(step.uav for step in execution.steps[:MAX_STEPS])}:
            vehicle = self._vehicle(uav)
            if vehicle.execution is None or execution.t >= vehicle.execution.t:
                vehicle.execution = execution

    def _fleet(self, fleet: FleetState, stamp: Stamp | None, now: float) -> None:
        self.sentences[stamp.writer if stamp else 0] = fleet.sentence
        while len(self.sentences) > MAX_WRITERS:
            del self.sentences[next(iter(self.sentences))]
        for row in fleet.rows:
            vehicle = self._vehicle(row.uav)
            if row.state is not TwinState.UNCLAIMED and self._accept(vehicle, stamp_of(row), now):
                vehicle.row = row
