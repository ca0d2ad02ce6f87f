"""The live driver: messages from the bus to the twins this worker holds, results back, one line per UAV."""

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
_SILENT_S = 1.0  # wall time without news after which data time runs on by the wall clock [s]
_STALL_S = 1.0  # of silence counted between two sweeps at most: a worker that stood still knows of no silence [s]
_STATE_S = 1.0  # between fleet tables [s]
_OTHERS_S = 0.4  # between looks at what others predict [s]
_OTHERS = 0.1  # of the CPU time of this process that such a look may take [-]
_SWEEP_S = 0.015  # of telemetry is taken in at once [s]
_LATE_S = 0.12, 0.2  # between sweeps, from which telemetry counts as late: least and most [s]
_LATE, _HEAVY = 1.2, 0.25  # that in periods of renewal; what heavy work may take of it, CPU [-]
_END_S = 1.0  # for a thread to end what it has begun; one that is late is left behind [s]
_OFF_S = 60.0  # after a defect of the diagnosis that is no aircraft's [s]
_NEW_S = 2.0  # an aircraft that came so lately is predicted before any other work begins [s]


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
        self._late = min(max(_LATE * self.pace.renew, _LATE_S[0]), _LATE_S[1])  # who renews often wants short sweeps
        self.quota = Quota(most=_HEAVY * self._late)
        self.sentence = self._undiagnosed = ""
        self._diagnose_from = float("-inf")  # no diagnosis is begun before [s, monotonic]
        self.rates = Rates()
        self.beside = Beside()
        self.learner = Learner(self._whole, self._publish, self.rates, self.beside)
        self._swept = float("-inf")  # when the last sweep began [s, monotonic]
        self._first = 0  # whose turn is the first of the next sweep
        self.traffic = Traffic(separation or Separation())
        self._twins = Twins(bus, uavs, self._make, self)
        self._twins.paced = self.beside.do
        self._held = self._twins.held
        self.claiming = Claiming(bus, uavs, self._twins)
        self._news = threading.Event()
        self._renewing = threading.Lock()  # held while late predictions are renewed: the sweep waits for that

    def listen(self) -> None:
        """Subscribe, answer queries, and ask for what was said before this worker came."""
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
        """Return whether an aircraft is held, or about to be; one never heard of may be claimed."""
        self.claiming.hear_of(uav)
        return uav in self._held

    def _may_want(self, uav: int) -> bool:
        """Return whether an aircraft may ever be held."""
        self.claiming.hear_of(uav)
        return uav in self.uavs

    def _hear(self, message: Message) -> None:
        if self._twins.hear(message):
            self._news.set()

    def _overhear(self, said: Prediction | Model, stamp: Stamp | None) -> None:
        """Keep what others say of their aircraft; of two writers the higher claim is believed."""
        self.claiming.overheard(said.uav, stamp)
        if self._twins.overhear(said, stamp) and isinstance(said, Prediction):
            self.traffic.hear(said)

    def _overhear_all(self, letters: list[Letter]) -> None:
        """Read what others predict: the newest of each aircraft, a few times a second."""
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
        """Keep what came with a twin from another worker."""
        self.traffic.take(uav, load.conflicts)
        if self.diagnosis is not None and load.mismatch is not None:
            self.diagnosis.watch(uav).told = load.mismatch

    def show(self, uav: int) -> tuple[Ledger, Mismatch | None]:
        """Return what goes with a twin to another worker."""
        watch = self.diagnosis.watches.get(uav) if self.diagnosis is not None else None
        return self.traffic.show(uav), watch.told if watch is not None else None

    def forget(self, uav: int) -> None:
        """Give up what belongs to a twin that is held here no longer."""
        self.traffic.forget(uav)
        if self.diagnosis is not None:
            self.diagnosis.watches.pop(uav, None)

    def active(self, held: Held) -> list[Alert]:
        """Return the alerts of one aircraft that are in force."""
        return held.twin.ledger.active + self.traffic.active(held.twin.uav)

    def holding(self) -> list[Held]:
        """Return what this worker holds, by UAV id."""
        return self._twins.ready()

    def _whole(self) -> list[Held]:
        """Return those held that have heard what was said before."""
        return [held for held in self.holding() if not held.bare]

    def turn(self) -> int:
        """Advance every twin once; return how many messages were taken in."""
        taken, begun = 0, time.monotonic()
        for held in self._in_turn():
            with self._renewing:
                waiting = len(held.inbox)
            taken += waiting
            if not waiting and not begun - held.arrived > _SILENT_S and not held.lock.locked():
                continue  # as it is with most in most sweeps
            if held.lock.locked():  # it is identified just now, or copied
                if (made := stand_in(held)) is not None:
                    self._publish(made, held)
                continue
            try:
                for result in _advance_all(held, waiting, self.traffic):
                    if not said_already(result, held):
                        self._publish(result, held)
                self.quota.settle()
            except Exception as error:  # a defect met by one aircraft must not stop the others
                held.failed = f"{held.twin.name}: found a defect ({error}), its results are missing; report it"
                _log.exception(held.failed)
        self._diagnose()
        return taken

    def _in_turn(self) -> list[Held]:
        """Return all, those without a prediction first, then those whose last is old, then each sweep another.

        Heavy work may go to the first alone, and who could not be renewed has nothing but a flight ahead to wait for.
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
        """Let heavy work wait where telemetry does: a sweep that was late leaves it a share of the CPU time."""
        now = time.monotonic()
        passed, self._swept = now - self._swept, now
        late = passed > self._late
        if _STALL_S < passed < float("inf"):  # what arrived meanwhile is not taken in yet: that is no silence
            for held in self._held.copy().values():
                held.arrived = min(held.arrived + passed - _STALL_S, now)
        self.beside.yield_to_telemetry(late)
        if self.claiming.threaded:
            self.quota.yield_to_telemetry(late)
        for work in (Work.PREDICT, Work.ENSEMBLE):
            if done := self.quota.done.pop(work, 0):
                self.rates.note(work, now, done)

    def _publish(self, result: Message, held: Held) -> None:
        """Publish under the claim in force; what is held no longer, or not surely, is kept back."""
        if held.ready and self.claiming.may_write():
            self.bus.publish(result, Stamp(held.epoch, self.bus.writer))
            if isinstance(result, Prediction):
                held.written, held.published = True, time.monotonic()

    def _diagnose(self) -> None:
        """Let the diagnosis go on in the background, and publish what it found."""
        if self.diagnosis is None or time.monotonic() < self._diagnose_from:
            return
        held = {one.twin.uav: one for one in self.holding()}
        try:
            for found in self.diagnosis.turn([(one.twin, one.lock) for one in held.values()]):
                self._publish(found, held[found.uav])
            self._undiagnosed = ""
        except Exception as error:  # a defect of the diagnosis must not stop the predictions
            self._undiagnosed = f"the diagnosis met a defect ({error}); it is tried again in {_OFF_S:.0f} s, report it"
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
        said = [f"{shed} messages shed: too many UAVs for this worker"] if shed else []
        said += self.rates.said(self.pace, len(self.holding()), time.monotonic())
        said += [held.failed for held in self.holding() if held.failed]
        if self.diagnosis is not None:
            said += [self._undiagnosed] if self._undiagnosed else []
            said += self.diagnosis.failed(held.twin.uav for held in self.holding())
        done = {work.value: n for work, n in self.rates.total.items()}
        sentence = self.sentence or " ".join(said[:3])
        return FleetState(t=time.time(), rows=tuple(rows), sentence=sentence, done=done, shed=shed)

    def run(self, stop: threading.Event) -> None:
        """Join, turn until told to stop, publishing the fleet table once a second; then hand everything over."""
        self.claiming.threaded, self.quota.aside = True, frozenset({Work.IDENTIFY})
        self.listen()
        each = (self.claiming.run, self.learner.run, self._stand_in)
        hands = [threading.Thread(target=run, args=(stop,), daemon=True) for run in each]
        for hand in hands:
            hand.start()
        self._turn_while(lambda: not stop.is_set())
        heirs = threading.Thread(target=self.claiming.leave, daemon=True)
        heirs.start()
        self._turn_while(heirs.is_alive)  # each is written for until its own turn to go comes
        for hand in (*hands, heirs):
            hand.join(_END_S)

    def _stand_in(self, stop: threading.Event) -> None:
        """Look after aircraft whose twins are late, on a thread of its own: it waits for no other work."""
        while not stop.wait(LOOK_S):
            try:
                with self._renewing:
                    stand_in_for(self.holding(), self._publish)
            except ConnectionError:  # the session is closed: we are leaving
                return
            except Exception:  # a defect met once must not end the renewals
                _log.exception("renewing late predictions met a defect; report it")

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
    """Return the UAV's data time now: its newest sample, and the wall time since where it has fallen silent [s]."""
    silent = time.monotonic() - held.arrived
    newest = held.twin.history.newest
    return newest + silent if silent > _SILENT_S else newest


def _advance_all(held: Held, waiting: int, traffic: Traffic) -> Iterator[Message]:
    """Turn the loop after every message, as offline; the wall clock turns it on where data have fallen silent.

    Where the quota has a limit, what has waited is taken in at once: a late worker would otherwise never catch up.
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
            if not held.ready:  # handed over meanwhile, with what still waits
                return
            if twin.quota is not None:
                twin.quota.behind = left > 0
            results = advance(twin, (held.inbox.popleft(),))
        yield from traffic.after(twin.uav, twin.turned_t, results)
    now = data_time(held)
    if not waiting and now > twin.history.newest:  # a worker that is late hears no silence
        with held.lock:
            results = advance(twin, (), now) if held.ready else []
        yield from traffic.after(twin.uav, twin.turned_t, results)
