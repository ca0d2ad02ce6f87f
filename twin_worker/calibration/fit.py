"""Fit a calibration table: likelihood for what sigma is, left-out predictions for how many of them to claim.

Source: Vovk 2015, "Cross-conformal predictors"; Angelopoulos et al. 2024, "Conformal risk control".
"""

from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from twin_worker.calibration.conform import factors_of
from twin_worker.calibration.miss import AHEAD, first_passage
from twin_worker.calibration.quantile import censored_quantile, weighted_quantile
from twin_worker.calibration.risk import critical, growth
from twin_worker.calibration.scored import Scored
from twin_worker.calibration.table import KNOTS, LEVELS, Table, untaught

_NEAR = 1.2  # look-aheads within this factor of a knot speak for it [-]
_SPEAKERS = 3  # as many of them, evenly: neighbours say much the same
_NU = 4.0  # degrees of freedom of the errors: heavy tails
_RIDGE = 0.05  # holds the scale near 1 where the spread never varies [-]
_RIDGE_FLOOR = 0.02  # holds the floor near its usual share where the spread leaves it nothing [-]
_USUAL_FLOOR = 0.3  # of the median error [-]
_MOST_SPREAD = 3.0  # scale lies within exp of this, either way
_FOLDS = 4  # most of them when a table is fitted; leaving one out is another matter
_LEAST_M = 0.02  # smallest floor [m]


def near(knot: float) -> np.ndarray:
    """Give the columns of the look-ahead grid that speak for a knot."""
    found = np.flatnonzero(np.abs(np.log(np.maximum(AHEAD, 1e-9) / knot)) <= np.log(_NEAR))
    return found[np.unique(np.linspace(0, len(found) - 1, _SPEAKERS).round().astype(int))]


def fit_sigma(spread: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit scale and floor by knot and axis to spreads and errors (s, k, 3) [m]; each (13, 3)."""
    scale, floor = np.ones((len(KNOTS), 3)), np.full((len(KNOTS), 3), _LEAST_M)
    for i, knot in enumerate(KNOTS):
        columns = near(knot)
        for axis in range(3):
            s, e = spread[:, columns, axis].ravel(), error[:, columns, axis].ravel()
            known = np.isfinite(e)
            if known.any():
                scale[i, axis], floor[i, axis] = _likeliest(s[known] ** 2, e[known] ** 2)
            elif i:
                scale[i, axis], floor[i, axis] = scale[i - 1, axis], floor[i - 1, axis] * knot / KNOTS[i - 1]
    return scale, floor


def _likeliest(s2: np.ndarray, e2: np.ndarray) -> tuple[float, float]:
    """Give scale and floor under errors with Student's t law of `_NU` degrees of freedom."""
    typical = max(float(np.sqrt(np.median(e2))), _LEAST_M)
    usual = np.log(_USUAL_FLOOR * typical)

    def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
        known, unknown = np.exp(2 * x[0]) * s2, np.exp(2 * x[1])
        sigma2 = known + unknown
        fit = np.mean(np.log(sigma2) + (_NU + 1) * np.log1p(e2 / (_NU * sigma2)))
        slope = 2 * (1 - (_NU + 1) * e2 / (_NU * sigma2 + e2)) / sigma2
        gradient = [np.mean(slope * known) + 2 * _RIDGE * x[0], np.mean(slope) * unknown]
        gradient[1] += 2 * _RIDGE_FLOOR * (x[1] - usual)
        return float(fit + _RIDGE * x[0] ** 2 + _RIDGE_FLOOR * (x[1] - usual) ** 2), np.array(gradient)

    bounds = [(-_MOST_SPREAD, _MOST_SPREAD), (np.log(_LEAST_M), np.log(max(20 * typical, 10 * _LEAST_M)))]
    found = minimize(cost, [0.0, np.log(typical)], jac=True, method="L-BFGS-B", bounds=bounds)
    return float(np.exp(found.x[0])), float(np.exp(found.x[1]))


def fit(scored: Scored, group: str) -> Table:
    """Fit the table of one group to its predictions; every score comes from a fit that had not seen its flight."""
    error, folds = scored.errors()[..., :3], scored.folds(group)
    weight = 1.0 / np.bincount(folds)[folds]  # each flight speaks as loud
    scale, floor = fit_sigma(scored.spread, error)
    ratio = np.empty(error.shape)  # to sigma
    batch = folds % min(_FOLDS, int(folds.max()) + 1)
    for b in np.unique(batch):
        left = batch == b
        apart = _raw(group, *(fit_sigma(scored.spread[~left], error[~left]) if not left.all() else (scale, floor)))
        ratio[left] = error[left] / apart.sigma(scored.spread[left], AHEAD)
    factor = _known(np.array([factors_of(ratio[:, near(knot)], weight) for knot in KNOTS]))
    flights = len(set(scored.flight.tolist()))
    table = replace(_raw(group, scale, floor), factor=factor, starts=len(scored), flights=flights)
    return _with_risks(replace(table, scores=_scores(table, ratio, weight)), scored, weight)


def _scores(table: Table, ratio: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Give how the largest error over its half-axis was distributed, over all look-aheads, (20,)."""
    unit = replace(table, scale=np.zeros_like(table.scale), floor=np.ones_like(table.floor))
    score = (ratio / unit.half_axes(np.zeros(3), AHEAD)).max(axis=2)[:, 1:]
    known = np.isfinite(score)
    loud = np.where(known, weight[:, None], 0.0).reshape(1, -1)
    found = [float(weighted_quantile(score.reshape(1, -1), loud, np.array([p]))[0]) for p in LEVELS]
    return np.maximum.accumulate(np.maximum(found, 1e-3))


def _raw(group: str, scale: np.ndarray, floor: np.ndarray) -> Table:
    plain = untaught("imm")
    return Table(group, 0, 0, scale, floor, plain.factor, plain.scores, plain.risks)


def _known(factor: np.ndarray) -> np.ndarray:
    """Let look-aheads nobody followed take the factors of their neighbours, (13, 3)."""
    known = np.isfinite(factor[:, 0])
    if not known.any():
        return np.full_like(factor, 2.0)
    return np.column_stack([np.interp(KNOTS, KNOTS[known], column[known]) for column in factor.T])


def _with_risks(table: Table, scored: Scored, weight: np.ndarray) -> Table:
    """Add how the critical factors of these predictions are distributed."""
    ratio = growth(table.half_axes(scored.spread, AHEAD), scored.predicted_length)
    relative = scored.errors()[..., 3] / scored.length
    followed, censored = zip(*(first_passage(miss) for miss in relative), strict=True)
    x, exact = critical(ratio, np.array(followed)), ~np.array(censored)
    n = len(x)
    risks = [censored_quantile(x, weight, exact, min(p * (n + 1) / n, 1.0)) for p in LEVELS]
    return replace(table, risks=np.maximum.accumulate(risks))
