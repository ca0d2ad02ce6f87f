"""Diagnose the aircraft of one worker in turn, the most urgent first, without ever making a prediction wait."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from types import MappingProxyType
from typing import Protocol

from fleet.contract import Found, Mismatch
from twin_worker.diagnose.baseline import Baseline
from twin_worker.diagnose.card import UNKNOWN
from twin_worker.memory import Twin
from twin_worker.mismatch.extend import extend
from twin_worker.mismatch.job import Answer, Job
from twin_worker.mismatch.told import judged
from twin_worker.mismatch.watch import Watch

ALL = -1  # instead of a UAV id
Held = tuple[Twin, AbstractContextManager]  # a twin, and the lock it changes under


class Hand(Protocol):
    """Whoever works out jobs, one at a time."""

    @property
    def free(self) -> bool:
        """Tell whether a job may be given now."""

    def give(self, job: Job) -> None:
        """Begin a job."""

    def answer(self) -> Answer | None:
        """Give an answer that has arrived; None while there is none."""


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

    def watch(self, uav: int) -> Watch:
        """Give what is known of one aircraft."""
        if uav not in self.watches:
            base = self._bases.get(uav, self._bases.get(ALL))
            self.watches[uav] = Watch(UNKNOWN if base is None else base.card, base)
        return self.watches[uav]

    def turn(self, held: Sequence[Held]) -> Iterator[Mismatch]:
        """Take an answer that has arrived, and begin the most urgent job where one may begin."""
        if (answer := self._hand.answer()) is not None:
            yield from self._take(answer, {twin.uav: (twin, lock) for twin, lock in held})
        if not self._hand.free:
            return
        due = [(urgent, twin) for twin, _ in held if (urgent := self.watch(twin.uav).wants(twin)) is not None]
        if due:
            twin = max(due, key=lambda one: one[0])[1]
            self._hand.give(self.watch(twin.uav).job(twin))

    def _take(self, answer: Answer, held: dict[int, Held]) -> Iterator[Mismatch]:
        watch = self.watch(answer.uav)
        told = watch.take(answer)
        if told is None or answer.uav not in held:
            return
        twin, lock = held[answer.uav]
        if self._adapt:
            with lock:
                told = watch.told = _adapted(twin, told, answer)
        yield told


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
