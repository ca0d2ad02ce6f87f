"""Coordinate the diagnoses of a worker's aircraft, most urgent first, without delaying any prediction."""

import logging
from _thread import LockType
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import partial
from types import MappingProxyType
from typing import Protocol, TypeVar

from fleet.contract import DiagnosisOutcome, Mismatch
from twin_worker.diagnosis.data.card import UNKNOWN
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.mismatch.adapt_models import adapt_models
from twin_worker.mismatch.job import DiagnosisJob, DiagnosisResult
from twin_worker.mismatch.messages import with_adaptation
from twin_worker.mismatch.scheduler import DiagnosisState
from twin_worker.twin.state.state import Twin

_log = logging.getLogger(__name__)
T = TypeVar("T")
ALL_UAVS = -1  # in place of a UAV id
LockedTwin = tuple[Twin, AbstractContextManager]  # a twin and its lock


class Executor(Protocol):
    """Executes diagnosis jobs, one at a time."""

    @property
    def free(self) -> bool:
        """Return whether a job can be submitted now."""

    def submit(self, job: DiagnosisJob) -> None:
        """Start a job."""

    def poll(self) -> DiagnosisResult | None:
        """Return a finished result; None if there is none."""


class Coordinator:
    """Mismatch diagnosis of the aircraft that a worker owns.

    Args:
        executor: executes the diagnoses
        baselines: comparison models by UAV id, `ALL_UAVS` for all others; by default each UAV's own past
        adapt: adapt the prediction models to diagnosed effects
    """

    def __init__(
        self, executor: Executor, baselines: Mapping[int, Baseline] = MappingProxyType({}), *, adapt: bool = True
    ) -> None:
        self._executor, self._baselines, self._adapt = executor, baselines, adapt
        self.states: dict[int, DiagnosisState] = {}
        self._deferred: DiagnosisResult | None = None  # its aircraft's lock is in use

    def state(self, uav: int) -> DiagnosisState:
        """Return the diagnosis state of one aircraft."""
        if uav not in self.states:
            baseline = self._baselines.get(uav, self._baselines.get(ALL_UAVS))
            self.states[uav] = DiagnosisState(UNKNOWN if baseline is None else baseline.card, baseline)
        return self.states[uav]

    def run_once(self, owned: Sequence[LockedTwin]) -> Iterator[Mismatch]:
        """Process a finished result, and submit the most urgent job if the executor is free.

        An internal error affects only its own aircraft: it is reported and logged, and the aircraft is suspended.
        """
        twins = {twin.config.uav: (twin, lock) for twin, lock in owned}
        if (result := self._deferred or self._executor.poll()) is not None:
            self._deferred = result if _locked(twins.get(result.uav)) else None
            if self._deferred is not None:  # identification holds the lock; do not block the telemetry of the others
                return
            uav, t = result.uav, result.end
            yield from self._run_isolated(uav, t, lambda: self._handle_result(result, twins)) or ()
        if not self._executor.free:
            return
        due = []
        for twin, _ in owned:
            urgency = self._run_isolated(twin.config.uav, twin.telemetry.history.newest, partial(self._urgency, twin))
            if urgency is not None:
                due.append((urgency, twin))
        if due:
            twin = max(due, key=lambda entry: entry[0])[1]
            uav, newest = twin.config.uav, twin.telemetry.history.newest
            job = self._run_isolated(uav, newest, lambda: self.state(uav).create_job(twin))
            if job is not None:
                self._executor.submit(job)

    def defects(self, uavs: Iterable[int]) -> list[str]:
        """Return the newest internal errors in the diagnoses of these aircraft."""
        return [self.states[uav].defect for uav in uavs if uav in self.states and self.states[uav].defect]

    def _urgency(self, twin: Twin) -> float | None:
        return self.state(twin.config.uav).urgency(twin)

    def _run_isolated(self, uav: int, t: float, action: Callable[[], T]) -> T | None:
        """Run an action for one aircraft at data time `t`; return None after an internal error."""
        try:
            return action()
        except Exception as error:
            state = self.state(uav)
            state.suspend(uav, t, f"{type(error).__name__}: {error}")
            _log.exception("%s", state.defect)
            return None

    def _handle_result(self, result: DiagnosisResult, owned: dict[int, LockedTwin]) -> list[Mismatch]:
        state = self.state(result.uav)
        mismatch = state.handle_result(result)
        if result.defect:
            _log.error("%s", "\n".join(filter(None, (state.defect, result.details))))
        if mismatch is None or result.uav not in owned:
            return []
        twin, lock = owned[result.uav]
        if self._adapt:
            with lock:
                mismatch = state.published = _adapt_twin(twin, mismatch, result)
        return [mismatch]


def _locked(locked_twin: LockedTwin | None) -> bool:
    return locked_twin is not None and isinstance(locked_twin[1], LockType) and locked_twin[1].locked()


def _adapt_twin(twin: Twin, mismatch: Mismatch, result: DiagnosisResult) -> Mismatch:
    """Adapt the models of a twin to the diagnosed effects, once; a cleared mismatch removes only the label."""
    if mismatch.outcome is DiagnosisOutcome.NONE:
        twin.models.set_effect(None)
    if mismatch.outcome is not DiagnosisOutcome.NAMED or result.effect_outputs is None:
        return mismatch
    names = " and ".join(cause.name for cause in mismatch.causes)
    if twin.models.active_effect is not None and twin.models.active_effect.names == names:
        return with_adaptation(mismatch, "predictions use it", used=True)
    adaptation = adapt_models(twin, result.effect_outputs, names)
    return with_adaptation(mismatch, adaptation.message, used=adaptation.used)
