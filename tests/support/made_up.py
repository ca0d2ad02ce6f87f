"""Made-up predictions of known law: straight flights, an ensemble half as wide as its errors, easy and hard minutes."""

import numpy as np

from twin_worker.confidence.calibration.scored_predictions import ScoredPredictions, revisions
from twin_worker.confidence.calibration_table import UncertaintyFeatures
from twin_worker.numerics.prediction_errors import AHEAD, path_length

V = 20.0  # over ground [m/s]
LINE = np.column_stack([V * AHEAD, 0 * AHEAD, 0 * AHEAD - 100.0])
GROUP = "hybrid/arduplane/fixed_wing/known"
GROWTH = np.outer(0.3 + 0.06 * AHEAD**1.3, [1.0, 0.3, 0.15])  # spread of a usual minute, along cross vertical [m]


def normal(rng: np.random.Generator) -> np.ndarray:
    """Errors of unit variance that turn over slowly with look-ahead, (91, 3)."""
    turn = np.log1p(AHEAD)[:, None] * np.pi / 4
    first, second = rng.standard_normal((2, 3))
    return np.cos(turn) * first + np.sin(turn) * second


def spreads(rng: np.random.Generator) -> np.ndarray:
    """What an ensemble says: minutes differ by as much as half an order of magnitude, (91, 3) [m]."""
    return GROWTH * np.exp(0.9 * rng.standard_normal())


def errors(rng: np.random.Generator, spread: np.ndarray, loud: float = 1.0) -> np.ndarray:
    """What then happens: twice the spread, and a little that no ensemble knows of, (91, 3) [m]."""
    return loud * (2.0 * spread * normal(rng) + 0.2 * rng.standard_normal((1, 3)))


def scored(flights: int, starts: int, seed: int, *, loud: float = 1.0, group: str = GROUP) -> ScoredPredictions:
    """Make up so many flights of so many predictions; a fifth of them is not followed to the end."""
    rng = np.random.default_rng(seed)
    n = flights * starts
    t0 = np.tile(5.0 * np.arange(starts), flights)
    names = np.repeat([f"seed-{seed}-{i}" for i in range(flights)], starts)
    spread = np.array([spreads(rng) for _ in range(n)])
    flown = LINE + V * t0[:, None, None] * [1.0, 0.0, 0.0]
    path = flown - np.array([errors(rng, one, loud) for one in spread])
    for row in np.flatnonzero(rng.random(n) < 0.2):
        flown[row, rng.integers(20, len(AHEAD)) :] = np.nan
    revision = revisions(t0, path, names)
    length = np.tile(path_length(LINE, V), (n, 1))
    return ScoredPredictions(
        t0=t0,
        path=path,
        features=UncertaintyFeatures(spread, np.where(np.isfinite(revision), revision, spread), path),
        flown=flown,
        length=np.where(np.isfinite(flown[..., 0]), length, np.nan),
        predicted_length=length,
        group=np.full(n, group),
        method=np.full(n, group.partition("/")[0]),
        flight=names,
    )
