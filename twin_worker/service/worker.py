"""Live driver: pass bus messages to the twins of this worker, publish the results and one row per UAV."""

import logging
import threading
import time
from collections.abc import Callable, Iterator

from fleet.airframes import GENERIC, Airframe, load
from fleet.bus.bus_protocol import Bus, Letter
from fleet.bus.codec import Stamp, decode_from
from fleet.contract import (
    Alert,
    FleetState,
    Message,
    Mismatch,
    Model,
    Prediction,
    Predictions,
    Sample,
    Status,
)
from twin_worker.alerts.conflict_probability import Separation
from twin_worker.alerts.hysteresis import Ledger
from twin_worker.alerts.traffic import Traffic
from twin_worker.mismatch.coordinator import Live
from twin_worker.mismatch.messages import word
from twin_worker.ownership.handover import Load
from twin_worker.ownership.history_query import SELDOM
from twin_worker.ownership.protocol import Claiming
from twin_worker.ownership.twin_store import Held, Twins
from twin_worker.service.busy_fallback import LOOK_S, lacks_prediction, said_already, stand_in, stand_in_for
from twin_worker.service.cpu_share import Beside
from twin_worker.service.identification_thread import Learner
from twin_worker.service.queries import Answers
from twin_worker.service.work_rates import Rates
from twin_worker.twin.state.budget import Quota
from twin_worker.twin.state.schedule import Pace, Work
from twin_worker.twin.state.state import AUTO
from twin_worker.twin.step import Twin, advance, catch_up, fleet_row

