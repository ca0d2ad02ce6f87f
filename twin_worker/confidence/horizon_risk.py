"""The confidence horizon: where the largest half-axes times a factor pass 10 % of the path, and which factor holds.

The factor is chosen so that at most 1 - `QUANTILE` of predictions pass 10 % before their horizon. Each prediction
has one critical factor, the least that ends its horizon in time, and the quantile of those is the factor; most
never pass, and are known only to need less than some factor.

Source: Angelopoulos et al. 2024, "Conformal risk control" (the loss falls as the factor grows); Candes, Lei & Ren
2023, "Conformalized survival analysis" (predictions followed for a while).
"""

import numpy as np

from twin_worker.numerics.prediction_errors import AHEAD, LIMIT

_POWER = 8.0  # nearer to the maximum the higher
_STEP = np.gradient(np.log1p(AHEAD))


def growth(half_axes: np.ndarray, predicted_length: np.ndarray) -> np.ndarray:
    """Return how large half-axes (..., n, 3) ever were beside the path so far (..., n), always rising, (..., n) [-].

    A power mean of high power over log time: close to the maximum so far, but without its flat stretches, on which a
    horizon would jump by minutes.
    """
    ratio = np.linalg.norm(half_axes, axis=-1) / predicted_length
    most = np.maximum(ratio.max(axis=-1, keepdims=True), 1e-30)
    run = np.cumsum((ratio / most) ** _POWER * _STEP[: ratio.shape[-1]], axis=-1)
    return most * run ** (1.0 / _POWER)


def critical(ratio: np.ndarray, followed: np.ndarray) -> np.ndarray:
    """Return each prediction's critical factor, (m,): exact where it passed, else no more than a bound from above.

    What stayed within 10 % needs no more than what ends its horizon there. An easy minute says nothing about factors
    so small that only hard ones are ended by them: so the hard ones hold as often as all.

    Args:
        ratio: growth of each prediction over `AHEAD`, (m, n) [-]
        followed: time to its first passage, or how long it was seen to stay within 10 %, (m,) [s]
    """
    left = np.clip(np.searchsorted(AHEAD, followed, side="right") - 1, 0, len(AHEAD) - 2)
    share = np.clip((followed - AHEAD[left]) / (AHEAD[left + 1] - AHEAD[left]), 0.0, 1.0)
    row = np.arange(len(ratio))
    there = ratio[row, left] + share * (ratio[row, left + 1] - ratio[row, left])
    return LIMIT / np.maximum(there, 1e-9)
