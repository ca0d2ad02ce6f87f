"""Calibration tables: how large errors were beside what was known of them before, by look-ahead, of one group.

By axis sigma^2 = scale^2 s^2 + lag^2 r^2 + floor^2, of the spread s of an ensemble and the revision r. Half-axes are
factor sigma: each axis misses as often as another, and `QUANTILE` of the flights lie within all three at once.
"""

from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
from scipy.special import erfinv

from twin_worker.numerics.interpolation import straight
from twin_worker.numerics.prediction_errors import AHEAD, QUANTILE

KNOTS = np.array([1.0, 2, 3, 5, 8, 12, 18, 27, 40, 60, 80, 120, 180])  # look-aheads that tables are written at [s]
COLUMN = np.searchsorted(AHEAD, KNOTS)  # of each in AHEAD
ATOMS = 20  # values a distribution is written as, in the middles of as many equal shares
LEVELS = (np.arange(ATOMS) + 0.5) / ATOMS
INDEPENDENT = QUANTILE ** (1 / 3)  # share that each axis alone holds where errors of the axes are independent [-]
_LAW = {  # expected spread of along, cross, vertical: base [m], growth [m/s^power], power
    "dynamics": ((0.3, 0.3, 0.3), (0.4, 0.15, 0.15), 1.2),
    "hybrid": ((0.3, 0.3, 0.3), (0.4, 0.15, 0.15), 1.2),
    "both": ((0.3, 0.3, 0.3), (0.4, 0.15, 0.15), 1.2),
    "paper": ((0.3, 0.3, 0.3), (0.5, 0.2, 0.2), 1.3),
    "copter": ((0.3, 0.3, 0.3), (0.3, 0.1, 0.1), 1.1),
    "greybox": ((0.5, 0.4, 0.4), (0.5, 0.3, 0.2), 1.3),
    "imm": ((1.0, 1.0, 0.5), (1.6, 1.6, 0.5), 1.4),
}
_SOON_S = 10.0  # how far predictions just before missed says little of less than this [s]
_MOST_M = 1e6  # spreads beyond are noise [m]


@dataclass(frozen=True)
class Table:
    """What past flights of one group taught.

    Attributes:
        group: method/law/airframe/parameters, `*` for any; the method alone where no flight taught anything
        starts, flights: predictions and flights behind it
        scale: share of the ensemble's spread, by knot and axis, (13, 3) [-]
        lag: share of the departure from predictions made just before, (13, 3) [-]
        floor: what neither knows of, (13, 3) [m]
        factor: from sigma to half-axes, (13, 3) [-]
        scores: largest error over its half-axis, `ATOMS` quantiles [-]
        risks: critical factors of the horizon, `ATOMS` quantiles [-]
        held_out: what it did on flights left out of it, by name
        alone: share of the errors that the half-axis of each axis alone holds, `QUANTILE` to its cube root [-]
    """

    group: str
    starts: int
    flights: int
    scale: np.ndarray
    lag: np.ndarray
    floor: np.ndarray
    factor: np.ndarray
    scores: np.ndarray
    risks: np.ndarray
    held_out: dict[str, float] = field(default_factory=dict)
    alone: float = INDEPENDENT

    def sigma(self, doubt: "Doubt", ahead: np.ndarray) -> np.ndarray:
        """Return what errors to expect, growing beyond the last knot, (..., n, 3) [m]."""
        scale, lag, floor, _ = self._curves(ahead)
        return np.sqrt((scale * doubt.spread) ** 2 + (lag * doubt.revision) ** 2 + floor**2)

    def half_axes(self, doubt: "Doubt", ahead: np.ndarray) -> np.ndarray:
        """Return the half-axes that held `QUANTILE` of these flights in each look-ahead, (..., n, 3) [m]."""
        return self._curves(ahead)[3] * self.sigma(doubt, ahead)

    def _curves(self, ahead: np.ndarray) -> np.ndarray:
        """Return scale, lag, floor and factor by look-ahead, (4, n, 3)."""
        n = len(ahead)
        return self._usual[:, :n] if np.array_equal(ahead, AHEAD[:n]) else self._drawn(ahead)

    @cached_property
    def _usual(self) -> np.ndarray:
        return self._drawn(AHEAD)

    def _drawn(self, ahead: np.ndarray) -> np.ndarray:
        out = np.array([at_look_aheads(ahead, rows) for rows in (self.scale, self.lag, self.floor, self.factor)])
        out[2] *= np.maximum(ahead / KNOTS[-1], 1.0)[:, None]
        return out


@dataclass(frozen=True)
class Doubt:
    """What is known of the error of predictions before it happens.

    Attributes:
        spread: of an ensemble along, cross, vertical, the law of growth where there was none, (..., n, 3) [m]
        revision: departure from the predictions made just before, the spread where there were none, (..., n, 3) [m]
    """

    spread: np.ndarray
    revision: np.ndarray


def at_look_aheads(ahead: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Interpolate what is written by knot and axis, (13, 3), at look-aheads, (n, 3)."""
    return straight(ahead, KNOTS, rows)


def law_of_growth(method: str, ahead: np.ndarray) -> np.ndarray:
    """Return the spread a method stands in for where no ensemble says any, (n, 3) [m]; a guess, before any flight."""
    base, growth, power = _LAW.get(method, _LAW["greybox"])
    return np.hypot(base, np.outer(np.maximum(ahead, 0.0) ** power, growth))


def doubt_of(spread: np.ndarray | None, revision: np.ndarray | None, method: str, ahead: np.ndarray) -> Doubt:
    """Return the doubt (..., n, 3) of a prediction, by the law of growth where an ensemble gave none or nonsense."""
    whole = _filled(spread, law_of_growth(method, ahead))
    return Doubt(whole, _filled(revision, whole))


def _filled(values: np.ndarray | None, otherwise: np.ndarray) -> np.ndarray:
    if values is None:
        return otherwise
    return np.where(np.isfinite(values) & (values >= 0) & (values < _MOST_M), values, otherwise)


@lru_cache(maxsize=32)
def untaught(method: str) -> Table:
    """Return the table of a method no flight has taught anything: never narrower than its law of growth."""
    law = law_of_growth(method, KNOTS)
    shape = np.sqrt(2.0) * erfinv(np.cbrt(LEVELS))  # the largest of three normal errors
    shape = shape / np.interp(QUANTILE, LEVELS, shape)
    lag = np.tile((KNOTS / (KNOTS + _SOON_S))[:, None], 3)
    return Table(method, 0, 0, np.ones_like(law), lag, law, np.full_like(law, 2.0), shape, shape)
