"""Live driver: pass bus messages to the twins of this worker, publish the results and one row per UAV."""

import logging
import threading
import time
from collections.abc import Callable, Iterator

from fleet.airframes import GENERIC, Airframe, load
from fleet.bus.bus_protocol import RawMessage
from fleet.bus.codec import Stamp, decode_for_key
from fleet.bus.session import Bus
from fleet.contract import (
    Alert,
    Execution,
    FleetState,
    Message,
    Mismatch,
    Model,
    Prediction,
    Predictions,
    Proposal,
    Sample,
    Status,
)
from fleet.terrain.areas import Area
from fleet.terrain.raster import Raster
from twin_worker.alerts.conflict_probability import Separation
from twin_worker.alerts.hysteresis import AlertState
from twin_worker.alerts.traffic import TrafficMonitor
from twin_worker.mismatch.coordinator import Coordinator
from twin_worker.mismatch.job import summary
from twin_worker.ownership.cold_start import LATCHED_TYPES
from twin_worker.ownership.handover import Snapshot
from twin_worker.ownership.protocol import OwnershipProtocol
from twin_worker.ownership.twin_store import SILENT_S, OwnedTwin, TwinStore, data_time
from twin_worker.proposals.proposer import Proposer
from twin_worker.service.busy_fallback import (
    CHECK_PERIOD_S,
    fallback_prediction,
    is_superseded,
    lacks_prediction,
    publish_fallbacks,
    take_backlog,
)
from twin_worker.service.identification_thread import CpuShareLimiter, IdentificationThread
from twin_worker.service.proposal_thread import ProposalThread
from twin_worker.service.queries import QueryHandlers, copy_twin
from twin_worker.service.sibling_sharing import SiblingSharing
from twin_worker.service.wind_sharing import WindSharing
from twin_worker.service.work_rates import WorkRates
from twin_worker.twin.state.budget import ComputeBudget, Schedule, Work
from twin_worker.twin.state.state import AUTO, Twin, TwinConfig
from twin_worker.twin.step import advance, catch_up, fleet_row, rollout_age_s

_log = logging.getLogger(__name__)
_MAX_STALL_S = 1.0  # maximum silence counted between two sweeps, because a stalled worker receives nothing [s]
_STATE_S = 1.0  # between fleet tables [s]
_FOREIGN_PERIOD_S = 0.4  # between reads of other workers' predictions [s]
_FOREIGN_CPU_SHARE = 0.1  # maximum share of the CPU time of this process for these reads [-]
_SWEEP_S = 0.015  # pause before a sweep, in which telemetry arrives [s]
_COLLECTED_SHARE, _MAX_COLLECTING_S = 0.25, 0.25  # of the propagation period for which samples are collected; limit [s]
_LATE_LIMITS_S = 0.12, 0.2  # limits of the sweep period above which telemetry counts as late [s]
_LATE_PERIODS, _HEAVY_SHARE = 1.2, 0.25  # that period in propagation periods; share of it for heavy work, CPU [-]
_JOIN_TIMEOUT_S = 1.0  # wait for the end of each thread; a blocked one is abandoned [s]
_DIAGNOSIS_RETRY_S = 60.0  # pause after an internal error of the diagnosis as a whole [s]
_NEW_AIRCRAFT_S = 2.0  # an aircraft acquired within this time has priority for its first prediction [s]


