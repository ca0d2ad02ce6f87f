"""Scores of one method over many starts: relative error, first passages, axes, coverage, horizon.

M1 is |p_hat - p| / max(path flown, 2 s of ground speed), M2 is |p_hat - p| / max(displacement, 2 s of ground speed).
First passages are censored at the end of the known flight; their quantiles are Kaplan-Meier estimates.
Source: Kaplan & Meier 1958, "Nonparametric estimation from incomplete observations".
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from twin_worker.evaluation.scoring.case import Case
from twin_worker.numerics.prediction_errors import LIMIT, along_cross_down, first_passage, least_length, track_frame

LIMITS = (0.10, 0.05, 0.03)  # relative errors whose first passage is reported [-]


@dataclass(frozen=True)
class Scores:
    """Scores of one method, one row per start.

    Attributes:
        ahead: look-ahead, (k,) [s]
        flight: flight of each start, (s,)
        source: the method itself or its fallback, (s,)
        error: along, cross, vertical in the frame of the predicted path, signed, nan unknown, (s, k, 3) [m]
        distance: nan unknown, (s, k) [m]
        passages: by limit, first passage of M1 and whether it is censored, (s, 2) [s, 0 or 1]
        m2_passages: first passage of M2 at 10 % and whether it is censored, (s, 2) [s, 0 or 1]
        tube: half-axes, nan where the method has none, (s, k, 3) [m]
        horizon: nan where the method has none, (s,) [s]
    """

    ahead: np.ndarray
    flight: np.ndarray
    made_by: np.ndarray
    error: np.ndarray
    distance: np.ndarray
    passages: dict[float, np.ndarray]
    strict: np.ndarray
    tube: np.ndarray
    horizon: np.ndarray

    def at(self, seconds: float) -> int | None:
        """Return the column of a look-ahead; None if the grid has none there."""
        found = np.flatnonzero(np.abs(self.ahead - seconds) < 0.5)
        return int(found[0]) if len(found) else None

    @property
    def inside(self) -> np.ndarray:
        """Return whether the flight was inside the tube on all axes, nan unknown, (s, k)."""
        known = np.isfinite(self.error).all(axis=2) & np.isfinite(self.tube).all(axis=2)
        return np.where(known, (np.abs(self.error) <= self.tube).all(axis=2), np.nan)

    def part(self, rows: np.ndarray) -> "Scores":
        """Return the scores of these rows."""
        passages = {limit: found[rows] for limit, found in self.passages.items()}
        return Scores(
            self.ahead,
            self.flight[rows],
            self.made_by[rows],
            self.error[rows],
            self.distance[rows],
            passages,
            self.strict[rows],
            self.tube[rows],
            self.horizon[rows],
        )


def score(cases: Sequence[Case], method: str) -> Scores:
    """Score one method over starts with the same look-aheads."""
    told = [case.asked.told[method] for case in cases]
    flown, path = np.array([case.flown for case in cases]), np.array([one.path for one in told])
    distance = np.linalg.norm(flown - path, axis=2)
    ahead = cases[0].asked.ahead
    relative = distance / np.array([case.length for case in cases])
    strict = distance / np.array([_displacement(case) for case in cases])
    unknown = np.full((len(ahead), 3), np.nan)
    return Scores(
        ahead=ahead,
        flight=np.array([case.asked.flight for case in cases]),
        made_by=np.array([one.made_by for one in told]),
        error=along_cross_down(track_frame(path, ahead), flown - path),
        distance=distance,
        passages={limit: passages(relative, ahead, limit) for limit in LIMITS},
        strict=passages(strict, ahead, LIMIT),
        tube=np.array([unknown if one.tube is None else one.tube for one in told]),
        horizon=np.array([one.horizon_s for one in told]),
    )


def _displacement(case: Case) -> np.ndarray:
    """Return the distance from the start, at least two seconds of ground speed, (k,) [m]."""
    return np.fmax(np.linalg.norm(case.flown - case.flown[0], axis=1), least_length(case.asked.speed))


def passages(relative: np.ndarray, ahead: np.ndarray, limit: float) -> np.ndarray:
    """Return the first passage of a limit by start and whether it is censored, (s, 2) [s, 0 or 1].

    Args:
        relative: relative errors, nan where unknown, (s, k) [-]
        ahead: look-ahead, (k,) [s]
        limit: relative error [-]
    """
    out = np.empty((len(relative), 2))
    for row, one in zip(out, relative, strict=True):
        known = np.isfinite(one)
        row[:] = first_passage(one[known] * (LIMIT / limit), ahead[known]) if known.any() else (0.0, True)
    return out


def quantile(found: np.ndarray, share: float) -> float:
    """Return the Kaplan-Meier estimate of the time at which a share of the starts has passed [s].

    Args:
        passages: times and whether they are censored, (s, 2) [s, 0 or 1]
        share: 0..1
    Returns:
        the time; the longest follow-up time where fewer passed; nan without starts
    """
    if not len(found):
        return float("nan")
    time, censored = found[np.lexsort((found[:, 1], found[:, 0]))].T
    left = np.arange(len(time), 0, -1)
    surviving = np.cumprod(1.0 - (censored == 0) / left)
    passed = np.flatnonzero(surviving <= 1.0 - share + 1e-12)
    return float(time[passed[0]] if len(passed) else time[-1])


def surviving(found: np.ndarray, seconds: float) -> float:
    """Return the share within the limit at a time up to which all starts were followed [s]; nan without starts."""
    return float(np.mean(found[:, 0] >= seconds - 1e-6)) if len(found) else float("nan")
