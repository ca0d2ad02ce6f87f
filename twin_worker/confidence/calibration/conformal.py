"""Factors from sigma to half-axes: each axis misses as often as another, and all three hold at once.

One level of ranks for all axes: an axis of heavy tails is not paid for by the others, as it is where the largest of
the three errors over sigma is ranked.

Source: Messoudi, Destercke & Rousseau 2021, "Copula-based conformal prediction for multi-target regression".
"""

import numpy as np

from twin_worker.confidence.weighted_quantile import weighted_quantile
from twin_worker.numerics.prediction_errors import QUANTILE


def factors_of(ratio: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the factors that hold `QUANTILE` of the next predictions too, (3,), and the share that one axis holds.

    That share is `QUANTILE` where all axes err at once and its cube root where they are independent; both are nan where
    nothing is known.

    Args:
        ratio: errors along, cross, vertical over their sigma, nan where not known, (s, k, 3) [-]
        weight: of each prediction, (s,)
    """
    known = np.isfinite(ratio).all(axis=2)
    n = int(known.any(axis=1).sum())
    if not n:
        return np.full(3, np.nan), float("nan")
    x, w = ratio[known].T.copy(), np.broadcast_to(weight[:, None], known.shape)[known]
    highest = np.max([_rank(row, w) for row in x], axis=0)
    level = weighted_quantile(highest[None], w[None], np.array([min(QUANTILE * (n + 1) / n, 1.0)]))
    return np.maximum(weighted_quantile(x, np.tile(w, (3, 1)), np.tile(level, 3)), 1e-3), float(level[0])


def _rank(x: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the share of the weight that lies below each value, (n,)."""
    order = np.argsort(x)
    out = np.empty(len(x))
    out[order] = (np.cumsum(weight[order]) - 0.5 * weight[order]) / weight.sum()
    return out
