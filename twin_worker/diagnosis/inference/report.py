"""Result of a diagnosis: one frozen report per flight, for files, figures and pages."""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from twin_worker.diagnosis.data.fault_hypothesis import FaultHypothesis


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
        held_out_share: share of the gain that is present on held-out data
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
        anomaly_ratio: anomaly kind -> gain over its chance limit
        terms: for unknown: sparse free-form fit without physical meaning, `term -> coefficient`
        ranking: candidates, best first
        limitations: detection power lost because of missing data, in sentences
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
    anomaly_ratio: dict[str, float]
    terms: dict[str, float]
    ranking: tuple[RankedCandidate, ...]
    limitations: tuple[str, ...]
    series: FigureSeries = field(compare=False)
    seconds: float = 0.0
