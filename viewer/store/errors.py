"""Prediction errors: stored predictions compared with the flown trail."""

import numpy as np

from viewer.store.forecast import Kept
from viewer.store.place import UNIT_M

AHEADS_S = np.arange(1.0, 31.0)  # look-aheads at which errors are measured [s]
LEAST = 3  # fewer errors at a look-ahead give no RMS


def errors(past: list[Kept], trail: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the position error of every prediction at every elapsed look-ahead.

    Args:
        predictions: oldest first
        trail: fleet time [s], scene ENU [10 m], (n, 4 or more)
    Returns:
        issue times (k,) [s] and errors (k, 30) [m]; NaN where the flown position is not available
    """
    if not past or len(trail) < 2:
        return np.zeros(0), np.zeros((0, len(AHEADS_S)))
    made = np.array([told.t for told in past])
    due = made[:, None] + AHEADS_S
    flown = np.stack([np.interp(due, trail[:, 0], trail[:, i]) for i in (1, 2, 3)], axis=-1)
    told = np.stack([one.at(AHEADS_S) for one in past])
    off = UNIT_M * np.linalg.norm(told - flown, axis=-1)
    reach = np.array([min(one.until, float(one.ahead[-1])) for one in past])
    unanswered = (due > trail[-1, 0]) | (due < trail[0, 0]) | (reach[:, None] < AHEADS_S)
    return made, np.where(unanswered, np.nan, off)


def by_ahead(off: np.ndarray) -> np.ndarray:
    """Return the RMS error at each look-ahead, (30,) [m]; NaN for fewer than `MIN_PREDICTIONS` errors."""
    n = np.isfinite(off).sum(axis=0)
    mean = np.nansum(off**2, axis=0) / np.maximum(n, 1)
    return np.where(n >= LEAST, np.sqrt(mean), np.nan)
