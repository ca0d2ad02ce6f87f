"""Fit a calibration table: sigma by maximum likelihood, half-axes by cross-conformal prediction.

Source: Vovk 2015, "Cross-conformal predictors"; Angelopoulos et al. 2024, "Conformal risk control".
"""

from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from twin_worker.confidence.calibration.conformal import factors_of
from twin_worker.confidence.calibration.scored_predictions import Scored
from twin_worker.confidence.calibration_table import INDEPENDENT, KNOTS, LEVELS, Doubt, Table, at_look_aheads, untaught
from twin_worker.confidence.horizon_risk import critical, growth
from twin_worker.confidence.weighted_quantile import censored_quantile, weighted_quantile
from twin_worker.numerics.prediction_errors import AHEAD, QUANTILE, first_passage

_NEAR = 1.2  # look-aheads within this factor of a knot are used for it [-]
_SPEAKERS = 3  # number of them, evenly spaced: neighbours are highly correlated
_NU = 4.0  # degrees of freedom of the errors: heavy tails
_USUAL_LAG = np.log(0.5)
_USUAL_FLOOR = 0.3  # of the median error [-]
_RIDGE = np.array([0.05, 0.01, 0.01])  # ridge penalty of scale, lag and floor towards typical values [-]
_MOST = 3.0  # bound on |log scale| and |log lag|
_QUIET = 20  # flights with fewer predictions than this have a smaller weight
_FOLDS = 4  # maximum number of folds when a table is fitted
_LEAST_M = 0.02  # smallest floor [m]


def near(knot: float) -> np.ndarray:
    """Return the columns of the look-ahead grid that are used for a knot."""
    found = np.flatnonzero(np.abs(np.log(np.maximum(AHEAD, 1e-9) / knot)) <= np.log(_NEAR))
    return found[np.unique(np.linspace(0, len(found) - 1, _SPEAKERS).round().astype(int))]


def fit_sigma(doubt: Doubt, error: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit scale, lag and floor by knot and axis to features and errors (s, k, 3) [m]; each (13, 3)."""
    found = np.tile([1.0, 1.0, _LEAST_M], (len(KNOTS), 3, 1))
    for i, knot in enumerate(KNOTS):
        columns = near(knot)
        for axis in range(3):
            s, r, e = (x[:, columns, axis].ravel() ** 2 for x in (doubt.spread, doubt.revision, error))
            known = np.isfinite(e)
            if known.any():
                found[i, axis] = _likeliest(s[known], r[known], e[known])
            elif i:
                found[i, axis] = found[i - 1, axis] * [1.0, 1.0, knot / KNOTS[i - 1]]
    return found[..., 0], found[..., 1], found[..., 2]


def _likeliest(s2: np.ndarray, r2: np.ndarray, e2: np.ndarray) -> np.ndarray:
    """Estimate scale, lag and floor for errors of Student's t distribution with `_NU` degrees of freedom, (3,)."""
    typical = max(float(np.sqrt(np.median(e2))), _LEAST_M)
    usual = np.array([0.0, _USUAL_LAG, np.log(_USUAL_FLOOR * typical)])
    parts = np.stack([s2, r2, np.ones_like(e2)])

    def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
        each = np.exp(2 * x)[:, None] * parts
        sigma2 = each.sum(axis=0)
        fit = np.mean(np.log(sigma2) + (_NU + 1) * np.log1p(e2 / (_NU * sigma2)))
        slope = 2 * (1 - (_NU + 1) * e2 / (_NU * sigma2 + e2)) / sigma2
        off = x - usual
        return float(fit + _RIDGE @ off**2), each @ slope / len(e2) + 2 * _RIDGE * off

    least = np.log(_LEAST_M)
    bounds = [(-_MOST, _MOST), (-_MOST, _MOST), (least, max(np.log(20 * typical), least + 1.0))]
    start = np.array([0.0, _USUAL_LAG, max(np.log(typical), least)])
    return np.exp(minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds).x)


def fit(scored: Scored, group: str) -> Table:
    """Fit the table of one group to its predictions; every score comes from a fit without its flight."""
    error, folds = scored.errors()[..., :3], scored.folds(group)
    weight = 1.0 / np.maximum(np.bincount(folds), _QUIET)[folds]  # equal weight per flight, less for short ones
    sigma = fit_sigma(scored.doubt, error)
    ratio = np.empty(error.shape)  # to sigma
    batch = folds % min(_FOLDS, int(folds.max()) + 1)
    for b in np.unique(batch):
        left = batch == b
        others = scored.part(~left).doubt
        apart = _raw(group, *(fit_sigma(others, error[~left]) if not left.all() else sigma))
        ratio[left] = error[left] / apart.sigma(scored.part(left).doubt, AHEAD)
    factors, levels = zip(*(factors_of(ratio[:, near(knot)], weight) for knot in KNOTS), strict=True)
    factor = _known(np.array(factors))
    told = [level for level in levels if np.isfinite(level)] or [INDEPENDENT]
    alone = float(np.clip(np.mean(told), QUANTILE, INDEPENDENT))
    flights = len(set(scored.flight.tolist()))
    table = replace(_raw(group, *sigma), factor=factor, starts=len(scored), flights=flights, alone=alone)
    return _with_risks(replace(table, scores=_scores(table, ratio, weight)), scored, weight)


def _scores(table: Table, ratio: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the quantiles of the largest error over its half-axis, over all look-aheads, (20,)."""
    score = (ratio / at_look_aheads(AHEAD, table.factor)).max(axis=2)[:, 1:]
    known = np.isfinite(score)
    loud = np.where(known, weight[:, None], 0.0).reshape(1, -1)
    found = [float(weighted_quantile(score.reshape(1, -1), loud, np.array([p]))[0]) for p in LEVELS]
    return np.maximum.accumulate(np.maximum(found, 1e-3))


def _raw(group: str, scale: np.ndarray, lag: np.ndarray, floor: np.ndarray) -> Table:
    plain = untaught("imm")
    return Table(group, 0, 0, scale, lag, floor, plain.factor, plain.scores, plain.risks)


def _known(factor: np.ndarray) -> np.ndarray:
    """Interpolate the factors of look-aheads without scores from their neighbours, (13, 3)."""
    known = np.isfinite(factor[:, 0])
    if not known.any():
        return np.full_like(factor, 2.0)
    return np.column_stack([np.interp(KNOTS, KNOTS[known], column[known]) for column in factor.T])


def _with_risks(table: Table, scored: Scored, weight: np.ndarray) -> Table:
    """Return the table with the quantiles of the critical factors of these predictions."""
    ratio = growth(table.half_axes(scored.doubt, AHEAD), scored.predicted_length)
    relative = scored.errors()[..., 3] / scored.length
    followed, censored = zip(*(first_passage(miss) for miss in relative), strict=True)
    x, exact = critical(ratio, np.array(followed)), ~np.array(censored)
    n = len(x)
    risks = [censored_quantile(x, weight, exact, min(p * (n + 1) / n, 1.0)) for p in LEVELS]
    return replace(table, risks=np.maximum.accumulate(risks))
