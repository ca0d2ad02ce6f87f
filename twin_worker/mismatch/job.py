"""Input and result of one diagnosis job, the job itself (a pure function that runs in any process) and its messages."""

import time
from dataclasses import dataclass, replace
from math import inf, isfinite

import msgspec
import numpy as np

from fleet.contract import COLUMNS, Cause, DiagnosisOutcome, Mismatch
from twin_worker.diagnosis.baseline.own_past import find_output_faults, only_new_findings
from twin_worker.diagnosis.baseline.past import (
    CONTEXT_S,
    ROWS_PER_SAMPLE,
    PastModel,
    calibrate_past,
    commanded_airspeed,
    part_after,
    part_before,
)
from twin_worker.diagnosis.data.card import AircraftCard
from twin_worker.diagnosis.data.flight import FlightData, resample_flight
from twin_worker.diagnosis.inference.diagnose import diagnose
from twin_worker.diagnosis.inference.isolation.whitened_residuals import WhitenedResiduals
from twin_worker.diagnosis.inference.output_faults import with_frozen_outputs
from twin_worker.diagnosis.inference.report import DiagnosisFinding, Report, ReportOutcome, with_sentence
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.diagnosis.model.residual import ModelledFlight
from twin_worker.diagnosis.model.weather import own_weather
from twin_worker.mismatch.effect_increments import EffectOutputs, effect_outputs
from twin_worker.telemetry.history import TelemetryHistory

RECENT_S = 40.0  # newest flight whose residuals are monitored [s]
_JOIN_GAP_S = 10.0  # between the past and the recent flight; longer than a filter, so that it is left out [s]
# limits of the check, above which a diagnosis follows; 20 and 10 % of the checks of eleven healthy flights exceed them
MIN_RATIO, MIN_MEAN = 2.0, 3.5  # mean square over the usual one, and mean in its standard deviations [-]
_NEAR_S = 30.0  # flight before and after an onset, whose commanded airspeeds are compared [s]
FLIGHT_S = 120.0  # newest flight that is diagnosed [s]
_FAULT_INTERVAL_S = 36_000.0  # prior mean flight time of an aircraft between two faults [s]
_MIN_ROWS = 50  # of the recent flight, one row every 0.2 s

TelemetryRows = dict[str, tuple[np.ndarray, np.ndarray]]
ObservedOnsets = dict[tuple[str, str], float]  # by effect and its target [s since 1970]


@dataclass(frozen=True)
class DiagnosisJob:
    """Recent flight of one aircraft.

    Attributes:
        uav: UAV id
        rows: received telemetry, by kind
        params: autopilot parameters
        card: the aircraft
        baseline: comparison model; None: the aircraft's own past
        past_end: end of the past in `rows` [s since 1970]; None: `rows` have none
        past_model: calibration on that past, from an earlier result; None: calibrate
        recent_start: start of the newest flight in `rows`, which is diagnosed [s since 1970]
        full: diagnose without a residual check
        is_urgent: a finding or the first calibration awaits it
    """

    uav: int
    rows: TelemetryRows
    params: dict[str, float]
    card: AircraftCard
    baseline: Baseline | None
    past_end: float | None = None
    past_model: PastModel | None = None
    recent_start: float = -inf
    full: bool = False
    is_urgent: bool = False


@dataclass(frozen=True)
class DiagnosisResult:
    """Result of one diagnosis job.

    Attributes:
        uav: UAV id
        begin, end: flight of the diagnosis [s since 1970]
        recent_start: start of its newest part without a gap [s since 1970]
        past_model: calibration on the own past, for the next job
        check: mean square and mean of the recent residuals over their limits, the larger; nan if undetermined
        report: the diagnosis; None if the residuals did not require one
        extrapolated: its effects that may come from another commanded airspeed
        effect_outputs: what the diagnosed effects add to the aircraft's dynamics, row by row
        refusal: reason for no diagnosis, or empty
        defect: internal error that ended the job without a result, or empty
        details: its traceback, for the log
        cpu_s: CPU time used [s]
    """

    uav: int
    begin: float
    end: float
    recent_start: float = -inf
    past_model: PastModel | None = None
    check: float = float("nan")
    report: Report | None = None
    extrapolated: frozenset[str] = frozenset()
    effect_outputs: EffectOutputs | None = None
    refusal: str = ""
    defect: str = ""
    details: str = ""
    cpu_s: float = 0.0


