"""Prediction errors: stored predictions compared with the flown trail."""

import numpy as np

from viewer.store.forecast import PastPrediction
from viewer.store.place import UNIT_M

LOOK_AHEADS_S = np.arange(1.0, 31.0)  # look-aheads at which errors are measured [s]
MIN_PREDICTIONS = 3  # fewer errors at a look-ahead give no RMS


def prediction_errors(predictions: list[PastPrediction], trail: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the position error of every prediction at every elapsed look-ahead.

    Args:
        predictions: oldest first
        trail: fleet time [s], scene ENU [10 m], (n, 4 or more)
    Returns:
        issue times (k,) [s] and errors (k, 30) [m]; NaN where the flown position is not available
    """
    if not predictions or len(trail) < 2:
        return np.zeros(0), np.zeros((0, len(LOOK_AHEADS_S)))
    issued = np.array([predicted.t for predicted in predictions])
    due = issued[:, None] + LOOK_AHEADS_S
    actual = np.stack([np.interp(due, trail[:, 0], trail[:, i]) for i in (1, 2, 3)], axis=-1)
    predicted = np.stack([prediction.position_at(LOOK_AHEADS_S) for prediction in predictions])
    distances = UNIT_M * np.linalg.norm(predicted - actual, axis=-1)
    claimed_s = np.array([min(prediction.horizon_s, float(prediction.ahead[-1])) for prediction in predictions])
    unavailable = (due > trail[-1, 0]) | (due < trail[0, 0]) | (claimed_s[:, None] < LOOK_AHEADS_S)
    return issued, np.where(unavailable, np.nan, distances)


def rms_by_look_ahead(distances: np.ndarray) -> np.ndarray:
    """Return the RMS error at each look-ahead, (30,) [m]; NaN for fewer than `MIN_PREDICTIONS` errors."""
    n = np.isfinite(distances).sum(axis=0)
    mean = np.nansum(distances**2, axis=0) / np.maximum(n, 1)
    return np.where(n >= MIN_PREDICTIONS, np.sqrt(mean), np.nan)