class Worker:
    """Twins of the UAVs in one range of ids."""

    def __init__(
        self,
        bus: Bus,
        uavs: range,
        *,
        omega: float,
        method: str = AUTO,
        airframe: Airframe | None = None,
        separation: Separation | None = None,
        diagnosis: Coordinator | None = None,
        schedule: Schedule | None = None,
        use_siblings: bool = False,
        terrain: Raster | None = None,
        areas: tuple[Area, ...] = (),
    ) -> None:
        self.bus, self.uavs, self.diagnosis = bus, uavs, diagnosis
        self.omega, self.method, self.airframe = omega, method, airframe or load(GENERIC)
        self._terrain, self._areas = terrain, areas
        self.schedule, self._use_siblings = schedule or Schedule(), use_siblings
        self._late_after_s = min(max(_LATE_PERIODS * self.schedule.renew, _LATE_LIMITS_S[0]), _LATE_LIMITS_S[1])
        self.quota = ComputeBudget(max_limit=_HEAVY_SHARE * self._late_after_s)
        self.sentence = self._diagnosis_defect = ""
        self._diagnosis_resume_t = float("-inf")  # earliest next diagnosis [s, monotonic]
        self.rates = WorkRates()
        self.cpu_share = CpuShareLimiter()
        self.identifier = IdentificationThread(self._with_history, self.publish, self.rates, self.cpu_share)
        # start of the last sweep [s, monotonic], and time for which the samples of an aircraft are collected [s]
        self._sweep_start, self._collecting_s = float("-inf"), 0.0
        self.traffic = TrafficMonitor(separation or Separation())
        self._twins = TwinStore(bus, uavs, self._create_twin, self)
        self._twins.run_paced = self.cpu_share.run
        self._owned = self._twins.by_uav
        self.proposer = Proposer(self.traffic.separation, self._copy_of, self.traffic.picture.forecasts)
        self.proposals = ProposalThread(self, self.proposer, self.cpu_share)
        self.ownership = OwnershipProtocol(bus, uavs, self._twins)
        self.wind_sharing = WindSharing(bus, self.ownership)
        self.sibling_sharing = SiblingSharing(bus, self.ownership, self.airframe)
        self._wakeup = threading.Event()
        self._fallback_lock = threading.Lock()  # in use while fallback predictions are published; the sweep waits

    def connect(self) -> None:
        """Subscribe, declare the query handlers, and query the aircraft that exist already."""
        handlers = QueryHandlers(self.bus.writer, self.owned_twins)
        self.ownership.join()
        self.bus.subscribe(Sample, lambda message, _: self._on_message(message), self._is_owned)
        for kind in LATCHED_TYPES:
            self.bus.subscribe(kind, lambda message, _: self._on_message(message), self._in_range)
        self.bus.subscribe(Execution, lambda message, _: self.proposals.on_execution(message), self._in_range)
        self.bus.subscribe_buffered(Prediction, self._on_foreign_predictions)
        self.bus.subscribe(Model, self._on_foreign_result, lambda uav: uav in self.uavs and uav not in self._owned)
        self.bus.declare_queryable(Prediction, handlers.predictions)
        self.bus.declare_queryable(Predictions, lambda *_: [(handlers.all_predictions(), None)])
        self.bus.declare_queryable(
            Alert,
            lambda uav, *_: handlers.with_stamps(
                (owned, alert) for owned in handlers.select(uav) for alert in self.active_alerts(owned)
            ),
        )
        self.bus.declare_queryable(
            Model,
            lambda uav, *_: handlers.with_stamps((h, h.twin.identification.message) for h in handlers.select(uav)),
        )
        self.bus.declare_queryable(
            Mismatch, lambda uav, *_: handlers.with_stamps((h, self._mismatch(h)) for h in handlers.select(uav))
        )
        self.bus.declare_queryable(Proposal, lambda uav, *_: handlers.proposals(uav, self.proposer))
        self.bus.declare_queryable(FleetState, lambda *_: [(self.state(), None)])
        self.wind_sharing.connect()
        self.sibling_sharing.connect()
        for status, _ in self.bus.get(Status):
            self.ownership.on_aircraft(status.uav)

    def _create_twin(self, uav: int) -> Twin:
        config = TwinConfig(uav, self.omega, self.method, self.airframe, self.schedule)
        return Twin(config, budget=self.quota, terrain=self._terrain, areas=self._areas)

    def _copy_of(self, uav: int) -> Twin | None:
        owned = self._owned.get(uav)
        return copy_twin(owned) if owned is not None and owned.ready else None

    def _is_owned(self, uav: int) -> bool:
        """Return whether an aircraft is owned or expected; a new one is registered first."""
        self.ownership.on_aircraft(uav)
        return uav in self._owned

    def _in_range(self, uav: int) -> bool:
        """Return whether an aircraft is in the id range; a new one is registered first."""
        self.ownership.on_aircraft(uav)
        return uav in self.uavs

    def _on_message(self, message: Message) -> None:
        if self._twins.enqueue(message):
            self._wakeup.set()

    def _on_foreign_result(self, result: Prediction | Model, stamp: Stamp | None) -> None:
        """Store results of other workers; of two publishers the higher claim is valid."""
        self.ownership.observe_stamp(result.uav, stamp)
        if self._twins.cache_result(result, stamp) and isinstance(result, Prediction):
            self.traffic.receive(result)

    def _on_foreign_predictions(self, raw_messages: list[RawMessage]) -> None:
        """Decode the newest predictions of other workers, a few times a second."""
        for uav, payload, named, stamp in raw_messages:
            if uav in self._owned:
                self.ownership.observe_stamp(uav, stamp)
                continue
            try:
                prediction = decode_for_key(Prediction, uav, payload, named)
            except ValueError:
                self.bus.bad += 1
            else:
                self._on_foreign_result(prediction, stamp)

    def import_state(self, uav: int, snapshot: Snapshot) -> None:
        """Store the data received with a twin from another worker."""
        self.traffic.acquire(uav, snapshot.traffic_alerts)
        if self.diagnosis is not None and snapshot.mismatch is not None:
            self.diagnosis.state(uav).published = snapshot.mismatch

    def export_state(self, uav: int) -> tuple[AlertState, Mismatch | None]:
        """Return the data to send with a twin to another worker."""
        state = self.diagnosis.states.get(uav) if self.diagnosis is not None else None
        return self.traffic.state_of(uav), state.published if state is not None else None

    def discard(self, uav: int) -> None:
        """Discard the data of a twin that this worker no longer owns."""
        self.traffic.release(uav)
        self.proposer.discard(uav)
        if self.diagnosis is not None:
            self.diagnosis.states.pop(uav, None)

    def active_alerts(self, owned: OwnedTwin) -> list[Alert]:
        """Return the active alerts of one aircraft."""
        return owned.twin.alerts.alarms.active + self.traffic.active(owned.twin.config.uav)

    def owned_twins(self) -> list[OwnedTwin]:
        """Return the ready twins, by UAV id."""
        return self._twins.ready()

    def _with_history(self) -> list[OwnedTwin]:
        """Return the ready twins with past telemetry; none during handovers, which need the CPU time."""
        ready = [] if self.ownership.transferring else self.owned_twins()
        return [owned for owned in ready if not owned.without_history]

    def sweep(self) -> int:
        """Step every twin once; return the number of ingested messages."""
        ingested, started = 0, time.monotonic()
        for owned in self._sweep_order():
            with self._fallback_lock:
                waiting = len(owned.inbox)
            idle = not waiting and not started - owned.last_arrival > SILENT_S and not owned.lock.locked()
            if idle or (waiting and owned.collects(started, self._collecting_s)):
                continue  # the usual case
            ingested += waiting
            if owned.lock.locked():  # in identification or copied
                if (prediction := fallback_prediction(owned)) is not None:
                    self.publish(prediction, owned)
                continue
            owned.processed_at = started
            self.wind_sharing.apply(owned)
            if self._use_siblings:
                self.sibling_sharing.apply(owned)
            try:
                for result in _advance_all(owned, waiting, self.traffic):
                    if not is_superseded(result, owned):
                        self.publish(result, owned)
                self.quota.end_work()
            except Exception as error:  # an error in one aircraft must not stop the others
                owned.defect = f"{owned.twin.name}: found an internal error ({error}), expected results; report it"
                _log.exception(owned.defect)
        self._diagnose()
        return ingested

    def _sweep_order(self) -> list[OwnedTwin]:
        """Return all twins: those without a prediction first, then those with an outdated one, then the oldest rollout.

        The budget may allow heavy work for the first twins only, and a twin that cannot be propagated needs a rollout.
        """
        ordered, now = self.owned_twins(), time.monotonic()
        first = [one for one in ordered if one.twin.prediction.latest is None]
        new = [one for one in first if now - one.ready_since < _NEW_AIRCRAFT_S]
        self._update_budget()
        self.quota.begin_sweep(rollouts_only=bool(new) or self.ownership.transferring)
        ordered.sort(key=lambda one: (one not in new, not lacks_prediction(one, now), -rollout_age_s(one.twin)))
        return ordered

    def _update_budget(self) -> None:
        """Reduce the heavy work after a late sweep."""
        now = time.monotonic()
        elapsed, self._sweep_start = now - self._sweep_start, now
        late = elapsed > self._late_after_s
        if _MAX_STALL_S < elapsed < float("inf"):  # messages received meanwhile are not ingested yet: no silence
            for owned in self._owned.copy().values():
                owned.last_arrival = min(owned.last_arrival + elapsed - _MAX_STALL_S, now)
        self.cpu_share.yield_to_telemetry(late or self.ownership.transferring)  # later raised step by step
        if self.ownership.threaded:
            self.quota.yield_to_telemetry(late)
        for work in (Work.PREDICT, Work.ENSEMBLE):
            if done := self.quota.done.pop(work, 0):
                self.rates.record(work, now, done)

    def publish(self, result: Message, owned: OwnedTwin) -> None:
        """Publish a result with its stamp; discard it without confirmed ownership."""
        if owned.ready and self.ownership.may_write():
            self.bus.publish(result, Stamp(owned.epoch, self.bus.writer))
            if isinstance(result, Prediction):
                owned.publishing, owned.published_at = True, time.monotonic()

    def _diagnose(self) -> None:
        """Run the background diagnosis once, and publish its results."""
        if self.diagnosis is None or time.monotonic() < self._diagnosis_resume_t:
            return
        by_uav = {owned.twin.config.uav: owned for owned in self.owned_twins()}
        try:
            for mismatch in self.diagnosis.run_once([(one.twin, one.lock) for one in by_uav.values()]):
                self.publish(mismatch, by_uav[mismatch.uav])
            self._diagnosis_defect = ""
        except Exception as error:  # an error in the diagnosis must not stop the predictions
            self._diagnosis_defect = (
                f"diagnosis failed with an internal error ({error}); retried in {_DIAGNOSIS_RETRY_S:.0f} s, report it"
            )
            self._diagnosis_resume_t = time.monotonic() + _DIAGNOSIS_RETRY_S
            _log.exception(self._diagnosis_defect)

    def _mismatch(self, owned: OwnedTwin) -> Mismatch | None:
        state = self.diagnosis and self.diagnosis.states.get(owned.twin.config.uav)
        return state.published if state else None

    def state(self) -> FleetState:
        """Return the fleet table of this worker."""
        writer = f"{self.bus.writer:016x}"
        rows = [
            fleet_row(
                owned.twin,
                data_time(owned),
                self.active_alerts(owned),
                worker=writer,
                epoch=owned.epoch,
                mismatch=summary(self._mismatch(owned)),
            )
            for owned in self.owned_twins()
        ]
        dropped = sum(entry.dropped for entry in self.owned_twins())
        messages = [f"{dropped} messages dropped: too many UAVs for this worker"] if dropped else []
        messages += self.rates.overload_messages(self.schedule, len(self.owned_twins()), time.monotonic())
        messages += filter(None, [*(owned.defect for owned in self.owned_twins()), self._diagnosis_defect])
        if self.diagnosis is not None:
            messages += self.diagnosis.defects(owned.twin.config.uav for owned in self.owned_twins())
        done = {work.value: n for work, n in self.rates.total.items()}
        sentence = self.sentence or " ".join(messages[:3])
        return FleetState(t=time.time(), rows=tuple(rows), sentence=sentence, tasks=done, dropped_messages=dropped)

    def run(self, stop: threading.Event) -> None:
        """Connect, sweep until `stop` is set, publish the fleet table once a second; then hand everything over."""
        self.ownership.threaded, self.quota.offloaded = True, frozenset({Work.IDENTIFY})
        self._collecting_s = min(_COLLECTED_SHARE * self.schedule.renew, _MAX_COLLECTING_S)
        self.connect()
        sharing = self.wind_sharing.run, self.sibling_sharing.run
        loops = self.ownership.run, self.identifier.run, self.proposals.run, *sharing
        threads = [threading.Thread(target=run, args=(stop,), daemon=True) for run in loops]
        left = threading.Event()
        threads.append(threading.Thread(target=self._publish_fallbacks, args=(left,), daemon=True))
        for thread in threads:
            thread.start()
        self._sweep_while(lambda: not stop.is_set())
        handover = threading.Thread(target=self.ownership.leave, daemon=True)
        handover.start()
        self._sweep_while(handover.is_alive)  # each aircraft is published until its handover
        left.set()
        for thread in (*threads, handover):
            thread.join(_JOIN_TIMEOUT_S)

    def _publish_fallbacks(self, stop: threading.Event) -> None:
        """Publish fallback predictions for late twins, on a thread that waits for no other work."""
        while not stop.wait(CHECK_PERIOD_S):
            try:
                with self._fallback_lock:
                    publish_fallbacks(self.owned_twins(), self.publish)
            except ConnectionError:  # the session is closed: shutdown
                return
            except Exception:  # an error must not stop the fallbacks
                _log.exception("fallback predictions failed with an internal error; report it")

    def _sweep_while(self, condition: Callable[[], bool]) -> None:
        publish_t, read_t, read_cpu, pause = 0.0, 0.0, 0.0, threading.Event()
        while condition():
            self._wakeup.wait(timeout=0.1)
            pause.wait(_SWEEP_S)
            self._wakeup.clear()
            self.ownership.tick()
            self.sweep()
            if time.monotonic() >= read_t and time.process_time() >= read_cpu:
                started = time.thread_time()
                self.bus.dispatch((Prediction,))
                read_t = time.monotonic() + _FOREIGN_PERIOD_S
                read_cpu = time.process_time() + (time.thread_time() - started) * (1.0 / _FOREIGN_CPU_SHARE - 1.0)
            if time.monotonic() >= publish_t:
                publish_t = time.monotonic() + _STATE_S
                self.bus.publish(self.state())


