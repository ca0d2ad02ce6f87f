"""Coordinate and schedule the diagnoses of a worker's aircraft, most urgent first, without delaying any prediction."""

import logging
from _thread import LockType
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import TypeVar

import numpy as np

from fleet.contract import DiagnosisOutcome, Mismatch, Outcome
from twin_worker.diagnosis.baseline.past import PastModel
from twin_worker.diagnosis.data.card import UNKNOWN, AircraftCard
from twin_worker.diagnosis.inference.report import Report, ReportOutcome
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.mismatch.adapt_models import adapt_models
from twin_worker.mismatch.job import (
    FLIGHT_S,
    DiagnosisJob,
    DiagnosisResult,
    ObservedOnsets,
    TelemetryRows,
    mark_extrapolated,
    mark_unconfirmed,
    mark_unobserved,
    mismatch_message,
    move_past,
    shift_times,
    telemetry_rows,
    with_adaptation,
    with_observed_onsets,
)
from twin_worker.mismatch.process import DiagnosisProcess
from twin_worker.twin.state.routes import ROUTE_MODES
from twin_worker.twin.state.state import Twin

BASELINE_S = 105.0  # own past used as the comparison model [s]
CHECK_PERIOD_S, DIAGNOSIS_PERIOD_S = 8.0, 25.0  # between residual checks, and between full diagnoses if idle [s]
MIN_FLIGHT_S = 45.0  # flight before the first comparison with a model [s]
_CONFIRM_FIRST = 1e3  # urgency of a confirmation: before all that is overdue [check periods]
_CONFIRM_AFTER_S = 5.0  # before a finding is checked again for confirmation [s]
_RETRY_S = 30.0  # after a refusal [s]
_SUSPEND_S, _MAX_SUSPEND_S = 60.0, 3600.0  # after an internal error, doubled each time; upper limit [s]
_SAME_ONSET_S = 20.0  # findings of one effect with onsets further apart count as different [s]
_CLEAR_COUNT = 2  # consecutive diagnoses without a finding that clear a mismatch
_CONFIRMED = (DiagnosisOutcome.NAMED, DiagnosisOutcome.UNKNOWN)
_VALID_OUTCOMES = (Outcome.VERIFIED, Outcome.PLAUSIBLE, Outcome.WORSE_THAN_LAST, Outcome.INSUFFICIENT_DATA)


