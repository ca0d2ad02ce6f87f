"""What a diagnosis says: one frozen report a flight, for files, figures and people."""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from twin_worker.diagnosis.data.fault_hypothesis import Guess


class Outcome(StrEnum):
    """What became of it."""

    NONE = "none"
    NAMED = "named"
    SUSPECTED = "suspected"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class Finding:
    """One effect.

    Attributes:
        guess: as fitted
        gain: drop of the whitened sum of squares
        told, sigma: its numbers in the units people want, and their standard deviations
        doubt: standard deviations of the effect's own parameters
        rivals: names of effects it cannot be told from
        apart: for each of them, what to fly so that they can
        channel, surface: where it lives; surface may be empty
        segments: when, seconds since the flight's zero
        held: share of the gain that shows on data held out
    """

    guess: Guess
    gain: float
    told: dict[str, float]
    sigma: dict[str, float]
    doubt: tuple[float, ...]
    rivals: tuple[str, ...]
    apart: tuple[str, ...]
    channel: str
    surface: str
    segments: tuple[tuple[float, float], ...]
    held: float = 0.0


@dataclass(frozen=True)
class Tried:
    """One candidate of the ranking."""

    label: str
    since: str
    gain: float


@dataclass(frozen=True)
class Series:
    """What the figures show, on the thinned grid.

    Attributes:
        t: (n,) [s]; ok: trusted, (n,); place: north, east, up, (n, 3) [m]
        before, after: residual of each channel in standard deviations of nominal flights, (n, channels)
        measured, base, model: specific force FRD, (n, 3) [m/s2]: recorded, simulated without and with the effects
        held: rows held out of the fit, (n,) bool
    """

    t: np.ndarray
    ok: np.ndarray
    place: np.ndarray
    before: np.ndarray
    after: np.ndarray
    measured: np.ndarray
    base: np.ndarray
    model: np.ndarray
    held: np.ndarray


@dataclass(frozen=True)
class Report:
    """One flight's diagnosis.

    Attributes:
        flight: its name; outcome; sentence: all of it in one sentence
        findings: named or suspected, best first
        ratio_before, ratio_after: each channel's mean square over its usual, by channel
        fit_before, fit_after: whitened rms on held-out blocks; nan where nothing was found
        force_before, force_after: rms error of simulated specific force on held-out blocks [m/s2]
        stray_before, stray_after: rms attitude error of free flights of 5 s on held-out blocks [deg]
        where: for unknown: channel and segments
        odd: by kind of evidence, channel and term, what a change that nobody named would gain, over what chance reaches
        terms: for unknown: a sparse free-form term, no physics: `term -> coefficient`
        tried: the ranking of candidates
        lacks: what power was lost for want of data
        series: for the figures
        seconds: what it took
    """

    flight: str
    outcome: Outcome
    sentence: str
    findings: tuple[Finding, ...]
    ratio_before: dict[str, float]
    ratio_after: dict[str, float]
    fit_before: float
    fit_after: float
    force_before: float
    force_after: float
    stray_before: float
    stray_after: float
    where: tuple[str, tuple[tuple[float, float], ...]]
    odd: dict[str, float]
    terms: dict[str, float]
    tried: tuple[Tried, ...]
    lacks: tuple[str, ...]
    series: Series = field(compare=False)
    seconds: float = 0.0
