"""Adapt tube and horizon to one aircraft by the scores of its own past predictions.

The factor on a table's half-axes is the product of two: of each axis, by the mean logarithm of the aircraft's own
errors, which says how calm its air and how exact its model is; and of each look-ahead, a quantile of its own scores
after that. In both, the table counts as a few more scores. The quantile level rises at each miss and falls a little at
each hit, within bounds. Short look-aheads are scored first; the factor of an axis also scales the longer ones.

Coverage is not guaranteed. The long-run coverage of the source requires unbounded levels and an infinite region from
level 1 on, but a published region must be finite. An aircraft whose errors exceed all errors in the table is therefore
covered less. `Confidence.sentence` reports a bound that is met; the measured coverage is published too.

Source: Gibbs & Candes 2021, "Adaptive conformal inference under distribution shift", proposition 4.1; Gelman et al.
2013, "Bayesian data analysis", 2.5 (normal mean with a normal prior, here of log errors).
"""

from dataclasses import dataclass, field

import numba as nb
import numpy as np

from twin_worker.confidence.calibration_table import ATOMS, KNOTS, CalibrationTable, log_scores
from twin_worker.confidence.prediction_log import EVERY_S, KNOT_OF, PredictionLog
from twin_worker.confidence.weighted_quantile import censored_distribution, critical_factor, weighted_quantile
from twin_worker.numerics.interpolation import interpolate_rows
from twin_worker.numerics.prediction_errors import ERROR_LIMIT, NOMINAL_COVERAGE

_TABLE_WEIGHT = 10.0  # independent predictions that the table counts as [-]
_DECAY_S = 400.0  # time constant of the weight of a score [s]
_WEIGHT = np.minimum(1.0, EVERY_S / (0.5 * KNOTS))  # weight of a score; scores of overlapping predictions correlate [-]
_HORIZON_WEIGHT = EVERY_S / 30.0  # weight of a first passage [-]
_TUBE_STEP, _HORIZON_STEP = 0.05, 0.02  # of the level, per independent miss [-]
_MIN_LEVEL, _MAX_LEVEL = 0.5, 0.99
_MEAN_LOG_ERROR = -0.500  # expected log |error / sigma| of Student's t with 4 degrees of freedom, as tables assume [-]
_MIN_FACTOR, _MAX_FACTOR = 0.1, 20.0
_exact = nb.njit(cache=True, nogil=True, _nrt=False)  # type: ignore[call-overload]  # no fastmath: results equal numpy's


@dataclass
class AdaptiveLevels:
    """Present quantile levels of one group: of the tube at each knot, and of the horizon."""

    tube: np.ndarray = field(default_factory=lambda: np.full(len(KNOTS), NOMINAL_COVERAGE))
    horizon: float = NOMINAL_COVERAGE

    def update(self, log: PredictionLog, rows: np.ndarray, columns: np.ndarray, in_group: np.ndarray) -> None:
        """Update the levels with new scores: rows and columns of the log, and which rows are of this group, bool."""
        _update_tube_levels(self.tube, log.score, rows, columns, in_group)
        met, missed = _close_horizons(log.horizon_pending, log.followed, log.horizon, log.exceeded, in_group)
        step = missed * NOMINAL_COVERAGE - met * (1.0 - NOMINAL_COVERAGE)
        # never below NOMINAL_COVERAGE: easy minutes, which meet any horizon, must not offset difficult ones
        self.horizon = min(max(self.horizon + _HORIZON_STEP * step, NOMINAL_COVERAGE), _MAX_LEVEL)


@_exact
def _update_tube_levels(
    level: np.ndarray, score: np.ndarray, rows: np.ndarray, columns: np.ndarray, in_group: np.ndarray
) -> None:
    """Update the levels at the knots, (13,), with new scores of this group."""
    for k in range(len(rows)):
        knot, value = KNOT_OF[columns[k]], score[rows[k], columns[k]]
        if in_group[rows[k]] and knot >= 0 and np.isfinite(value):
            level[knot] += _TUBE_STEP * _WEIGHT[knot] * ((1.0 if value > 1.0 else 0.0) - (1.0 - NOMINAL_COVERAGE))
    for knot in range(len(level)):
        level[knot] = min(max(level[knot], _MIN_LEVEL), _MAX_LEVEL)


@_exact
def _close_horizons(
    pending: np.ndarray, followed: np.ndarray, horizon: np.ndarray, exceeded: np.ndarray, in_group: np.ndarray
) -> tuple[int, int]:
    """Count the horizons of this group that were met and missed since the last call, and close them."""
    met = missed = 0
    for row in range(len(pending)):
        if in_group[row] and pending[row]:
            is_met = followed[row] >= horizon[row]
            met, missed = met + is_met, missed + (exceeded[row] and not is_met)
            pending[row] = not (is_met or exceeded[row])
    return met, missed


