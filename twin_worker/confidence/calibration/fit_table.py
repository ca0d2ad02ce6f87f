"""Fit a calibration table: sigma by maximum likelihood, half-axes by cross-conformal prediction.

Source: Vovk 2015, "Cross-conformal predictors"; Angelopoulos et al. 2024, "Conformal risk control".
"""

from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from twin_worker.confidence.calibration.scored_predictions import ScoredPredictions
from twin_worker.confidence.calibration_table import (
    COLUMN,
    INDEPENDENT,
    KNOTS,
    LEVELS,
    CalibrationTable,
    UncertaintyFeatures,
    at_look_aheads,
    default_table,
    log_scores,
)
from twin_worker.confidence.weighted_quantile import (
    censored_quantile,
    critical_factor,
    running_max_error_ratio,
    weighted_quantile,
)
from twin_worker.numerics.prediction_errors import AHEAD, NOMINAL_COVERAGE, displacement_along_path, first_passage


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


_KNOT_RATIO = 1.2  # look-aheads within this factor of a knot are used for it [-]
_COLUMNS_PER_KNOT = 3  # number of them, evenly spaced: neighbours are highly correlated
_NU = 4.0  # degrees of freedom of the errors: heavy tails
_USUAL_LAG = np.log(0.5)
_USUAL_FLOOR = 0.3  # of the median error [-]
_RIDGE = np.array([0.05, 0.01, 0.01, 0.01])  # ridge penalty of scale, lag, turn and floor towards typical values [-]
_MAX_LOG = 3.0  # bound on |log scale| and |log lag|
_MIN_FLIGHT_STARTS = 20  # flights with fewer predictions than this have a smaller weight
_FOLDS = 4  # maximum number of folds when a table is fitted
_MIN_FLOOR_M = 0.02  # smallest floor [m]


def columns_near(knot: float) -> np.ndarray:
    """Return the columns of the look-ahead grid that are used for a knot."""
    columns = np.flatnonzero(np.abs(np.log(np.maximum(AHEAD, 1e-9) / knot)) <= np.log(_KNOT_RATIO))
    return columns[np.unique(np.linspace(0, len(columns) - 1, _COLUMNS_PER_KNOT).round().astype(int))]


def fit_sigma(features: UncertaintyFeatures, error: np.ndarray) -> tuple[np.ndarray, ...]:
    """Fit scale, lag, turn and floor by knot and axis to features and errors (s, k, 3) [m]; each (13, 3).

    The along axis comes first, because the displacement across and vertical depends on its sigma.
    """
    parameters = np.tile([1.0, 1.0, 1.0, _MIN_FLOOR_M], (len(KNOTS), 3, 1))
    displacement = np.zeros_like(error)
    for axis in range(3):
        parts = features.spread[..., axis], features.revision[..., axis], displacement[..., axis], error[..., axis]
        for i, knot in enumerate(KNOTS):
            s, r, d, e = (x[:, columns_near(knot)].ravel() ** 2 for x in parts)
            valid = np.isfinite(e)
            if valid.any():
                parameters[i, axis] = _max_likelihood(s[valid], r[valid], d[valid], e[valid])
            elif i:
                parameters[i, axis] = parameters[i - 1, axis] * [1.0, 1.0, 1.0, knot / KNOTS[i - 1]]
        if axis == 0:
            scale, lag, _, floor = at_look_aheads(AHEAD, parameters[:, 0]).T
            along = np.sqrt((scale * parts[0]) ** 2 + (lag * parts[1]) ** 2 + floor**2)
            displacement = displacement_along_path(features.path, along)
    parameters[:, 0, 2] = 0.0
    return tuple(np.moveaxis(parameters, -1, 0))


def _max_likelihood(s2: np.ndarray, r2: np.ndarray, d2: np.ndarray, e2: np.ndarray) -> np.ndarray:
    """Estimate scale, lag, turn and floor, (4,), for errors of Student's t distribution, `_NU` degrees of freedom."""
    typical = max(float(np.sqrt(np.median(e2))), _MIN_FLOOR_M)
    prior = np.array([0.0, _USUAL_LAG, 0.0, np.log(_USUAL_FLOOR * typical)])
    parts = np.stack([s2, r2, d2, np.ones_like(e2)])

    def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
        terms = np.exp(2 * x)[:, None] * parts
        sigma2 = terms.sum(axis=0)
        fit = np.mean(np.log(sigma2) + (_NU + 1) * np.log1p(e2 / (_NU * sigma2)))
        slope = 2 * (1 - (_NU + 1) * e2 / (_NU * sigma2 + e2)) / sigma2
        offset = x - prior
        return float(fit + _RIDGE @ offset**2), terms @ slope / len(e2) + 2 * _RIDGE * offset

    min_log_floor = np.log(_MIN_FLOOR_M)
    bounds = [
        *[(-_MAX_LOG, _MAX_LOG)] * 3,
        (min_log_floor, max(np.log(20 * typical), min_log_floor + 1.0)),
    ]
    start = np.array([0.0, _USUAL_LAG, 0.0, max(np.log(typical), min_log_floor)])
    return np.exp(minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds).x)