@dataclass
class DiagnosisState:
    """Diagnosis state of one aircraft.

    Attributes:
        card: the aircraft, or `card.UNKNOWN`
        baseline: comparison model; None: the aircraft's own past
        past: telemetry of the own past, which also shows the controller's law; None until it is long enough
        past_model: calibration on it; None until the first job has calibrated it
        published: newest published mismatch
        reason: why there is no baseline or no diagnosis
        defect: internal error of the newest diagnosis, or empty
        failures: consecutive diagnoses that ended with an internal error
    """

    card: AircraftCard = UNKNOWN
    baseline: Baseline | None = None
    past: TelemetryRows | None = None
    past_model: PastModel | None = None
    published: Mismatch | None = None
    reason: str = ""
    defect: str = ""
    failures: int = 0
    first_t: float = float("nan")  # first telemetry [s since 1970]
    past_t: float = float("-inf")  # end of the own past [s since 1970]
    next_t: float = float("-inf")  # earliest next check [s since 1970]
    suspended_until: float = float("-inf")  # end of the suspension after an internal error [s since 1970]
    diagnosed_t: float = float("-inf")  # end of the newest flight diagnosed
    last_report: Report | None = None  # newest diagnosis; start of its flight below
    last_begin: float = 0.0
    observed: ObservedOnsets = field(default_factory=dict)  # onsets that diagnoses have observed
    clear_count: int = 0
    is_unconfirmed: bool = False  # the newest diagnosis awaits a second one

    def urgency(self, twin: Twin) -> float | None:
        """Return the urgency of a diagnosis; None if it is not due."""
        newest = twin.telemetry.history.newest
        if newest < self.next_t - _RETRY_S - DIAGNOSIS_PERIOD_S:  # the clock jumped back
            self.__init__(self.card, self.baseline)  # type: ignore[misc]
        if self.first_t != self.first_t and np.isfinite(newest):
            self.first_t = float(min(twin.telemetry.history.rows("attitude")[0], default=newest))
        if (
            newest < max(self.next_t, self.suspended_until)
            or twin.telemetry.link_lost
            or twin.environment.flight_phase.landed
            or not twin.vehicle_class.has_wings
            or twin.telemetry.origin is None
        ):
            return None
        if self.past is None and not self._is_suspicious and self._mission_flight_s(twin) >= BASELINE_S:
            self.past = telemetry_rows(twin.telemetry.history, newest - BASELINE_S)
            self.past_t = newest
        if self.past is None and self.baseline is None:
            self.next_t = newest + CHECK_PERIOD_S
            return None
        if newest < (self.first_t + MIN_FLIGHT_S if self.baseline is not None else self.past_t + CHECK_PERIOD_S):
            return None
        first = _CONFIRM_FIRST * self.is_unconfirmed + 1.0 * self._is_suspected
        return 2.0 * (not self._model_valid(twin)) + first + self.overdue(newest)

    @property
    def _is_suspected(self) -> bool:
        return self.published is not None and self.published.outcome is DiagnosisOutcome.SUSPECTED

    def overdue(self, newest: float) -> float:
        """Return how long a check is overdue at the newest telemetry [check periods]."""
        return (newest - max(self.next_t, self.first_t)) / CHECK_PERIOD_S

    def create_job(self, twin: Twin, *, idle: bool = True) -> DiagnosisJob:
        """Return the job that is due.

        Args:
            twin: the aircraft
            idle: no aircraft waits for a check, so that there is time for a diagnosis without a sign of a mismatch
        """
        newest = twin.telemetry.history.newest
        self.next_t = newest + CHECK_PERIOD_S
        is_aged = newest - self.diagnosed_t >= DIAGNOSIS_PERIOD_S
        has_time = idle or self._is_suspicious  # a finding that passed must be withdrawn
        full = (has_time and is_aged) or not self._model_valid(twin) or self.is_unconfirmed
        start = newest - FLIGHT_S
        past, past_end = None, None
        if self.past is not None:
            past, past_end = move_past(self.past, self.past_t, start)
        rows = telemetry_rows(twin.telemetry.history, start, past)
        params = dict(twin.config.airframe.servo_params or twin.received_params)
        models = self.baseline, past_end, self.past_model
        urgent = self.is_unconfirmed or self._is_suspected or (self.past_model is None and self.baseline is None)
        return DiagnosisJob(twin.config.uav, rows, params, self.card, *models, start, full, urgent)

    @property
    def _is_suspicious(self) -> bool:
        return self.published is not None and self.published.outcome is not DiagnosisOutcome.NONE

    def handle_result(self, result: DiagnosisResult) -> Mismatch | None:
        """Handle a result; return the mismatch to publish, None if nothing changed."""
        if result.defect:
            self.suspend(result.uav, result.end, result.defect)
            return None
        self.reason, self.defect, self.failures = result.refusal, "", 0
        self.past_model = result.past_model or self.past_model
        if result.refusal:
            self.next_t = result.end + _RETRY_S
            return None
        if result.report is None:
            return None
        self.diagnosed_t = result.end
        report = result.report
        if report.outcome is ReportOutcome.NONE and self._was_clear:
            self.observed.clear()
        start = result.recent_start + _SAME_ONSET_S
        report, unobserved = with_observed_onsets(report, self.observed, result.begin, start)
        shifted = shift_times(report, result.begin - self.first_t)
        mismatch = mismatch_message(result.uav, shifted, result.begin, result.end)
        if self._is_new(report, result.extrapolated):
            mismatch = mark_extrapolated(mismatch)
        elif self.baseline is None and report.outcome is ReportOutcome.NAMED and self._is_new(report, unobserved):
            mismatch = mark_unobserved(mismatch)
        self.is_unconfirmed = mismatch.outcome in _CONFIRMED and not self._is_confirmed(report, result)
        if self.is_unconfirmed:
            self.next_t = result.end + _CONFIRM_AFTER_S
            mismatch = mark_unconfirmed(mismatch)
        elif mismatch.outcome in _CONFIRMED:  # nothing more to learn soon, and the others wait
            self.next_t = result.end + DIAGNOSIS_PERIOD_S
        self.last_report, self.last_begin = report, result.begin
        confirmed_before = self.published is not None and self.published.outcome in _CONFIRMED
        self.clear_count = 0 if mismatch.outcome in _CONFIRMED else self.clear_count + 1
        if confirmed_before and 0 < self.clear_count < _CLEAR_COUNT:
            return None  # a single diagnosis without the finding does not clear it
        self.published = mismatch
        return mismatch

    @property
    def _was_clear(self) -> bool:
        return self.last_report is not None and self.last_report.outcome is ReportOutcome.NONE

    def _is_new(self, report: Report, doubtful: frozenset[str]) -> bool:
        """Return whether a report states an effect of `doubtful`, and nothing of it is confirmed already."""
        names = {finding.hypothesis.effect.name for finding in report.findings}
        names |= {"unknown"} if report.outcome is ReportOutcome.UNKNOWN else set()
        published = self.published
        if published is not None and published.outcome in _CONFIRMED and any(c.name in names for c in published.causes):
            return False
        return report.outcome in (ReportOutcome.NAMED, ReportOutcome.UNKNOWN) and bool(names & doubtful)

    def suspend(self, uav: int, t: float, reason: str) -> None:
        """Suspend the diagnosis after an internal error at data time `t`, longer each time."""
        pause_s = min(_SUSPEND_S * 2.0**self.failures, _MAX_SUSPEND_S)
        self.failures, self.suspended_until = self.failures + 1, t + pause_s
        self.defect = (
            f"uav-{uav}: diagnosis failed with an internal error ({reason}); retried in {pause_s:.0f} s, report it"
        )

    def _is_confirmed(self, report: Report, result: DiagnosisResult) -> bool:
        """Return whether the previous diagnosis agrees with this report.

        The onset of an effect older than the newest flight is only known to precede it.
        """
        if self.last_report is None:
            return False
        if report.outcome is ReportOutcome.UNKNOWN:
            return self.last_report.outcome is not ReportOutcome.NONE
        names = {
            name for finding in self.last_report.findings for name in (finding.hypothesis.effect.name, *finding.rivals)
        }
        start = result.recent_start
        onsets = [max(self.last_begin + one.segments[0][0], start) for one in self.last_report.findings]
        return any(
            one.hypothesis.effect.name in names
            and any(abs(max(result.begin + one.segments[0][0], start) - onset) < _SAME_ONSET_S for onset in onsets)
            for one in report.findings
        )

    @staticmethod
    def _model_valid(twin: Twin) -> bool:
        return twin.models.active_model is None or twin.identification.verdict.outcome in _VALID_OUTCOMES

    @staticmethod
    def _mission_flight_s(twin: Twin) -> float:
        """Return the uninterrupted flight time on the mission [s]."""
        if twin.onboard.status is None or twin.onboard.status.mode not in ROUTE_MODES:
            return 0.0
        telemetry = twin.telemetry
        earliest = telemetry.history.newest - BASELINE_S - 5.0
        start = max(twin.onboard.plan_changed_t, telemetry.link_restored_t, earliest)
        t, _ = telemetry.history.rows("attitude", start)
        return float(t[-1] - t[0]) if len(t) else 0.0


