"""Summarise a diagnosis in one sentence."""

from dataclasses import replace

from fleet.effects import Onset
from twin_worker.diagnosis.data.fault_hypothesis import When
from twin_worker.diagnosis.inference.report import Finding, Outcome, Report
from twin_worker.diagnosis.inference.validation.cross_validate import HELD


def sentence(report: Report) -> Report:
    """Return the report with its summary sentence."""
    return replace(report, sentence=_said(report))


def _said(report: Report) -> str:
    if report.outcome is Outcome.NONE:
        return "no mismatch: the residuals are as small as on nominal flights"
    found = " and ".join(_finding(one) for one in report.findings)
    if report.outcome is Outcome.NAMED:
        return f"{found}; {_proof(report)}"
    if report.outcome is Outcome.SUSPECTED:
        return f"suspected, not confirmed on held-out data: {found}"
    channel, segments = report.where
    when = ", ".join(f"{a:.0f}-{b:.0f} s" for a, b in segments[:3]) or "throughout"
    term = " + ".join(f"{x:.3g} {name}" for name, x in report.terms.items())
    free = f"; free-form fit: {term}" if term else ""
    also = f"; closest effect, not confirmed: {found}" if found else ""
    return f"mismatch in {channel} ({when}) that no effect in the catalogue explains{also}{free}"


def _finding(one: Finding) -> str:
    numbers = ", ".join(
        f"{name} {x:.3g} ± {one.sigma.get(name, 0.0):.2g}" for name, x in one.told.items() if x == x and name != "dCm"
    )
    place = f" of the {one.surface}" if one.surface else ""
    rivals = f"; not separable from {' or '.join(one.rivals)}" if one.rivals else ""
    return f"{one.guess.effect.name}{place} {since(one.guess.when)} ({numbers}{rivals})"


def since(when: When) -> str:
    """Describe the onset profile of an effect."""
    if when.kind is Onset.ALWAYS:
        return "throughout"
    if when.kind is Onset.STEP:
        return f"after {when.t0:.0f} s"
    return f"growing from {when.t0:.0f} s over {when.T:.0f} s" if when.kind is Onset.RAMP else f"at {when.t0:.0f} s"


def _proof(report: Report) -> str:
    if not report.fit_before > 0:
        return "detected in the variance of the air data"
    drop, told = (1.0 - b / a for a, b in _evidence(report))
    if drop >= HELD:
        said = f"the residual falls from {report.fit_before:.2f} to {report.fit_after:.2f} ({drop:.0%})"
    else:
        before, after = report.force_before, report.force_after
        said = f"the error of specific force falls from {before:.2f} to {after:.2f} m/s2 ({told:.0%})"
    return f"on held-out blocks {said}{_flown(report)}"


def _evidence(report: Report) -> tuple[tuple[float, float], tuple[float, float]]:
    return (report.fit_before, report.fit_after), (report.force_before, report.force_after)


def _flown(report: Report) -> str:
    before, after = report.stray_before, report.stray_after
    return (
        f", and the attitude error of free runs of 5 s falls from {before:.1f} to {after:.1f} deg"
        if after < 0.9 * before
        else ""
    )