@dataclass(frozen=True)
class ScaleFactors:
    """Present scale factors of one group.

    Attributes:
        tube: on the table's half-axes, by knot and axis, (13, 3) [-]
        horizon: on the error ratio that determines the horizon [-]
        critical: critical factors of the horizon, and the probability of each, (2, n) [-]
        own_count: number of this aircraft's predictions behind them [-]
        bounded: a level or factor of the tube is at its upper bound, so further misses cannot widen the tube
    """

    tube: np.ndarray
    horizon: float
    critical: np.ndarray
    own_count: int
    bounded: bool = False

    def at(self, ahead: np.ndarray) -> np.ndarray:
        """Return the factor on half-axes by look-ahead, (n, 3) [-]."""
        return interpolate_rows(ahead, KNOTS, self.tube)

    def exceedance(self, ratio: float) -> float:
        """Return the probability that the relative error exceeds its limit before a running maximum of `ratio` [-]."""
        return float(self.critical[1, self.critical[0] * ratio >= ERROR_LIMIT].sum())


def scale_factors(log: PredictionLog, group: str, table: CalibrationTable, levels: AdaptiveLevels) -> ScaleFactors:
    """Compute scale factors from the table and the scores of the aircraft's own predictions of this group."""
    rows = np.flatnonzero(log.group == group)
    ratios = log.axis_score[rows] * log.factor[rows]
    age = log.evaluated_until - log.t0[rows]
    weight = np.exp(-np.clip(age, 0.0, None) / _DECAY_S)[:, None] * np.where(np.isfinite(ratios[..., 0]), _WEIGHT, 0.0)
    axis = _axis_factors(ratios, weight, table)
    scores = (ratios / axis).max(axis=2)
    tube = _joint_quantiles(table.scores, scores.T, weight.T, levels.tube)[:, None] * axis
    critical = _critical_factors(log, rows, table.risks * axis.max())
    horizon = float(weighted_quantile(critical[:1], critical[1:], np.array([levels.horizon]))[0])
    own_count = int((weight > 0).any(axis=1).sum())
    bounded = bool((levels.tube >= _MAX_LEVEL).any() or (tube >= _MAX_FACTOR).any())
    return ScaleFactors(np.clip(tube, _MIN_FACTOR, _MAX_FACTOR), horizon, critical, own_count, bounded)


def _axis_factors(ratios: np.ndarray, weight: np.ndarray, table: CalibrationTable) -> np.ndarray:
    """Return the factor of each axis, (3,): geometric mean of errors over expected ones, shrunk to 1 by the table.

    Args:
        ratios: errors over half-axes of the table, nan where unknown, (s, 13, 3) [-]
        weight: of each, 0 where unknown, (s, 13)
        table: its half-axes are `table.factor` standard deviations
    """
    expected = _MEAN_LOG_ERROR - np.log(table.factor) if table.log_score is None else np.array(table.log_score)
    excess = log_scores(np.where(weight[..., None] > 0, ratios, 1.0)) - expected
    total = np.einsum("rk,rka->a", weight, excess) / len(KNOTS)
    return np.exp(total / (weight.sum() / len(KNOTS) + _TABLE_WEIGHT))


def _joint_quantiles(atoms: np.ndarray, scores: np.ndarray, weight: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return the quantiles of each row of scores (r, n) joined with a table's atoms (20,)."""
    r = len(scores)
    x = np.hstack([np.broadcast_to(atoms, (r, ATOMS)), scores])
    return weighted_quantile(x, np.hstack([np.full((r, ATOMS), _TABLE_WEIGHT / ATOMS), weight]), level)


def _critical_factors(log: PredictionLog, rows: np.ndarray, risks: np.ndarray) -> np.ndarray:
    """Return the critical factors of table and own predictions, and the probability of each, (2, n) [-].

    The horizon factor is a quantile of them: that share of first passages then lies beyond the horizon.
    """
    followed, exceeded = log.followed[rows], log.exceeded[rows]
    x = critical_factor(log.ratio[rows], followed)
    age = np.clip(log.evaluated_until - log.t0[rows], 0.0, None)
    weight = np.where((followed > 0) | exceeded, _HORIZON_WEIGHT * np.exp(-age / _DECAY_S), 0.0)
    x, exact = np.append(risks, x), np.append(np.ones(ATOMS, bool), exceeded)
    return censored_distribution(x, np.append(np.full(ATOMS, _TABLE_WEIGHT / ATOMS), weight), exact)
