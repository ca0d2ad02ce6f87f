"""Intervals of rates and medians, and scores of stated probabilities.

Rates: Wilson score interval. Counts per flight: Garwood interval of a Poisson mean. Medians: order statistics.
Source: Wilson 1927; Garwood 1936; Brier 1950; Guo et al. 2017 (expected calibration error).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.stats import binom, binomtest, chi2

CONFIDENCE = 0.95
N_BINS = 10  # of the reliability diagram
_N_DRAWN = 2000  # samples of outcomes of calibrated probabilities


class Interval(NamedTuple):
    """Confidence interval of a score."""

    low: float
    high: float


def wilson(hits: int, n: int) -> Interval | None:
    """Return the Wilson interval of a rate; None without data."""
    if not n:
        return None
    interval = binomtest(hits, n).proportion_ci(CONFIDENCE, "wilson")
    return Interval(float(interval.low), float(interval.high))


def poisson(count: int, n: int) -> Interval | None:
    """Return the Garwood interval of a mean number per flight; None without data."""
    if not n:
        return None
    tail = 0.5 * (1.0 - CONFIDENCE)
    low = float(chi2.ppf(tail, 2 * count)) / 2.0 if count else 0.0
    return Interval(low / n, float(chi2.ppf(1.0 - tail, 2 * count + 2)) / 2.0 / n)


def median_interval(values: Sequence[float]) -> Interval | None:
    """Return the interval of a median between two order statistics; None with fewer than 6 values."""
    ordered, n = np.sort(np.asarray(values, float)), len(values)
    k = int(binom.ppf(0.5 * (1.0 - CONFIDENCE), n, 0.5)) if n else 0
    return Interval(float(ordered[k - 1]), float(ordered[n - k])) if k > 0 else None


class Statement(NamedTuple):
    """Stated probability of one candidate, and whether it is concealed in the flight."""

    probability: float
    true: bool


@dataclass(frozen=True)
class ReliabilityBin:
    """One bin of the reliability diagram: mean stated probability, share of true candidates with interval, number."""

    stated: float
    share: float
    interval: Interval
    n: int


@dataclass(frozen=True)
class ProbabilityScores:
    """Scores of stated probabilities: mean squared error, expected calibration error, reliability diagram.

    `calibrated_median` and `calibrated_limit` are the median and the 95 % quantile of the calibration error that exact
    probabilities have with as many statements: a small sample has an error of its own.
    """

    n: int
    brier: float
    calibration_error: float
    calibrated_median: float
    calibrated_limit: float
    bins: tuple[ReliabilityBin, ...]


def score_probabilities(statements: Sequence[Statement]) -> ProbabilityScores | None:
    """Score stated probabilities in ten equal bins; None without any.

    Brier = mean (p - y)^2;  calibration error = sum n_b / n |mean p - mean y|
    """
    if not statements:
        return None
    p, y = (np.array(x, float) for x in zip(*statements, strict=True))
    which = np.minimum((p * N_BINS).astype(int), N_BINS - 1)
    bins = []
    for k in np.unique(which):
        rows = which == k
        interval = wilson(int(y[rows].sum()), int(rows.sum()))
        assert interval is not None
        bins.append(ReliabilityBin(float(p[rows].mean()), float(y[rows].mean()), interval, int(rows.sum())))
    error = float(_calibration_errors(p, y[None], which)[0])
    drawn = np.random.default_rng(0).random((_N_DRAWN, len(p))) < p
    usual, limit = np.quantile(_calibration_errors(p, drawn, which), (0.5, CONFIDENCE)).tolist()
    return ProbabilityScores(len(p), float(((p - y) ** 2).mean()), error, usual, limit, tuple(bins))


def _calibration_errors(p: np.ndarray, y: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Return the calibration error of probabilities p, (n,) in bins `which`, for each row of outcomes y, (m, n)."""
    members = which == np.arange(N_BINS)[:, None]
    return np.asarray(np.abs((y - p) @ members.T).sum(axis=1) / len(p))