def telemetry_rows(history: TelemetryHistory, start: float, past: TelemetryRows | None = None) -> TelemetryRows:
    """Copy the telemetry for a diagnosis from `start` on [s since 1970], appended to the stored past."""
    out = {}
    for kind in COLUMNS:
        t, x = history.rows(kind, start)
        if past is not None and len(past[kind][0]):
            past_t, past_x = past[kind]
            new = t > past_t[-1]
            t, x = np.concatenate([past_t, t[new]]), np.concatenate([past_x, x[new]])
        out[kind] = t, x
    return out


def move_past(past: TelemetryRows, end: float, start: float) -> tuple[TelemetryRows, float]:
    """Return the past, and its end [s since 1970], moved to shortly before the recent flight that begins at `start`.

    The time between them has no rows. Resampled, it would cost more with every minute of flight.
    """
    delay = max(start - _JOIN_GAP_S - end, 0.0)
    return {kind: (t + delay, x) for kind, (t, x) in past.items()}, end + delay


def failed_result(job: DiagnosisJob, reason: str, *, cpu_s: float = 0.0, details: str = "") -> DiagnosisResult:
    """Return the result of a job that ended with an internal error."""
    return replace(_empty_result(job), defect=reason, cpu_s=cpu_s, details=details)


def _empty_result(job: DiagnosisJob) -> DiagnosisResult:
    t = job.rows["attitude"][0]
    begin, end = (float(t[0]), float(t[-1])) if len(t) else (0.0, 0.0)
    return DiagnosisResult(job.uav, begin, end, job.recent_start)


def run_job(job: DiagnosisJob) -> DiagnosisResult:
    """Check the recent residuals and diagnose if they are larger than usual; a `ValueError` becomes a refusal."""
    started = time.process_time()
    result = _empty_result(job)
    try:
        result = _run(job, result)
    except (ValueError, np.linalg.LinAlgError) as error:
        result = replace(result, refusal=str(error))
    return replace(result, cpu_s=time.process_time() - started)


def _run(job: DiagnosisJob, result: DiagnosisResult) -> DiagnosisResult:
    history = TelemetryHistory(keep_s=np.inf)
    for kind, (t, x) in job.rows.items():
        history.replace_rows(kind, t, x)
    flight = resample_flight(f"uav-{job.uav}", history, job.params, job.card)
    past_end = None if job.past_end is None else job.past_end - flight.t_start
    output_faults = find_output_faults(flight, past_end)
    baseline = job.baseline
    if baseline is not None:
        flight = part_after(flight, job.recent_start - flight.t_start)
    elif past_end is not None:
        past_model = job.past_model or calibrate_past(part_before(flight, past_end), job.card)
        flight = part_after(flight, past_end - CONTEXT_S)
        baseline = past_model.baseline(flight)
        result = replace(result, past_model=past_model)
    else:
        raise ValueError(f"{flight.name}: found neither a model nor a past, expected one of them; fly longer")
    result = replace(result, begin=flight.t_start, check=check_residuals(flight, baseline))
    if not (job.full or output_faults or result.check > 1.0):
        return result
    report = diagnose(flight, baseline, fault_odds=FLIGHT_S / _FAULT_INTERVAL_S)
    if job.baseline is None and past_end is not None:
        # the newest seconds can be a climb: no permanent loss yet; where the past is joined, filters begin anew
        report = only_new_findings(report, None, past_end, past_end + 0.5 * _JOIN_GAP_S)
        if result.past_model is not None:
            result = replace(result, extrapolated=extrapolated_effects(report, flight, result.past_model))
    outputs = effect_outputs(flight, baseline, report)  # of the airframe: the recorded outputs contain their faults
    return replace(result, report=with_frozen_outputs(report, output_faults), effect_outputs=outputs)


