"""Adapt tube and horizon to one aircraft by the scores of its own past predictions.

The factor on a table's half-axes is a quantile of the aircraft's own scores; the table counts as a few more scores.
The quantile level rises at each miss and falls a little at each hit, within bounds. Short look-aheads are scored
first; their common factor also scales the longer ones.

Coverage is not guaranteed. The long-run coverage of the source requires unbounded levels and an infinite region from
level 1 on, but a published region must be finite. An aircraft whose errors exceed all errors in the table is therefore
covered less. `Confidence.sentence` reports a bound that is met; the measured coverage is published too.

Source: Gibbs & Candes 2021, "Adaptive conformal inference under distribution shift", proposition 4.1.
"""

from dataclasses import dataclass, field

import numba as nb
import numpy as np

from twin_worker.confidence.calibration_table import ATOMS, COLUMN, KNOTS, CalibrationTable
from twin_worker.confidence.prediction_log import EVERY_S, PredictionLog
from twin_worker.confidence.weighted_quantile import censored_quantile, critical_factor, weighted_quantile
from twin_worker.numerics.prediction_errors import AHEAD, NOMINAL_COVERAGE

_TABLE_WEIGHT = 10.0  # independent predictions that the table counts as [-]
_DECAY_S = 400.0  # time constant of the weight of a score [s]
_WEIGHT = np.minimum(1.0, EVERY_S / (0.5 * KNOTS))  # weight of a score; scores of overlapping predictions correlate [-]
_HORIZON_WEIGHT = EVERY_S / 30.0  # weight of a first passage [-]
_TUBE_STEP, _HORIZON_STEP = 0.05, 0.02  # of the level, per independent miss [-]
_MIN_LEVEL, _MAX_LEVEL = 0.5, 0.99
_COLUMN_OF = np.full(len(AHEAD), -1)
_COLUMN_OF[COLUMN] = np.arange(len(KNOTS))
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
        knot, value = _COLUMN_OF[columns[k]], score[rows[k], columns[k]]
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
        tube: on the table's half-axes, by knot, (13,) [-]
        horizon: on the error ratio that determines the horizon [-]
        own_count: number of this aircraft's predictions behind them [-]
        bounded: a level or factor of the tube is at its upper bound, so further misses cannot widen the tube
    """

    tube: np.ndarray
    horizon: float
    own_count: int
    bounded: bool = False

    def at(self, ahead: np.ndarray) -> np.ndarray:
        """Return the factor on half-axes by look-ahead, (n,) [-]."""
        return np.interp(ahead, KNOTS, self.tube)


def scale_factors(log: PredictionLog, group: str, table: CalibrationTable, levels: AdaptiveLevels) -> ScaleFactors:
    """Compute scale factors from the table and the scores of the aircraft's own predictions of this group."""
    rows = np.flatnonzero(log.group == group)
    scores = log.score[np.ix_(rows, COLUMN)] * log.factor[rows]
    age = log.evaluated_until - log.t0[rows]
    weight = np.exp(-np.clip(age, 0.0, None) / _DECAY_S)[:, None] * np.where(np.isfinite(scores), _WEIGHT, 0.0)
    level = np.array([levels.tube.mean()])
    pooled = _joint_quantiles(table.scores, scores.reshape(1, -1), weight.reshape(1, -1) / len(KNOTS), level)[0]
    tube = _joint_quantiles(table.scores * pooled, scores.T, weight.T, levels.tube)
    horizon = _horizon_factor(log, rows, table.risks * pooled, levels.horizon)
    own_count = int((weight > 0).any(axis=1).sum())
    bounded = bool((levels.tube >= _MAX_LEVEL).any() or (tube >= _MAX_FACTOR).any())
    return ScaleFactors(np.clip(tube, _MIN_FACTOR, _MAX_FACTOR), horizon, own_count, bounded)


def _joint_quantiles(atoms: np.ndarray, scores: np.ndarray, weight: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return the quantiles of each row of scores (r, n) joined with a table's atoms (20,)."""
    r = len(scores)
    x = np.hstack([np.broadcast_to(atoms, (r, ATOMS)), scores])
    return weighted_quantile(x, np.hstack([np.full((r, ATOMS), _TABLE_WEIGHT / ATOMS), weight]), level)


def _horizon_factor(log: PredictionLog, rows: np.ndarray, risks: np.ndarray, level: float) -> float:
    """Return the factor at which a share `level` of first passages lies beyond the horizon."""
    followed, exceeded = log.followed[rows], log.exceeded[rows]
    x = critical_factor(log.ratio[rows], followed)
    age = np.clip(log.evaluated_until - log.t0[rows], 0.0, None)
    weight = np.where((followed > 0) | exceeded, _HORIZON_WEIGHT * np.exp(-age / _DECAY_S), 0.0)
    x, exact = np.append(risks, x), np.append(np.ones(ATOMS, bool), exceeded)
    return censored_quantile(x, np.append(np.full(ATOMS, _TABLE_WEIGHT / ATOMS), weight), exact, level)
