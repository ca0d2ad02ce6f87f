"""Coordinate the diagnoses of a worker's aircraft, most urgent first, without delaying any prediction."""

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
ALL = -1  # in place of a UAV id
Held = tuple[Twin, AbstractContextManager]  # a twin and its lock


class Hand(Protocol):
    """Executes diagnosis jobs, one at a time."""

    @property
    def free(self) -> bool:
        """Return whether a job can be submitted now."""

    def give(self, job: Job) -> None:
        """Start a job."""

    def answer(self) -> Answer | None:
        """Return a finished result; None if there is none."""


class Live:
    """Mismatch diagnosis of the aircraft that a worker owns.

    Args:
        executor: executes the diagnoses
        baselines: comparison models by UAV id, `ALL_UAVS` for all others; by default each UAV's own past
        adapt: adapt the prediction models to diagnosed effects
    """

    def __init__(self, hand: Hand, bases: Mapping[int, Baseline] = MappingProxyType({}), *, adapt: bool = True) -> None:
        self._hand, self._bases, self._adapt = hand, bases, adapt
        self.watches: dict[int, Watch] = {}
        self._waiting: Answer | None = None  # its aircraft's lock is in use

    def watch(self, uav: int) -> Watch:
        """Return the diagnosis state of one aircraft."""
        if uav not in self.watches:
            base = self._bases.get(uav, self._bases.get(ALL))
            self.watches[uav] = Watch(UNKNOWN if base is None else base.card, base)
        return self.watches[uav]

    def turn(self, held: Sequence[Held]) -> Iterator[Mismatch]:
        """Process a finished result, and submit the most urgent job if the executor is free.

        An internal error affects only its own aircraft: it is reported and logged, and the aircraft is suspended.
        """
        twins = {twin.uav: (twin, lock) for twin, lock in held}
        if (answer := self._waiting or self._hand.answer()) is not None:
            self._waiting = answer if _locked(twins.get(answer.uav)) else None
            if self._waiting is not None:  # identification holds the lock; do not block the telemetry of the others
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
        """Return the newest internal errors in the diagnoses of these aircraft."""
        return [self.watches[uav].failed for uav in uavs if uav in self.watches and self.watches[uav].failed]

    def _urgency(self, twin: Twin) -> float | None:
        return self.watch(twin.uav).wants(twin)

    def _isolated(self, uav: int, t: float, do: Callable[[], T]) -> T | None:
        """Run an action for one aircraft at data time `t`; return None after an internal error."""
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
    """Adapt the models of a twin to the diagnosed effects, once; a cleared mismatch removes only the label."""
    if told.outcome is Found.NONE:
        twin.extended = None
    if told.outcome is not Found.NAMED or answer.pushes is None:
        return told
    names = " and ".join(one.name for one in told.causes)
    if twin.extended is not None and twin.extended.names == names:
        return judged(told, "predictions use it", used=True)
    tried = extend(twin, answer.pushes, names)
    return judged(told, tried.said, used=tried.used)
