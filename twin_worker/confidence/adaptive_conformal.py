"""Adapt tube and horizon to one aircraft by what became of its own past predictions.

The factor on a table's half-axes is a quantile of the aircraft's own scores, the table counting as a few more of
them; its level moves up at each miss and down a little at each hit, within bounds. Short look-aheads are answered
first: what they say in common moves the longer ones too.

No coverage is guaranteed. The long-run share of the source holds for levels without bounds whose region is infinite
from level 1 on; a region that is published must be finite. So an aircraft whose errors outgrow all that was seen is
covered less, which `Trust.sentence` says while a bound is met; `Prediction.held` publishes the measured share.

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

_TABLE = 10.0  # independent predictions the table counts as [-]
_FADES_S = 400.0  # scores fade with age [s]
_SHARE = np.minimum(1.0, EVERY_S / (0.5 * KNOTS))  # independent predictions one counts as: overlapping ones agree [-]
_SHARE_HORIZON = EVERY_S / 30.0  # the same for a first passage [-]
_TUBE_STEP, _HORIZON_STEP = 0.05, 0.02  # of the level, per independent miss [-]
_LEAST_LEVEL, _MOST_LEVEL = 0.5, 0.99
_COLUMN_OF = np.full(len(AHEAD), -1)
_COLUMN_OF[COLUMN] = np.arange(len(KNOTS))
_LEAST_FACTOR, _MOST_FACTOR = 0.1, 20.0
_exact = nb.njit(cache=True, nogil=True, _nrt=False)  # type: ignore[call-overload]  # no fastmath: as numpy does it


@dataclass
class Levels:
    """Quantiles that the tube at each knot and the horizon of one group take now."""

    tube: np.ndarray = field(default_factory=lambda: np.full(len(KNOTS), QUANTILE))
    horizon: float = QUANTILE

    def learn(self, ledger: Ledger, r: np.ndarray, j: np.ndarray, mine: np.ndarray) -> None:
        """Take new answers: rows and columns of the ledger, and which rows are of this group, bool."""
        _learn_tube(self.tube, ledger.score, r, j, mine)
        held, failed = _settle_claims(ledger.claimed, ledger.followed, ledger.horizon, ledger.passed, mine)
        moved = failed * QUANTILE - held * (1.0 - QUANTILE)
        # never below: easy minutes, which hold whatever is claimed, must not pay for hard ones
        self.horizon = min(max(self.horizon + _HORIZON_STEP * moved, QUANTILE), _MOST_LEVEL)


@_exact
def _learn_tube(level: np.ndarray, score: np.ndarray, r: np.ndarray, j: np.ndarray, mine: np.ndarray) -> None:
    """Move the levels at the knots, (13,), by new answers of this group."""
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
    """Return how many horizons of this group have held and how many have failed since, and claim them no longer."""
    held = failed = 0
    for r in range(len(claimed)):
        if mine[r] and claimed[r]:
            holds = followed[r] >= horizon[r]
            held, failed = held + holds, failed + (passed[r] and not holds)
            claimed[r] = not (holds or passed[r])
    return held, failed


@dataclass(frozen=True)
class Factors:
    """Factors in force for one group now.

    Attributes:
        tube: on the table's half-axes, by knot, (13,) [-]
        horizon: on the largest half-axes, where the horizon is sought [-]
        own: predictions of this aircraft behind them [-]
        bounded: a level or factor of the tube stands at its upper bound: misses cannot widen the tube as they should
    """

    tube: np.ndarray
    horizon: float
    own: int
    bounded: bool = False

    def at(self, ahead: np.ndarray) -> np.ndarray:
        """Return the factor on half-axes by look-ahead, (n,) [-]."""
        return np.interp(ahead, KNOTS, self.tube)


def factors(ledger: Ledger, group: str, table: Table, levels: Levels) -> Factors:
    """Join the table with what the aircraft's own predictions of this group came to."""
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
    """Return quantiles of the rows of scores (r, n), a table's atoms (20,) among them."""
    r = len(scores)
    x = np.hstack([np.broadcast_to(atoms, (r, ATOMS)), scores])
    return weighted_quantile(x, np.hstack([np.full((r, ATOMS), _TABLE / ATOMS), weight]), level)


def _horizon(ledger: Ledger, rows: np.ndarray, risks: np.ndarray, level: float) -> float:
    """Return the factor that keeps the wanted share of first passages behind the horizon."""
    followed, passed = ledger.followed[rows], ledger.passed[rows]
    x = critical(ledger.ratio[rows], followed)
    age = np.clip(ledger.until - ledger.t0[rows], 0.0, None)
    weight = np.where((followed > 0) | passed, _SHARE_HORIZON * np.exp(-age / _FADES_S), 0.0)
    x, exact = np.append(risks, x), np.append(np.ones(ATOMS, bool), passed)
    return censored_quantile(x, np.append(np.full(ATOMS, _TABLE / ATOMS), weight), exact, level)