def check_residuals(flight: FlightData, baseline: Baseline) -> float:
    """Return how far the recent residuals exceed the usual ones, of the channel with the largest excess [limits].

    A lasting change of force or airspeed shows in their mean before it shows in their mean square.
    """
    modelled = ModelledFlight(flight, baseline)
    whitened = WhitenedResiduals(modelled, own_weather(modelled))
    recent = whitened.part(modelled.t > modelled.t[-1] - RECENT_S)
    n = int(recent.ok.sum())
    if n < _MIN_ROWS:
        return float("nan")
    e = (recent.e + recent.Jn @ whitened.xn)[recent.ok]
    ratio = (e**2).mean(axis=0) / baseline.usual
    mean = np.abs(e.mean(axis=0)) * np.sqrt(n / ROWS_PER_SAMPLE)
    return float(max((ratio / MIN_RATIO).max(), (mean / MIN_MEAN).max()))


def extrapolated_effects(report: Report, flight: FlightData, past: PastModel) -> frozenset[str]:
    """Return the names of the effects that begin where the commanded airspeed leaves that of the past.

    The past does not tell how the aircraft flies at another airspeed: what changes with it is no fault yet. That is
    the commanded airspeed, as a fault changes the flown one. `unknown` stands for an unexplained mismatch at
    airspeeds that the past does not contain.
    """
    speed, airspeeds = commanded_airspeed(flight), past.airspeeds
    if speed is None or airspeeds is None:
        return frozenset()

    def median(rows: np.ndarray) -> float:
        return float(np.median(speed[rows & flight.ok])) if (rows & flight.ok).any() else float("nan")

    names = set()
    for finding in report.findings:
        since = flight.t - finding.segments[0][0]
        sides = median((since < 0.0) & (since > -_NEAR_S)), median((since >= 0.0) & (since < _NEAR_S))
        if abs(sides[0] - sides[1]) > airspeeds.scatter and not all(map(airspeeds.contain, sides)):
            names.add(finding.hypothesis.effect.name)
    _, segments = report.where
    there = np.any([(flight.t >= a) & (flight.t <= b) for a, b in segments], axis=0) if segments else None
    if there is not None and not airspeeds.contain(median(there)):
        names.add("unknown")
    return frozenset(names)


_MAX_FORCE_ERROR = 100.0  # larger errors come from a diverged simulation and are not published [m/s2]


def mismatch_message(uav: int, report: Report, begin: float, end: float) -> Mismatch:
    """Return the message of a report.

    Args:
        uav: UAV id
        report: its times count from `begin`
        begin, end: flight of the diagnosis [s since 1970]
    """
    causes = tuple(_cause(finding, begin) for finding in report.findings)
    if report.outcome is ReportOutcome.UNKNOWN:
        channel, segments = report.where
        causes = (Cause(name="unknown", channel=channel, segments=_absolute_times(begin, segments)), *causes)
    proven = report.outcome is not ReportOutcome.NONE
    return Mismatch(
        uav=uav,
        t=end,
        outcome=DiagnosisOutcome(report.outcome.value),
        causes=causes if proven else (),
        fit_before=_finite_or_none(report.fit_before),
        fit_after=_finite_or_none(report.fit_after),
        force_before=_finite_or_none(report.force_before, _MAX_FORCE_ERROR),
        force_after=_finite_or_none(report.force_after, _MAX_FORCE_ERROR),
        attitude_error_before=_finite_or_none(report.free_run_error_before),
        attitude_error_after=_finite_or_none(report.free_run_error_after),
        flight_t0=begin,
        sentence=report.sentence,
    )


