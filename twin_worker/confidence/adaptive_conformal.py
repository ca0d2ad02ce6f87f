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

from twin_worker.confidence.calibration_table import ATOMS, COLUMN, KNOTS, Table
from twin_worker.confidence.horizon_risk import critical
from twin_worker.confidence.prediction_log import EVERY_S, Ledger
from twin_worker.confidence.weighted_quantile import censored_quantile, weighted_quantile
from twin_worker.numerics.prediction_errors import AHEAD, QUANTILE

_TABLE = 10.0  # independent predictions that the table counts as [-]
_FADES_S = 400.0  # time constant of the weight of a score [s]
_SHARE = np.minimum(1.0, EVERY_S / (0.5 * KNOTS))  # weight of a score; scores of overlapping predictions correlate [-]
_SHARE_HORIZON = EVERY_S / 30.0  # weight of a first passage [-]
_TUBE_STEP, _HORIZON_STEP = 0.05, 0.02  # of the level, per independent miss [-]
_LEAST_LEVEL, _MOST_LEVEL = 0.5, 0.99
_COLUMN_OF = np.full(len(AHEAD), -1)
_COLUMN_OF[COLUMN] = np.arange(len(KNOTS))
_LEAST_FACTOR, _MOST_FACTOR = 0.1, 20.0
_exact = nb.njit(cache=True, nogil=True, _nrt=False)  # type: ignore[call-overload]  # no fastmath: results equal numpy's


@dataclass
class Levels:
    """Present quantile levels of one group: of the tube at each knot, and of the horizon."""

    tube: np.ndarray = field(default_factory=lambda: np.full(len(KNOTS), QUANTILE))
    horizon: float = QUANTILE

    def learn(self, ledger: Ledger, r: np.ndarray, j: np.ndarray, mine: np.ndarray) -> None:
        """Update the levels with new scores: rows and columns of the log, and which rows are of this group, bool."""
        _learn_tube(self.tube, ledger.score, r, j, mine)
        held, failed = _settle_claims(ledger.claimed, ledger.followed, ledger.horizon, ledger.passed, mine)
        moved = failed * QUANTILE - held * (1.0 - QUANTILE)
        # never below NOMINAL_COVERAGE: easy minutes, which meet any horizon, must not offset difficult ones
        self.horizon = min(max(self.horizon + _HORIZON_STEP * moved, QUANTILE), _MOST_LEVEL)


@_exact
def _learn_tube(level: np.ndarray, score: np.ndarray, r: np.ndarray, j: np.ndarray, mine: np.ndarray) -> None:
    """Update the levels at the knots, (13,), with new scores of this group."""
    for k in range(len(r)):
        knot, value = _COLUMN_OF[j[k]], score[r[k], j[k]]
        if mine[r[k]] and knot >= 0 and np.isfinite(value):
            level[knot] += _TUBE_STEP * _SHARE[knot] * ((1.0 if value > 1.0 else 0.0) - (1.0 - QUANTILE))
    for knot in range(len(level)):
        level[knot] = min(max(level[knot], _LEAST_LEVEL), _MOST_LEVEL)


@_exact
def _settle_claims(
    claimed: np.ndarray, followed: np.ndarray, horizon: np.ndarray, passed: np.ndarray, mine: np.ndarray
) -> tuple[int, int]:
    """Count the horizons of this group that were met and missed since the last call, and close them."""
    held = failed = 0
    for r in range(len(claimed)):
        if mine[r] and claimed[r]:
            holds = followed[r] >= horizon[r]
            held, failed = held + holds, failed + (passed[r] and not holds)
            claimed[r] = not (holds or passed[r])
    return held, failed


@dataclass(frozen=True)
class Factors:
    """Present scale factors of one group.

    Attributes:
        tube: on the table's half-axes, by knot, (13,) [-]
        horizon: on the error ratio that determines the horizon [-]
        own_count: number of this aircraft's predictions behind them [-]
        bounded: a level or factor of the tube is at its upper bound, so further misses cannot widen the tube
    """

    tube: np.ndarray
    horizon: float
    own: int
    bounded: bool = False

    def at(self, ahead: np.ndarray) -> np.ndarray:
        """Return the factor on half-axes by look-ahead, (n,) [-]."""
        return np.interp(ahead, KNOTS, self.tube)


def factors(ledger: Ledger, group: str, table: Table, levels: Levels) -> Factors:
    """Compute scale factors from the table and the scores of the aircraft's own predictions of this group."""
    rows = np.flatnonzero(ledger.group == group)
    scores = ledger.score[np.ix_(rows, COLUMN)] * ledger.factor[rows]
    age = ledger.until - ledger.t0[rows]
    weight = np.exp(-np.clip(age, 0.0, None) / _FADES_S)[:, None] * np.where(np.isfinite(scores), _SHARE, 0.0)
    level = np.array([levels.tube.mean()])
    pooled = _join(table.scores, scores.reshape(1, -1), weight.reshape(1, -1) / len(KNOTS), level)[0]
    tube = _join(table.scores * pooled, scores.T, weight.T, levels.tube)
    horizon = _horizon(ledger, rows, table.risks * pooled, levels.horizon)
    own = int((weight > 0).any(axis=1).sum())
    bounded = bool((levels.tube >= _MOST_LEVEL).any() or (tube >= _MOST_FACTOR).any())
    return Factors(np.clip(tube, _LEAST_FACTOR, _MOST_FACTOR), horizon, own, bounded)


def _join(atoms: np.ndarray, scores: np.ndarray, weight: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return the quantiles of each row of scores (r, n) joined with a table's atoms (20,)."""
    r = len(scores)
    x = np.hstack([np.broadcast_to(atoms, (r, ATOMS)), scores])
    return weighted_quantile(x, np.hstack([np.full((r, ATOMS), _TABLE / ATOMS), weight]), level)


def _horizon(ledger: Ledger, rows: np.ndarray, risks: np.ndarray, level: float) -> float:
    """Return the factor at which a share `level` of first passages lies beyond the horizon."""
    followed, passed = ledger.followed[rows], ledger.passed[rows]
    x = critical(ledger.ratio[rows], followed)
    age = np.clip(ledger.until - ledger.t0[rows], 0.0, None)
    weight = np.where((followed > 0) | passed, _SHARE_HORIZON * np.exp(-age / _FADES_S), 0.0)
    x, exact = np.append(risks, x), np.append(np.ones(ATOMS, bool), passed)
    return censored_quantile(x, np.append(np.full(ATOMS, _TABLE / ATOMS), weight), exact, level)