_log = logging.getLogger(__name__)
T = TypeVar("T")
ALL_UAVS = -1  # in place of a UAV id
LockedTwin = tuple[Twin, AbstractContextManager]  # a twin and its lock


class Coordinator:
    """Mismatch diagnosis of the aircraft that a worker owns.

    Args:
        executor: executes the diagnoses, one at a time
        baselines: comparison models by UAV id, `ALL_UAVS` for all others; by default each UAV's own past
        adapt: adapt the prediction models to diagnosed effects
    """

    def __init__(
        self,
        executor: DiagnosisProcess,
        baselines: Mapping[int, Baseline] = MappingProxyType({}),
        *,
        adapt: bool = True,
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
            _, lock = twins.get(result.uav, (None, None))
            self._deferred = result if isinstance(lock, LockType) and lock.locked() else None
            if self._deferred is not None:  # identification holds the lock; do not block the telemetry of the others
                return
            uav, t = result.uav, result.end
            yield from self._run_isolated(uav, t, lambda: self._handle_result(result, twins)) or ()
        if not self._executor.free:
            return
        due = []
        for twin, _ in owned:
            uav, newest = twin.config.uav, twin.telemetry.history.newest
            urgency = self._run_isolated(uav, newest, partial(self.state(uav).urgency, twin))
            if urgency is not None:
                due.append((urgency, twin))
        if due:
            twin = max(due, key=lambda entry: entry[0])[1]
            idle = all(self.state(one.config.uav).overdue(one.telemetry.history.newest) < 1.0 for _, one in due)
            uav, newest = twin.config.uav, twin.telemetry.history.newest
            job = self._run_isolated(uav, newest, partial(self.state(uav).create_job, twin, idle=idle))
            if job is not None:
                self._executor.submit(job)

    def defects(self, uavs: Iterable[int]) -> list[str]:
        """Return the newest internal errors in the diagnoses of these aircraft."""
        return [self.states[uav].defect for uav in uavs if uav in self.states and self.states[uav].defect]

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