def with_observed_onsets(
    report: Report, observed: ObservedOnsets, begin: float, start: float
) -> tuple[Report, frozenset[str]]:
    """Return the report with the onsets that diagnoses observed, and the effects whose onset none has observed.

    An effect older than the newest flight is a difference to the past; its onset is estimated between the two.

    Args:
        report: its times count from `begin`
        observed: onsets so far, extended in place; effects that are not separable share one
        begin: start of its flight [s since 1970]
        start: from here on an onset counts as observed [s since 1970]
    """
    findings, unobserved = [], set()
    for finding in report.findings:
        (onset, end), *rest = finding.segments
        hypothesis = finding.hypothesis
        keys = [(name, hypothesis.target) for name in (hypothesis.effect.name, *finding.rivals)]
        known = [observed[key] for key in keys if key in observed]
        is_recent = begin + onset >= start
        first = onset if is_recent or not known else min(known) - begin
        if is_recent or known:
            observed.update(dict.fromkeys(keys, begin + first))
        else:
            unobserved.add(hypothesis.effect.name)
        moved = replace(hypothesis, onset=hypothesis.onset.shifted(first - onset))
        findings.append(replace(finding, hypothesis=moved, segments=((first, end), *rest)))
    return with_sentence(replace(report, findings=tuple(findings))), frozenset(unobserved)


def shift_times(report: Report, shift: float) -> Report:
    """Return the report with the times in its sentence shifted by `shift` [s]."""
    findings = []
    for finding in report.findings:
        onset = finding.hypothesis.onset.shifted(shift)
        findings.append(replace(finding, hypothesis=replace(finding.hypothesis, onset=onset)))
    channel, segments = report.where
    where = channel, tuple((a + shift, b + shift) for a, b in segments)
    shifted = with_sentence(replace(report, findings=tuple(findings), where=where))
    return replace(report, sentence=shifted.sentence)


def mark_extrapolated(mismatch: Mismatch) -> Mismatch:
    """Return the mismatch as suspected: it begins at an airspeed that the own past does not contain."""
    return _suspected(mismatch, "at an airspeed that its own past does not contain, not confirmed")


def mark_unobserved(mismatch: Mismatch) -> Mismatch:
    """Return the mismatch as suspected: no diagnosis has seen it begin, so that slow changes may explain it."""
    return _suspected(mismatch, "differs from its own past without an observed onset, not confirmed")


def mark_unconfirmed(mismatch: Mismatch) -> Mismatch:
    """Mark a mismatch as suspected until a second diagnosis confirms it."""
    return _suspected(mismatch, "detected once, not confirmed")


def _suspected(mismatch: Mismatch, reason: str) -> Mismatch:
    return msgspec.structs.replace(
        mismatch, outcome=DiagnosisOutcome.SUSPECTED, sentence=f"{reason}: {mismatch.sentence}"
    )


def summary(mismatch: Mismatch | None) -> str:
    """Return a short summary for the fleet table; empty if there is no mismatch."""
    if mismatch is None or mismatch.outcome is DiagnosisOutcome.NONE:
        return ""
    names = " and ".join(
        f"{cause.name} of the {cause.surface}" if cause.surface else cause.name
        for cause in mismatch.causes
        if cause.name != "unknown"
    )
    if mismatch.outcome is DiagnosisOutcome.UNKNOWN:
        return f"unknown, in {mismatch.causes[0].channel}" if mismatch.causes else "unknown"
    return f"{mismatch.outcome.value} {names}".rstrip()


def with_adaptation(mismatch: Mismatch, text: str, *, used: bool) -> Mismatch:
    """Add to a mismatch whether predictions use the adapted model."""
    return msgspec.structs.replace(mismatch, adapted=used, sentence=f"{mismatch.sentence}; {text}")


def _cause(finding: DiagnosisFinding, begin: float) -> Cause:
    parameters = {name: float(x) for name, x in finding.reported.items() if isfinite(x)}
    return Cause(
        name=finding.hypothesis.effect.name,
        channel=finding.channel,
        surface=finding.surface,
        confusable_with=finding.rivals,
        segments=_absolute_times(begin, finding.segments),
        parameters=parameters,
        sigma={name: float(x) for name, x in finding.sigma.items() if name in parameters and isfinite(x)},
    )


def _absolute_times(begin: float, segments: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    return tuple((float(begin + a), float(begin + b)) for a, b in segments)


def _finite_or_none(x: float, limit: float = inf) -> float | None:
    return float(x) if isfinite(x) and x < limit else None