def _advance_all(owned: OwnedTwin, waiting: int, traffic: TrafficMonitor) -> Iterator[Message]:
    """Step the twin after every message, as offline; without data the wall clock steps it.

    With a limited budget, queued messages are ingested together, because a late worker could not catch up otherwise.
    """
    twin = owned.twin
    if twin.budget is not None and twin.budget.limited and waiting > 1:
        with owned.lock:
            if not owned.ready:
                return
            twin.budget.backlog = True
            results = catch_up(twin, take_backlog(owned, waiting - 1, overloaded=twin.budget.overloaded))
        yield from traffic.process_results(twin.config.uav, twin.telemetry.last_step_t, results)
        waiting = 1
    for queued in reversed(range(waiting)):
        with owned.lock:
            if not owned.ready:  # released meanwhile, with the rest of its inbox
                return
            if twin.budget is not None:
                twin.budget.backlog = queued > 0
            results = advance(twin, (owned.inbox.popleft(),))
        yield from traffic.process_results(twin.config.uav, twin.telemetry.last_step_t, results)
    now = data_time(owned)
    if not waiting and now > twin.telemetry.history.newest:  # a late worker does not detect silence
        with owned.lock:
            results = advance(twin, (), now) if owned.ready else []
        yield from traffic.process_results(twin.config.uav, twin.telemetry.last_step_t, results)