_log = logging.getLogger(__name__)
_SILENT_S = 1.0  # wall time without a sample after which data time follows the wall clock [s]
_STALL_S = 1.0  # maximum silence counted between two sweeps, because a stalled worker receives nothing [s]
_STATE_S = 1.0  # between fleet tables [s]
_OTHERS_S = 0.4  # between reads of other workers' predictions [s]
_OTHERS = 0.1  # maximum share of the CPU time of this process for these reads [-]
_SWEEP_S = 0.015  # telemetry is collected for this time before a sweep [s]
_LATE_S = 0.12, 0.2  # limits of the sweep period above which telemetry counts as late [s]
_LATE, _HEAVY = 1.2, 0.25  # that period in propagation periods; share of it for heavy work, CPU [-]
_END_S = 1.0  # wait for the end of each thread; a blocked one is abandoned [s]
_OFF_S = 60.0  # pause after an internal error of the diagnosis as a whole [s]
_NEW_S = 2.0  # an aircraft acquired within this time has priority for its first prediction [s]


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
        diagnosis: Live | None = None,
        pace: Pace | None = None,
    ) -> None:
        self.bus, self.uavs, self.diagnosis = bus, uavs, diagnosis
        self.omega, self.method, self.airframe = omega, method, airframe or load(GENERIC)
        self.pace = pace or Pace()
        self._late = min(max(_LATE * self.pace.renew, _LATE_S[0]), _LATE_S[1])  # short for frequent propagation
        self.quota = Quota(most=_HEAVY * self._late)
        self.sentence = self._undiagnosed = ""
        self._diagnose_from = float("-inf")  # earliest next diagnosis [s, monotonic]
        self.rates = Rates()
        self.beside = Beside()
        self.learner = Learner(self._whole, self._publish, self.rates, self.beside)
        self._swept = float("-inf")  # start of the last sweep [s, monotonic]
        self._first = 0  # index of the first aircraft of the next sweep
        self.traffic = Traffic(separation or Separation())
        self._twins = Twins(bus, uavs, self._make, self)
        self._twins.paced = self.beside.do
        self._held = self._twins.held
        self.claiming = Claiming(bus, uavs, self._twins)
        self._news = threading.Event()
        self._renewing = threading.Lock()  # in use while fallback predictions are published; the sweep waits for it

    def listen(self) -> None:
        """Subscribe, declare the query handlers, and query the aircraft that exist already."""
        told = Answers(self.bus.writer, self.holding)
        self.claiming.join()
        self.bus.subscribe(Sample, lambda message, _: self._hear(message), self._wants)
        for kind in SELDOM:
            self.bus.subscribe(kind, lambda message, _: self._hear(message), self._may_want)
        self.bus.collect(Prediction, self._overhear_all)
        self.bus.subscribe(Model, self._overhear, lambda uav: uav in self.uavs and uav not in self._held)
        self.bus.answer(Prediction, told.predictions)
        self.bus.answer(Predictions, lambda *_: [(told.at_once(), None)])
        self.bus.answer(Alert, lambda uav, *_: told.stamped((h, a) for h in told.of(uav) for a in self.active(h)))
        self.bus.answer(Model, lambda uav, *_: told.stamped((h, h.twin.model) for h in told.of(uav)))
        self.bus.answer(Mismatch, lambda uav, *_: told.stamped((h, self._found(h)) for h in told.of(uav)))
        self.bus.answer(FleetState, lambda *_: [(self.state(), None)])
        for status, _ in self.bus.ask(Status):
            self.claiming.hear_of(status.uav)

    def _make(self, uav: int) -> Twin:
        return Twin(uav, omega=self.omega, method=self.method, airframe=self.airframe, pace=self.pace, quota=self.quota)

    def _wants(self, uav: int) -> bool:
        """Return whether an aircraft is owned or expected; a new one is registered first."""
        self.claiming.hear_of(uav)
        return uav in self._held

    def _may_want(self, uav: int) -> bool:
        """Return whether an aircraft is in the id range; a new one is registered first."""
        self.claiming.hear_of(uav)
        return uav in self.uavs

    def _hear(self, message: Message) -> None:
        if self._twins.hear(message):
            self._news.set()

    def _overhear(self, said: Prediction | Model, stamp: Stamp | None) -> None:
        """Store results of other workers; of two publishers the higher claim is valid."""
        self.claiming.overheard(said.uav, stamp)
        if self._twins.overhear(said, stamp) and isinstance(said, Prediction):
            self.traffic.hear(said)

    def _overhear_all(self, letters: list[Letter]) -> None:
        """Decode the newest predictions of other workers, a few times a second."""
        for uav, payload, named, stamp in letters:
            if uav in self._held:
                self.claiming.overheard(uav, stamp)
                continue
            try:
                said = decode_from(Prediction, uav, payload, named)
            except ValueError:
                self.bus.bad += 1
            else:
                self._overhear(said, stamp)

    def take(self, uav: int, load: Load) -> None:
        """Store the data received with a twin from another worker."""
        self.traffic.take(uav, load.conflicts)
        if self.diagnosis is not None and load.mismatch is not None:
            self.diagnosis.watch(uav).told = load.mismatch

    def show(self, uav: int) -> tuple[Ledger, Mismatch | None]:
        """Return the data to send with a twin to another worker."""
        watch = self.diagnosis.watches.get(uav) if self.diagnosis is not None else None
        return self.traffic.show(uav), watch.told if watch is not None else None

    def forget(self, uav: int) -> None:
        """Discard the data of a twin that this worker no longer owns."""
        self.traffic.forget(uav)
        if self.diagnosis is not None:
            self.diagnosis.watches.pop(uav, None)

    def active(self, held: Held) -> list[Alert]:
        """Return the active alerts of one aircraft."""
        return held.twin.ledger.active + self.traffic.active(held.twin.uav)

    def holding(self) -> list[Held]:
        """Return the ready twins, by UAV id."""
        return self._twins.ready()

    def _whole(self) -> list[Held]:
        """Return the ready twins with past telemetry."""
        return [held for held in self.holding() if not held.bare]

    def turn(self) -> int:
        """Step every twin once; return the number of ingested messages."""
        taken, begun = 0, time.monotonic()
        for held in self._in_turn():
            with self._renewing:
                waiting = len(held.inbox)
            taken += waiting
            if not waiting and not begun - held.arrived > _SILENT_S and not held.lock.locked():
                continue  # the usual case
            if held.lock.locked():  # in identification or copied
                if (made := stand_in(held)) is not None:
                    self._publish(made, held)
                continue
            try:
                for result in _advance_all(held, waiting, self.traffic):
                    if not said_already(result, held):
                        self._publish(result, held)
                self.quota.settle()
            except Exception as error:  # an error in one aircraft must not stop the others
                held.failed = f"{held.twin.name}: found an internal error ({error}), expected results; report it"
                _log.exception(held.failed)
        self._diagnose()
        return taken

    def _in_turn(self) -> list[Held]:
        """Return all twins: those without a prediction first, then those with an outdated one, then in rotating order.

        The budget may allow heavy work for the first twins only, and a twin that cannot be propagated needs a rollout.
        """
        found = self.holding()
        self._first = (self._first + 1) % max(len(found), 1)
        found = found[self._first :] + found[: self._first]
        new = [held for held in found if held.twin.prediction is None and time.monotonic() - held.since < _NEW_S]
        self._watch_time()
        self.quota.sweep(hurry=bool(new))
        now = time.monotonic()
        found.sort(key=lambda held: (held not in new, not lacks_prediction(held, now)))
        return found

    def _watch_time(self) -> None:
        """Reduce the heavy work after a late sweep."""
        now = time.monotonic()
        passed, self._swept = now - self._swept, now
        late = passed > self._late
        if _STALL_S < passed < float("inf"):  # messages received meanwhile are not ingested yet: no silence
            for held in self._held.copy().values():
                held.arrived = min(held.arrived + passed - _STALL_S, now)
        self.beside.yield_to_telemetry(late)
        if self.claiming.threaded:
            self.quota.yield_to_telemetry(late)
        for work in (Work.PREDICT, Work.ENSEMBLE):
            if done := self.quota.done.pop(work, 0):
                self.rates.note(work, now, done)

    def _publish(self, result: Message, held: Held) -> None:
        """Publish a result with its stamp; discard it without confirmed ownership."""
        if held.ready and self.claiming.may_write():
            self.bus.publish(result, Stamp(held.epoch, self.bus.writer))
            if isinstance(result, Prediction):
                held.written, held.published = True, time.monotonic()

    def _diagnose(self) -> None:
        """Run the background diagnosis once, and publish its results."""
        if self.diagnosis is None or time.monotonic() < self._diagnose_from:
            return
        held = {one.twin.uav: one for one in self.holding()}
        try:
            for found in self.diagnosis.turn([(one.twin, one.lock) for one in held.values()]):
                self._publish(found, held[found.uav])
            self._undiagnosed = ""
        except Exception as error:  # an error in the diagnosis must not stop the predictions
            self._undiagnosed = (
                f"diagnosis failed with an internal error ({error}); retried in {_OFF_S:.0f} s, report it"
            )
            self._diagnose_from = time.monotonic() + _OFF_S
            _log.exception(self._undiagnosed)

    def _found(self, held: Held) -> Mismatch | None:
        watch = self.diagnosis and self.diagnosis.watches.get(held.twin.uav)
        return watch.told if watch else None

    def state(self) -> FleetState:
        """Return the fleet table of this worker."""
        writer = f"{self.bus.writer:016x}"
        rows = [
            fleet_row(h.twin, data_time(h), self.active(h), worker=writer, epoch=h.epoch, mismatch=word(self._found(h)))
            for h in self.holding()
        ]
        shed = sum(held.shed for held in self.holding())
        said = [f"{shed} messages dropped: too many UAVs for this worker"] if shed else []
        said += self.rates.said(self.pace, len(self.holding()), time.monotonic())
        said += [held.failed for held in self.holding() if held.failed]
        if self.diagnosis is not None:
            said += [self._undiagnosed] if self._undiagnosed else []
            said += self.diagnosis.failed(held.twin.uav for held in self.holding())
        done = {work.value: n for work, n in self.rates.total.items()}
        sentence = self.sentence or " ".join(said[:3])
        return FleetState(t=time.time(), rows=tuple(rows), sentence=sentence, done=done, shed=shed)

    def run(self, stop: threading.Event) -> None:
        """Connect, sweep until `stop` is set, publish the fleet table once a second; then hand everything over."""
        self.claiming.threaded, self.quota.aside = True, frozenset({Work.IDENTIFY})
        self.listen()
        each = (self.claiming.run, self.learner.run, self._stand_in)
        hands = [threading.Thread(target=run, args=(stop,), daemon=True) for run in each]
        for hand in hands:
            hand.start()
        self._turn_while(lambda: not stop.is_set())
        heirs = threading.Thread(target=self.claiming.leave, daemon=True)
        heirs.start()
        self._turn_while(heirs.is_alive)  # each aircraft is published until its handover
        for hand in (*hands, heirs):
            hand.join(_END_S)

    def _stand_in(self, stop: threading.Event) -> None:
        """Publish fallback predictions for late twins, on a thread that waits for no other work."""
        while not stop.wait(LOOK_S):
            try:
                with self._renewing:
                    stand_in_for(self.holding(), self._publish)
            except ConnectionError:  # the session is closed: shutdown
                return
            except Exception:  # an error must not stop the fallbacks
                _log.exception("fallback predictions failed with an internal error; report it")

    def _turn_while(self, condition: Callable[[], bool]) -> None:
        due, listen, enough, pause = 0.0, 0.0, 0.0, threading.Event()
        while condition():
            self._news.wait(timeout=0.1)
            pause.wait(_SWEEP_S)
            self._news.clear()
            self.claiming.tick()
            self.turn()
            if time.monotonic() >= listen and time.process_time() >= enough:
                begun = time.thread_time()
                self.bus.hand_out((Prediction,))
                listen = time.monotonic() + _OTHERS_S
                enough = time.process_time() + (time.thread_time() - begun) * (1.0 / _OTHERS - 1.0)
            if time.monotonic() >= due:
                due = time.monotonic() + _STATE_S
                self.bus.publish(self.state())


