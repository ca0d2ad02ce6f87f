"""Calibration tables: how large errors were beside what an ensemble said, by look-ahead, of one group of flights.

sigma^2 = scale^2 s^2 + floor^2 by axis; half-axes = factor sigma, of which each axis misses as
often as another, hold `QUANTILE` of the flights at each look-ahead, all three at once.
"""

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from scipy.special import erfinv

from twin_worker.calibration.miss import AHEAD, QUANTILE

KNOTS = np.array([1.0, 2, 3, 5, 8, 12, 18, 27, 40, 60, 80, 120, 180])  # look-aheads that tables are written at [s]
COLUMN = np.searchsorted(AHEAD, KNOTS)  # of each in AHEAD
ATOMS = 20  # values a distribution is written as, in the middles of as many equal shares
LEVELS = (np.arange(ATOMS) + 0.5) / ATOMS
_LAW = {  # expected spread of along, cross, vertical: base [m], growth [m/s^power], power
    "dynamics": ((1.0, 0.8, 0.6), (0.4, 0.15, 0.15), 1.2),
    "hybrid": ((1.0, 0.8, 0.6), (0.4, 0.15, 0.15), 1.2),
    "both": ((1.0, 0.8, 0.6), (0.4, 0.15, 0.15), 1.2),
    "paper": ((1.0, 0.8, 0.6), (0.5, 0.2, 0.2), 1.3),
    "copter": ((1.0, 0.8, 0.6), (0.3, 0.1, 0.1), 1.1),
    "greybox": ((1.5, 1.0, 1.0), (0.5, 0.3, 0.2), 1.3),
    "imm": ((2.0, 2.0, 1.0), (1.6, 1.6, 0.5), 1.4),
}
_MOST_M = 1e6  # spreads beyond are noise [m]


@dataclass(frozen=True)
class Table:
    """What past flights of one group taught.

    Attributes:
        group: method/law/airframe/parameters, `*` for any; the method alone where no flight taught anything
        starts, flights: predictions and flights behind it
        scale: share of the ensemble's spread, by knot and axis, (13, 3) [-]
        floor: what the ensemble does not know of, (13, 3) [m]
        factor: from sigma to half-axes, (13, 3) [-]
        scores: largest error over its half-axis, `ATOMS` quantiles [-]
        risks: critical factors of the horizon, `ATOMS` quantiles [-]
        held_out: what it did on flights left out of it, by name
    """

    group: str
    starts: int
    flights: int
    scale: np.ndarray
    floor: np.ndarray
    factor: np.ndarray
    scores: np.ndarray
    risks: np.ndarray
    held_out: dict[str, float] = field(default_factory=dict)

    def sigma(self, spread: np.ndarray, ahead: np.ndarray) -> np.ndarray:
        """Give what errors to expect by the spread of an ensemble, growing beyond the last knot, (..., n, 3) [m]."""
        beyond = np.maximum(ahead / KNOTS[-1], 1.0)[:, None]
        return np.hypot(_at(ahead, self.scale) * spread, _at(ahead, self.floor) * beyond)

    def half_axes(self, spread: np.ndarray, ahead: np.ndarray) -> np.ndarray:
        """Give the half-axes that held `QUANTILE` of these flights in each look-ahead, (..., n, 3) [m]."""
        return _at(ahead, self.factor) * self.sigma(spread, ahead)


def _at(ahead: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Interpolate what is written by knot and axis, (13, 3), at look-aheads, (n, 3)."""
    return np.column_stack([np.interp(ahead, KNOTS, column) for column in rows.T])


def law_of_growth(method: str, ahead: np.ndarray) -> np.ndarray:
    """Give the spread a method stands in for where no ensemble says any, (n, 3) [m]; a guess, before any flight."""
    base, growth, power = _LAW.get(method, _LAW["greybox"])
    return np.hypot(base, np.outer(np.maximum(ahead, 0.0) ** power, growth))


def filled(spread: np.ndarray | None, method: str, ahead: np.ndarray) -> np.ndarray:
    """Give the spread (..., n, 3) [m], by the law of growth where an ensemble gave none or nonsense."""
    law = law_of_growth(method, ahead)
    if spread is None:
        return law
    return np.where(np.isfinite(spread) & (spread >= 0) & (spread < _MOST_M), spread, law)


@lru_cache(maxsize=32)
def untaught(method: str) -> Table:
    """Give the table of a method no flight has taught anything: never narrower than its law of growth."""
    law = law_of_growth(method, KNOTS)
    shape = np.sqrt(2.0) * erfinv(np.cbrt(LEVELS))  # the largest of three normal errors
    shape = shape / np.interp(QUANTILE, LEVELS, shape)
    return Table(method, 0, 0, np.ones_like(law), law, np.full_like(law, 2.0), shape, shape)
