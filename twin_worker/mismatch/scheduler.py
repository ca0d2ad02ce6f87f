"""Diagnosis state of one aircraft: its baseline, the newest mismatch, and next due time. Data time only."""

from dataclasses import dataclass

import numpy as np

from fleet.contract import Found, Mismatch, Outcome
from twin_worker.diagnosis.data.card import UNKNOWN, Card
from twin_worker.diagnosis.inference.report import Outcome as Result
from twin_worker.diagnosis.inference.report import Report
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.mismatch.job import Answer, Job, Rows, rows_of
from twin_worker.mismatch.messages import message, since, unconfirmed
from twin_worker.twin.state.state import ROUTE_MODES, Twin
from twin_worker.twin.state.vehicle_class import WINGS

PAST_S = 105.0  # own past used as the comparison model [s]
SEEN_S = 120.0  # flight used for a diagnosis [s]
LOOK_S, WHOLE_S = 8.0, 25.0  # between residual checks, and between full diagnoses [s]
LEAST_S = 45.0  # flight before the first comparison with a model [s]
_AGAIN_S = 5.0  # before a finding is checked again for confirmation [s]
_RETRY_S = 30.0  # after a refusal [s]
_OFF_S, _OFF_MOST_S = 60.0, 3600.0  # after an internal error, doubled each time; upper limit [s]
_SAME_S = 20.0  # findings of one effect with onsets further apart count as different [s]
_GONE = 2  # consecutive diagnoses without a finding that clear a mismatch
_SOUND = (Outcome.VERIFIED, Outcome.WORSE_THAN_LAST, Outcome.STARVED)


@dataclass
class Watch:
    """Diagnosis state of one aircraft.

    Attributes:
        card: the aircraft, or `card.UNKNOWN`
        baseline: comparison model; None: the aircraft's own past
        past: telemetry of that past; None until it is long enough
        published: newest published mismatch
        reason: why there is no baseline or no diagnosis
        defect: internal error of the newest diagnosis, or empty
        failures: consecutive diagnoses that ended with an internal error
    """

    card: Card = UNKNOWN
    base: Baseline | None = None
    past: Rows | None = None
    told: Mismatch | None = None
    why: str = ""
    failed: str = ""
    failures: int = 0
    begun: float = float("nan")  # first telemetry [s since 1970]
    past_t: float = float("-inf")  # end of the own past [s since 1970]
    next_t: float = float("-inf")  # earliest next check [s since 1970]
    off_until: float = float("-inf")  # end of the suspension after an internal error [s since 1970]
    whole_t: float = float("-inf")  # end of the newest flight diagnosed
    last: Report | None = None  # newest diagnosis; start of its flight below
    last_begin: float = 0.0
    none: int = 0

    def wants(self, twin: Twin) -> float | None:
        """Return the urgency of a diagnosis; None if it is not due."""
        newest = twin.history.newest
        if newest < self.next_t - _RETRY_S - WHOLE_S:  # the clock jumped back
            self.__init__(self.card, self.base)  # type: ignore[misc]
        if self.begun != self.begun and np.isfinite(newest):
            self.begun = float(min(twin.history.rows("attitude")[0], default=newest))
        if (
            newest < max(self.next_t, self.off_until)
            or twin.lost
            or twin.ground.landed
            or twin.vehicle not in WINGS
            or twin.origin is None
        ):
            return None
        if self.base is None and self.past is None:
            if self._steady_s(twin) < PAST_S:
                self.next_t = newest + LOOK_S
                return None
            self.past = rows_of(twin.history, newest - PAST_S)
            self.past_t = newest
        if newest < (self.begun + LEAST_S if self.base is not None else self.past_t + LOOK_S):
            return None
        return 2.0 * (not self._sound(twin)) + 4.0 * self._to_confirm + (newest - self.whole_t) / WHOLE_S

    def job(self, twin: Twin) -> Job:
        """Return the job that is due."""
        newest = twin.history.newest
        self.next_t = newest + LOOK_S
        whole = newest - self.whole_t >= WHOLE_S or not self._sound(twin) or self._to_confirm
        rows = rows_of(twin.history, newest - SEEN_S, self.past)
        return Job(twin.uav, rows, dict(twin.received), self.card, self.base, self.past_t, whole)

    @property
    def _to_confirm(self) -> bool:
        return self.told is not None and self.told.outcome in (Found.SUSPECTED, Found.UNKNOWN)

    def take(self, answer: Answer) -> Mismatch | None:
        """Handle a result; return the mismatch to publish, None if nothing changed."""
        if answer.failed:
            self.give_up(answer.uav, answer.end, answer.failed)
            return None
        self.why, self.failed, self.failures = answer.refused, "", 0
        if answer.refused:
            self.next_t = answer.end + _RETRY_S
            return None
        if answer.report is None:
            return None
        self.whole_t = answer.end
        report = answer.report
        told = message(answer.uav, since(report, answer.begin - self.begun), answer.begin, answer.end)
        if told.outcome in (Found.NAMED, Found.UNKNOWN) and not self._confirmed(report, answer.begin):
            self.next_t = answer.end + _AGAIN_S
            told = unconfirmed(told)
        self.last, self.last_begin = report, answer.begin
        held = self.told is not None and self.told.outcome in (Found.NAMED, Found.UNKNOWN)
        self.none = self.none + 1 if told.outcome in (Found.NONE, Found.SUSPECTED) else 0
        if held and 0 < self.none < _GONE:
            return None  # a single diagnosis without the finding does not clear it
        self.told = told
        return told

    def give_up(self, uav: int, t: float, why: str) -> None:
        """Suspend the diagnosis after an internal error at data time `t`, longer each time."""
        again_s = min(_OFF_S * 2.0**self.failures, _OFF_MOST_S)
        self.failures, self.off_until = self.failures + 1, t + again_s
        self.failed = (
            f"uav-{uav}: diagnosis failed with an internal error ({why}); retried in {again_s:.0f} s, report it"
        )

    def _confirmed(self, report: Report, begin: float) -> bool:
        """Return whether the previous diagnosis agrees with this report."""
        if self.last is None:
            return False
        if report.outcome is Result.UNKNOWN:
            return self.last.outcome is not Result.NONE
        names = {name for one in self.last.findings for name in (one.guess.effect.name, *one.rivals)}
        onsets = [self.last_begin + one.segments[0][0] for one in self.last.findings]
        return any(
            one.guess.effect.name in names
            and any(abs(begin + one.segments[0][0] - onset) < _SAME_S for onset in onsets)
            for one in report.findings
        )

    @staticmethod
    def _sound(twin: Twin) -> bool:
        return twin.plant is None or twin.verdict.outcome in _SOUND

    @staticmethod
    def _steady_s(twin: Twin) -> float:
        """Return the uninterrupted flight time on the mission [s]."""
        if twin.status is None or twin.status.mode not in ROUTE_MODES:
            return 0.0
        t = twin.history.rows("attitude", max(twin.since, twin.back_t, twin.history.newest - PAST_S - 5.0))[0]
        return float(t[-1] - t[0]) if len(t) else 0.0