def data_time(held: Held) -> float:
    """Return the UAV's current data time [s]: its newest sample, plus the wall time since it fell silent."""
    silent = time.monotonic() - held.arrived
    newest = held.twin.history.newest
    return newest + silent if silent > _SILENT_S else newest


def _advance_all(held: Held, waiting: int, traffic: Traffic) -> Iterator[Message]:
    """Step the twin after every message, as offline; without data the wall clock steps it.

    With a limited budget, queued messages are ingested together, because a late worker could not catch up otherwise.
    """
    twin = held.twin
    if twin.quota is not None and twin.quota.limited and waiting > 1:
        with held.lock:
            if not held.ready:
                return
            twin.quota.behind = True
            results = catch_up(twin, [held.inbox.popleft() for _ in range(waiting - 1)])
        yield from traffic.after(twin.uav, twin.turned_t, results)
        waiting = 1
    for left in reversed(range(waiting)):
        with held.lock:
            if not held.ready:  # released meanwhile, with the rest of its inbox
                return
            if twin.quota is not None:
                twin.quota.behind = left > 0
            results = advance(twin, (held.inbox.popleft(),))
        yield from traffic.after(twin.uav, twin.turned_t, results)
    now = data_time(held)
    if not waiting and now > twin.history.newest:  # a late worker does not detect silence
        with held.lock:
            results = advance(twin, (), now) if held.ready else []
        yield from traffic.after(twin.uav, twin.turned_t, results)
