"""The confidence horizon: where the largest half-axes times a factor pass 10 % of the path, and which factor holds.

The factor is chosen so that at most 1 - `QUANTILE` of predictions pass 10 % before their horizon. Each prediction
has one critical factor, the least that ends its horizon in time, and the quantile of those is the factor.

Source: Angelopoulos et al. 2024, "Conformal risk control" (the loss falls as the factor grows).
"""

import numpy as np

from twin_worker.calibration.miss import AHEAD, LIMIT


def growth(half_axes: np.ndarray, predicted_length: np.ndarray) -> np.ndarray:
    """Give how large half-axes (..., n, 3) ever were beside the path length so far (..., n), rising, (..., n) [-]."""
    return np.maximum.accumulate(np.linalg.norm(half_axes, axis=-1) / predicted_length, axis=-1)


def critical(
    ratio: np.ndarray, followed: np.ndarray, passed: np.ndarray, end: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """Give each prediction's critical factor, and whether that is exact or a bound from above.

    Whatever stayed within 10 % to its end holds under any factor: exactly 0. What was only followed for a while
    needs no more than ends its horizon there.

    Args:
        ratio: growth of each prediction over `AHEAD`, (m, n) [-]
        followed: time to its first passage, or how long it was seen to stay within 10 %, (m,) [s]
        passed: whether it passed, (m,) bool
        end: last look-ahead of each, (m,) or one [s]
    """
    left = np.clip(np.searchsorted(AHEAD, followed, side="right") - 1, 0, len(AHEAD) - 2)
    share = np.clip((followed - AHEAD[left]) / (AHEAD[left + 1] - AHEAD[left]), 0.0, 1.0)
    row = np.arange(len(ratio))
    there = ratio[row, left] + share * (ratio[row, left + 1] - ratio[row, left])
    whole = ~passed & (followed >= end)
    return np.where(whole, 0.0, LIMIT / np.maximum(there, 1e-9)), passed | whole
