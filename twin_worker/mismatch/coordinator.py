"""Diagnose the aircraft of one worker in turn, the most urgent first, without ever making a prediction wait."""

import logging
from _thread import LockType
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import partial
from types import MappingProxyType
from typing import Protocol, TypeVar

from fleet.contract import Found, Mismatch
from twin_worker.diagnosis.data.card import UNKNOWN
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.mismatch.adapt_models import extend
from twin_worker.mismatch.job import Answer, Job
from twin_worker.mismatch.messages import judged
from twin_worker.mismatch.scheduler import Watch
from twin_worker.twin.state.state import Twin

_log = logging.getLogger(__name__)
T = TypeVar("T")
ALL = -1  # instead of a UAV id
Held = tuple[Twin, AbstractContextManager]  # a twin, and the lock it changes under


class Hand(Protocol):
    """Whoever works out jobs, one at a time."""

    @property
    def free(self) -> bool:
        """Return whether a job may be given now."""

    def give(self, job: Job) -> None:
        """Begin a job."""

    def answer(self) -> Answer | None:
        """Return an answer that has arrived; None while there is none."""


class Live:
    """The mismatches of the aircraft a worker holds.

    Args:
        hand: works the diagnoses out
        bases: what aircraft are compared with, by UAV id, `ALL` for every other; without one, each with its own past
        adapt: predict with what was named
    """

    def __init__(self, hand: Hand, bases: Mapping[int, Baseline] = MappingProxyType({}), *, adapt: bool = True) -> None:
        self._hand, self._bases, self._adapt = hand, bases, adapt
        self.watches: dict[int, Watch] = {}
        self._waiting: Answer | None = None  # for an aircraft whose lock is held

    def watch(self, uav: int) -> Watch:
        """Return what is known of one aircraft."""
        if uav not in self.watches:
            base = self._bases.get(uav, self._bases.get(ALL))
            self.watches[uav] = Watch(UNKNOWN if base is None else base.card, base)
        return self.watches[uav]

    def turn(self, held: Sequence[Held]) -> Iterator[Mismatch]:
        """Take an answer that has arrived, and begin the most urgent job where one may begin.

        A defect met by one aircraft is that aircraft's alone: it is said, logged, and left for a while.
        """
        twins = {twin.uav: (twin, lock) for twin, lock in held}
        if (answer := self._waiting or self._hand.answer()) is not None:
            self._waiting = answer if _locked(twins.get(answer.uav)) else None
            if self._waiting is not None:  # it is identified just now: the telemetry of the others does not wait for it
                return
            uav, t = answer.uav, answer.end
            yield from self._isolated(uav, t, lambda: self._take(answer, twins)) or ()
        if not self._hand.free:
            return
        due = []
        for twin, _ in held:
            urgent = self._isolated(twin.uav, twin.history.newest, partial(self._urgency, twin))
            if urgent is not None:
                due.append((urgent, twin))
        if due:
            twin = max(due, key=lambda one: one[0])[1]
            job = self._isolated(twin.uav, twin.history.newest, lambda: self.watch(twin.uav).job(twin))
            if job is not None:
                self._hand.give(job)

    def failed(self, uavs: Iterable[int]) -> list[str]:
        """Say what defects the diagnoses of these aircraft met last."""
        return [self.watches[uav].failed for uav in uavs if uav in self.watches and self.watches[uav].failed]

    def _urgency(self, twin: Twin) -> float | None:
        return self.watch(twin.uav).wants(twin)

    def _isolated(self, uav: int, t: float, do: Callable[[], T]) -> T | None:
        """Do something for one aircraft at data time `t`; None where that met a defect."""
        try:
            return do()
        except Exception as error:
            watch = self.watch(uav)
            watch.give_up(uav, t, f"{type(error).__name__}: {error}")
            _log.exception("%s", watch.failed)
            return None

    def _take(self, answer: Answer, held: dict[int, Held]) -> list[Mismatch]:
        watch = self.watch(answer.uav)
        told = watch.take(answer)
        if answer.failed:
            _log.error("%s", "\n".join(filter(None, (watch.failed, answer.details))))
        if told is None or answer.uav not in held:
            return []
        twin, lock = held[answer.uav]
        if self._adapt:
            with lock:
                told = watch.told = _adapted(twin, told, answer)
        return [told]


def _locked(held: Held | None) -> bool:
    return held is not None and isinstance(held[1], LockType) and held[1].locked()


def _adapted(twin: Twin, told: Mismatch, answer: Answer) -> Mismatch:
    """Put what was named into the models of a twin, once; what is over is left to what was learnt since."""
    if told.outcome is Found.NONE:
        twin.extended = None
    if told.outcome is not Found.NAMED or answer.pushes is None:
        return told
    names = " and ".join(one.name for one in told.causes)
    if twin.extended is not None and twin.extended.names == names:
        return judged(told, "predictions are flown with it", used=True)
    tried = extend(twin, answer.pushes, names)
    return judged(told, tried.said, used=tried.used)
