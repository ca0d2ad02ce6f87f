"""Build the published mismatch message: times on the fleet clock, finite numbers."""

from dataclasses import replace
from math import inf, isfinite

import msgspec

from fleet.contract import Cause, DiagnosisOutcome, Mismatch
from twin_worker.diagnosis.inference.report import DiagnosisFinding, Report, ReportOutcome, with_sentence

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


def shift_times(report: Report, shift: float) -> Report:
    """Return the report with the times in its sentence shifted by `shift` [s]."""
    shifted = [
        replace(finding, hypothesis=replace(finding.hypothesis, onset=finding.hypothesis.onset.shifted(shift)))
        for finding in report.findings
    ]
    channel, segments = report.where
    shifted_where = channel, tuple((a + shift, b + shift) for a, b in segments)
    text = with_sentence(replace(report, findings=tuple(shifted), where=shifted_where)).sentence
    return replace(report, sentence=text)


def mark_unconfirmed(mismatch: Mismatch) -> Mismatch:
    """Mark a mismatch as suspected until a second diagnosis confirms it."""
    return msgspec.structs.replace(
        mismatch, outcome=DiagnosisOutcome.SUSPECTED, sentence=f"detected once, not confirmed: {mismatch.sentence}"
    )


def summary(mismatch: Mismatch | None) -> str:
    """Return a short summary for the fleet table; empty if there is no mismatch."""
    if mismatch is None or mismatch.outcome is DiagnosisOutcome.NONE:
        return ""
    names = " and ".join(_cause_name(cause) for cause in mismatch.causes if cause.name != "unknown")
    if mismatch.outcome is DiagnosisOutcome.UNKNOWN:
        return f"unknown, in {mismatch.causes[0].channel}" if mismatch.causes else "unknown"
    return f"{mismatch.outcome.value} {names}".rstrip()


def with_adaptation(mismatch: Mismatch, text: str, *, used: bool) -> Mismatch:
    """Add to a mismatch whether predictions use the adapted model."""
    return msgspec.structs.replace(mismatch, adapted=used, sentence=f"{mismatch.sentence}; {text}")


def _cause_name(cause: Cause) -> str:
    return f"{cause.name} of the {cause.surface}" if cause.surface else cause.name


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
