"""Result of a diagnosis: one frozen report per flight, for files, figures and pages, and its sentences."""

from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from fleet.effects import Onset
from twin_worker.diagnosis.data.card import FaultHypothesis, OnsetProfile
from twin_worker.diagnosis.inference.validation.cross_validate import MIN_RMS_DROP

OUTPUT_CHANNEL = "autopilot output"  # the fault is in the output of the controller, not in the airframe


class ReportOutcome(StrEnum):
    """Outcome of a diagnosis."""

    NONE = "none"
    NAMED = "named"
    SUSPECTED = "suspected"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class DiagnosisFinding:
    """One named or suspected effect.

    Attributes:
        hypothesis: as fitted
        gain: drop of the whitened sum of squares
        reported, sigma: its values in reporting units, and their standard deviations
        parameter_sigma: standard deviations of the effect's own parameters
        rivals: names of effects that this flight does not separate from it
        manoeuvres: for each rival, the manoeuvre that separates the two
        channel, surface: location; surface may be empty
        segments: start and end times since the start of the flight [s]
        onset_interval: 95 % interval of the onset since the start of the flight [s]; None without an onset
        held_out_share: share of the gain that is present on held-out data
        probability: posterior probability that this effect or one of its rivals acts; nan where none is computed
        name_probability: the same of this effect alone
    """

    hypothesis: FaultHypothesis
    gain: float
    reported: dict[str, float]
    sigma: dict[str, float]
    parameter_sigma: tuple[float, ...]
    rivals: tuple[str, ...]
    manoeuvres: tuple[str, ...]
    channel: str
    surface: str
    segments: tuple[tuple[float, float], ...]
    held_out_share: float = 0.0
    onset_interval: tuple[float, float] | None = None
    probability: float = float("nan")
    name_probability: float = float("nan")


@dataclass(frozen=True)
class RankedCandidate:
    """One candidate of the ranking: label, onset in words, gain."""

    label: str
    onset: str
    gain: float


@dataclass(frozen=True)
class FigureSeries:
    """Time series of the figures, on the decimated grid.

    Attributes:
        t: (n,) [s]; ok: valid rows, (n,) bool; position: north, east, up, (n, 3) [m]
        before, after: residual of each channel in standard deviations of nominal flights, (n, channels)
        measured, base, model: specific force FRD, (n, 3) [m/s2]: recorded, simulated without and with the effects
        held_out: rows held out of the fit, (n,) bool
    """

    t: np.ndarray
    ok: np.ndarray
    position: np.ndarray
    before: np.ndarray
    after: np.ndarray
    measured: np.ndarray
    base: np.ndarray
    model: np.ndarray
    held_out: np.ndarray


@dataclass(frozen=True)
class Report:
    """One flight's diagnosis.

    Attributes:
        flight: name; outcome; sentence: summary in one sentence
        findings: named or suspected, best first
        ratio_before, ratio_after: channel -> mean square over its usual
        fit_before, fit_after: whitened rms on held-out blocks; nan without effects
        force_before, force_after: rms error of simulated specific force on held-out blocks [m/s2]
        free_run_error_before, free_run_error_after: rms attitude error of 5 s free runs on held-out blocks [deg]
        where: for unknown: channel and segments
        posterior: probability of the most probable sets of effects, of `none`, and of `unknown`
        terms: for unknown: sparse free-form fit without physical meaning, `term -> coefficient`
        ranking: candidates, best first
        limitations: detection power lost because of missing data, in sentences
        detection_limits: what would have been named in this flight, and the origin of these limits, in sentences
        series: for the figures
        seconds: computing time [s]
    """

    flight: str
    outcome: ReportOutcome
    sentence: str
    findings: tuple[DiagnosisFinding, ...]
    ratio_before: dict[str, float]
    ratio_after: dict[str, float]
    fit_before: float
    fit_after: float
    force_before: float
    force_after: float
    free_run_error_before: float
    free_run_error_after: float
    where: tuple[str, tuple[tuple[float, float], ...]]
    terms: dict[str, float]
    ranking: tuple[RankedCandidate, ...]
    limitations: tuple[str, ...]
    series: FigureSeries = field(compare=False)
    seconds: float = 0.0
    detection_limits: tuple[str, ...] = ()
    posterior: dict[str, float] = field(default_factory=dict)


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
        where = " on held-out data" if report.series.held_out.any() else ""
        return f"suspected, not confirmed{where}: {findings}"
    channel, segments = report.where
    times = ", ".join(f"{a:.0f}-{b:.0f} s" for a, b in segments[:3]) or "throughout"
    term = " + ".join(f"{x:.3g} {name}" for name, x in report.terms.items())
    free_form = f"; free-form fit: {term}" if term else ""
    nearest = f"; closest effect, not confirmed: {findings}" if findings else ""
    return f"mismatch in {channel} ({times}) that no effect in the catalogue explains{nearest}{free_form}"


def _describe_finding(finding: DiagnosisFinding) -> str:
    if finding.channel == OUTPUT_CHANNEL:
        return _describe_output(finding)
    numbers = ", ".join(
        f"{name} {x:.3g} ± {finding.sigma.get(name, 0.0):.2g}"
        for name, x in finding.reported.items()
        if x == x and not name.startswith("dCm")
    )
    surface = f" of the {finding.surface}" if finding.surface else ""
    rivals = f"; not separable from {' or '.join(finding.rivals)}" if finding.rivals else ""
    return f"{finding.hypothesis.effect.name}{surface} {describe_onset(finding.hypothesis.onset)} ({numbers}{rivals})"


def _describe_output(finding: DiagnosisFinding) -> str:
    number, pulse = int(finding.reported["output"]), finding.reported["pulse_us"]
    name, since = finding.hypothesis.effect.name, finding.segments[0][0]
    if finding.surface == "throttle":
        return f"{name}: throttle output {number} is cut to {pulse:.0f} us since {since:.0f} s while energy is short"
    return f"{name}: {finding.surface} output {number} is frozen at {pulse:.0f} us since {since:.0f} s"


def describe_onset(onset: OnsetProfile) -> str:
    """Describe the onset profile of an effect."""
    if onset.kind is Onset.ALWAYS:
        return "throughout"
    if onset.kind is Onset.STEP:
        return f"after {onset.t0:.0f} s"
    return f"growing from {onset.t0:.0f} s over {onset.T:.0f} s" if onset.kind is Onset.RAMP else f"at {onset.t0:.0f} s"


def _describe_validation(report: Report) -> str:
    if report.findings[0].channel == OUTPUT_CHANNEL:
        return (
            f"the autopilot's own output no longer answers its control errors: it differs by {report.fit_before:.0f} "
            "times its usual error from what they demand"
        )
    if not report.fit_before > 0:
        return "detected in the variance of the air data"
    before, after, of_what, unit = report.fit_before, report.fit_after, "residual", ""
    if not 1.0 - after / before >= MIN_RMS_DROP and np.isfinite(report.force_after):
        before, after, of_what, unit = report.force_before, report.force_after, "error of specific force", " m/s2"
    where = "on held-out blocks " if report.series.held_out.any() else ""  # otherwise all rows are fitted
    text = f"{where}the {of_what} falls from {before:.2f} to {after:.2f}{unit} ({1.0 - after / before:.0%})"
    before, after = report.free_run_error_before, report.free_run_error_after
    if after < 0.9 * before:
        text += f", and the attitude error of free runs of 5 s falls from {before:.1f} to {after:.1f} deg"
    return text
