"""Summarise a diagnosis in one sentence."""

from dataclasses import replace

from fleet.effects import Onset
from twin_worker.diagnosis.data.fault_hypothesis import OnsetProfile
from twin_worker.diagnosis.inference.report import DiagnosisFinding, Report, ReportOutcome
from twin_worker.diagnosis.inference.validation.cross_validate import MIN_RMS_DROP


def with_sentence(report: Report) -> Report:
    """Return the report with its summary sentence."""
    return replace(report, sentence=_sentence(report))


def _sentence(report: Report) -> str:
    if report.outcome is ReportOutcome.NONE:
        return "no mismatch: the residuals are as small as on nominal flights"
    findings = " and ".join(_describe_finding(finding) for finding in report.findings)
    if report.outcome is ReportOutcome.NAMED:
        return f"{findings}; {_describe_validation(report)}"
    if report.outcome is ReportOutcome.SUSPECTED:
        return f"suspected, not confirmed on held-out data: {findings}"
    channel, segments = report.where
    times = ", ".join(f"{a:.0f}-{b:.0f} s" for a, b in segments[:3]) or "throughout"
    term = " + ".join(f"{x:.3g} {name}" for name, x in report.terms.items())
    free_form = f"; free-form fit: {term}" if term else ""
    nearest = f"; closest effect, not confirmed: {findings}" if findings else ""
    return f"mismatch in {channel} ({times}) that no effect in the catalogue explains{nearest}{free_form}"


def _describe_finding(finding: DiagnosisFinding) -> str:
    numbers = ", ".join(
        f"{name} {x:.3g} ± {finding.sigma.get(name, 0.0):.2g}"
        for name, x in finding.reported.items()
        if x == x and name != "dCm"
    )
    surface = f" of the {finding.surface}" if finding.surface else ""
    rivals = f"; not separable from {' or '.join(finding.rivals)}" if finding.rivals else ""
    return f"{finding.hypothesis.effect.name}{surface} {describe_onset(finding.hypothesis.onset)} ({numbers}{rivals})"


def describe_onset(onset: OnsetProfile) -> str:
    """Describe the onset profile of an effect."""
    if onset.kind is Onset.ALWAYS:
        return "throughout"
    if onset.kind is Onset.STEP:
        return f"after {onset.t0:.0f} s"
    return f"growing from {onset.t0:.0f} s over {onset.T:.0f} s" if onset.kind is Onset.RAMP else f"at {onset.t0:.0f} s"


def _describe_validation(report: Report) -> str:
    if not report.fit_before > 0:
        return "detected in the variance of the air data"
    rms_drop, force_drop = (1.0 - b / a for a, b in _error_pairs(report))
    if rms_drop >= MIN_RMS_DROP:
        text = f"the residual falls from {report.fit_before:.2f} to {report.fit_after:.2f} ({rms_drop:.0%})"
    else:
        before, after = report.force_before, report.force_after
        text = f"the error of specific force falls from {before:.2f} to {after:.2f} m/s2 ({force_drop:.0%})"
    return f"on held-out blocks {text}{_describe_free_run(report)}"


def _error_pairs(report: Report) -> tuple[tuple[float, float], tuple[float, float]]:
    return (report.fit_before, report.fit_after), (report.force_before, report.force_after)


def _describe_free_run(report: Report) -> str:
    before, after = report.free_run_error_before, report.free_run_error_after
    return (
        f", and the attitude error of free runs of 5 s falls from {before:.1f} to {after:.1f} deg"
        if after < 0.9 * before
        else ""
    )
