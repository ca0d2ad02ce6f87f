"""Scores of one method over many starts: relative error, first passages, axes, coverage, horizon.

M1 is |p_hat - p| / max(path flown, 2 s of ground speed), M2 is |p_hat - p| / max(displacement, 2 s of ground speed).
First passages are censored at the end of the known flight; their quantiles are Kaplan-Meier estimates.
Source: Kaplan & Meier 1958, "Nonparametric estimation from incomplete observations".
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from twin_worker.evaluation.scoring.log import EvaluationCase
from twin_worker.numerics.prediction_errors import (
    ERROR_LIMIT,
    along_cross_down,
    first_passage,
    min_path_length,
    track_frame,
)

LIMITS = (0.10, 0.05, 0.03)  # relative errors whose first passage is reported [-]


@dataclass(frozen=True)
class MethodScores:
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
    source: np.ndarray
    error: np.ndarray
    distance: np.ndarray
    passages: dict[float, np.ndarray]
    m2_passages: np.ndarray
    tube: np.ndarray
    horizon: np.ndarray

    def column_at(self, seconds: float) -> int | None:
        """Return the column of a look-ahead; None if the grid has none there."""
        columns = np.flatnonzero(np.abs(self.ahead - seconds) < 0.5)
        return int(columns[0]) if len(columns) else None

    @property
    def inside(self) -> np.ndarray:
        """Return whether the flight was inside the tube on all axes, nan unknown, (s, k)."""
        valid = np.isfinite(self.error).all(axis=2) & np.isfinite(self.tube).all(axis=2)
        return np.where(valid, (np.abs(self.error) <= self.tube).all(axis=2), np.nan)


def score_method(cases: Sequence[EvaluationCase], method: str) -> MethodScores:
    """Score one method over starts with the same look-aheads."""
    forecasts = [case.start.forecasts[method] for case in cases]
    positions, path = np.array([case.positions for case in cases]), np.array([forecast.path for forecast in forecasts])
    distance = np.linalg.norm(positions - path, axis=2)
    ahead = cases[0].start.ahead
    relative = distance / np.array([case.length for case in cases])
    displacement = [
        np.fmax(np.linalg.norm(case.positions - case.positions[0], axis=1), min_path_length(case.start.speed))
        for case in cases
    ]
    unknown = np.full((len(ahead), 3), np.nan)
    return MethodScores(
        ahead=ahead,
        flight=np.array([case.start.flight for case in cases]),
        source=np.array([one.source for one in forecasts]),
        error=along_cross_down(track_frame(path, ahead), positions - path),
        distance=distance,
        passages={limit: first_passages(relative, ahead, limit) for limit in LIMITS},
        m2_passages=first_passages(distance / np.array(displacement), ahead, ERROR_LIMIT),
        tube=np.array([unknown if one.tube is None else one.tube for one in forecasts]),
        horizon=np.array([one.horizon_s for one in forecasts]),
    )


def first_passages(relative: np.ndarray, ahead: np.ndarray, limit: float) -> np.ndarray:
    """Return the first passage of a limit by start and whether it is censored, (s, 2) [s, 0 or 1].

    Args:
        relative: relative errors, nan where unknown, (s, k) [-]
        ahead: look-ahead, (k,) [s]
        limit: relative error [-]
    """
    out = np.empty((len(relative), 2))
    for row, errors in zip(out, relative, strict=True):
        valid = np.isfinite(errors)
        row[:] = first_passage(errors[valid] * (ERROR_LIMIT / limit), ahead[valid]) if valid.any() else (0.0, True)
    return out


def passage_quantile(passages: np.ndarray, share: float) -> float:
    """Return the Kaplan-Meier estimate of the time at which a share of the starts has passed [s].

    Args:
        passages: times and whether they are censored, (s, 2) [s, 0 or 1]
        share: 0..1
    Returns:
        the time; the longest follow-up time where fewer passed; nan without starts
    """
    if not len(passages):
        return float("nan")
    time, surviving = _surviving(passages)
    reached = np.flatnonzero(surviving <= 1.0 - share + 1e-12)
    return float(time[reached[0]] if len(reached) else time[-1])


def survival_at(passages: np.ndarray, seconds: float) -> float:
    """Return the Kaplan-Meier estimate of the share within the limit at a time [s]; nan if none was followed so far.

    Where all starts were followed up to that time, this is their plain share.
    """
    if not len(passages):
        return float("nan")
    followed = (passages[:, 1] == 0) | (passages[:, 0] >= seconds - 1e-6)
    if followed.all():
        return float(np.mean(passages[:, 0] >= seconds - 1e-6))
    time, surviving = _surviving(passages)
    if time[-1] < seconds - 1e-6 and surviving[-1] > 0:
        return float("nan")
    passed = np.flatnonzero(time < seconds - 1e-6)
    return float(surviving[passed[-1]]) if len(passed) else 1.0


def _surviving(passages: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the times of passages, rising, and the share that survives each, (s,) both."""
    time, censored = passages[np.lexsort((passages[:, 1], passages[:, 0]))].T
    return time, np.cumprod(1.0 - (censored == 0) / np.arange(len(time), 0, -1))
