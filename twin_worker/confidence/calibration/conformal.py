"""Conformal factors from sigma to half-axes: equal coverage of every axis, and joint coverage of all three.

All axes share one rank level, so an axis with heavy tails does not widen the others, as it would if the largest of
the three normalised errors were ranked.

Source: Messoudi, Destercke & Rousseau 2021, "Copula-based conformal prediction for multi-target regression".
"""

import numpy as np

from twin_worker.confidence.weighted_quantile import weighted_quantile
from twin_worker.numerics.prediction_errors import NOMINAL_COVERAGE


def conformal_factors(ratio: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the factors of joint coverage `NOMINAL_COVERAGE` on new predictions, (3,), and the coverage of one axis.

    The latter is `NOMINAL_COVERAGE` for fully dependent axes and its cube root for independent ones. Without scores
    both are nan.

    Args:
        ratio: errors along, cross, vertical over their sigma, nan where unknown, (s, k, 3) [-]
        weight: of each prediction, (s,)
    """
    valid = np.isfinite(ratio).all(axis=2)
    n = int(valid.any(axis=1).sum())
    if not n:
        return np.full(3, np.nan), float("nan")
    x, w = ratio[valid].T.copy(), np.broadcast_to(weight[:, None], valid.shape)[valid]
    highest = np.max([_rank(row, w) for row in x], axis=0)
    level = weighted_quantile(highest[None], w[None], np.array([min(NOMINAL_COVERAGE * (n + 1) / n, 1.0)]))
    return np.maximum(weighted_quantile(x, np.tile(w, (3, 1)), np.tile(level, 3)), 1e-3), float(level[0])


def _rank(x: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the share of the weight that lies below each value, (n,)."""
    order = np.argsort(x)
    out = np.empty(len(x))
    out[order] = (np.cumsum(weight[order]) - 0.5 * weight[order]) / weight.sum()
    return out