def fit(predictions: ScoredPredictions, group: str) -> CalibrationTable:
    """Fit the table of one group to its predictions; every score comes from a fit without its flight."""
    error, folds = predictions.errors()[..., :3], predictions.folds(group)
    weight = 1.0 / np.maximum(np.bincount(folds), _MIN_FLIGHT_STARTS)[folds]  # equal per flight, less for short ones
    sigma = fit_sigma(predictions.features, error)
    ratio = np.empty(error.shape)  # to sigma
    batch = folds % min(_FOLDS, int(folds.max()) + 1)
    for b in np.unique(batch):
        left_out = batch == b
        others = predictions.select(~left_out).features
        fold_table = _unscaled_table(group, *(fit_sigma(others, error[~left_out]) if not left_out.all() else sigma))
        ratio[left_out] = error[left_out] / fold_table.sigma(predictions.select(left_out).features, AHEAD)
    factors, levels = zip(*(conformal_factors(ratio[:, columns_near(knot)], weight) for knot in KNOTS), strict=True)
    factor = _fill_missing(np.array(factors))
    valid_levels = [level for level in levels if np.isfinite(level)] or [INDEPENDENT]
    axis_level = float(np.clip(np.mean(valid_levels), NOMINAL_COVERAGE, INDEPENDENT))
    flights = len(set(predictions.flight.tolist()))
    table = replace(
        _unscaled_table(group, *sigma), factor=factor, starts=len(predictions), flights=flights, alone=axis_level
    )
    table = replace(table, log_score=_log_score(table, ratio, weight))
    return _with_risks(replace(table, scores=_score_quantiles(table, ratio, weight)), predictions, weight)


def _log_score(table: CalibrationTable, ratio: np.ndarray, weight: np.ndarray) -> tuple[float, float, float]:
    """Return the mean logarithm of errors over half-axes at the knots, by axis.

    Errors on route are small except at the begin of a turn, so their mean logarithm lies below that of Student's t.
    """
    logs = log_scores(np.abs(ratio[:, COLUMN]) / table.factor)
    shares = np.where(np.isfinite(logs), weight[:, None, None], 0.0)
    along, cross, vertical = (np.nansum(shares * np.nan_to_num(logs), axis=(0, 1)) / shares.sum(axis=(0, 1))).tolist()
    return along, cross, vertical


def _score_quantiles(table: CalibrationTable, ratio: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the quantiles of the largest error over its half-axis, over all look-aheads, (20,)."""
    score = (ratio / at_look_aheads(AHEAD, table.factor)).max(axis=2)[:, 1:]
    valid = np.isfinite(score)
    weights = np.where(valid, weight[:, None], 0.0).reshape(1, -1)
    quantiles = [float(weighted_quantile(score.reshape(1, -1), weights, np.array([p]))[0]) for p in LEVELS]
    return np.maximum.accumulate(np.maximum(quantiles, 1e-3))


def _unscaled_table(
    group: str, scale: np.ndarray, lag: np.ndarray, turn: np.ndarray, floor: np.ndarray
) -> CalibrationTable:
    default = default_table("imm")
    return CalibrationTable(group, 0, 0, scale, lag, turn, floor, default.factor, default.scores, default.risks)


def _fill_missing(factor: np.ndarray) -> np.ndarray:
    """Interpolate the factors of look-aheads without scores from their neighbours, (13, 3)."""
    valid = np.isfinite(factor[:, 0])
    if not valid.any():
        return np.full_like(factor, 2.0)
    return np.column_stack([np.interp(KNOTS, KNOTS[valid], column[valid]) for column in factor.T])


def _with_risks(table: CalibrationTable, predictions: ScoredPredictions, weight: np.ndarray) -> CalibrationTable:
    """Return the table with the quantiles of the critical factors of these predictions."""
    ratio = running_max_error_ratio(table.half_axes(predictions.features, AHEAD), predictions.predicted_length)
    relative = predictions.errors()[..., 3] / predictions.length
    followed, censored = zip(*(first_passage(row) for row in relative), strict=True)
    x, exact = critical_factor(ratio, np.array(followed)), ~np.array(censored)
    n = len(x)
    risks = [censored_quantile(x, weight, exact, min(p * (n + 1) / n, 1.0)) for p in LEVELS]
    return replace(table, risks=np.maximum.accumulate(risks))
