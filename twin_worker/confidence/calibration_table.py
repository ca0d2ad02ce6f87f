"""Calibration table of one group: error standard deviation and half-axes by look-ahead, from uncertainty features.

By axis sigma^2 = scale^2 s^2 + lag^2 r^2 + turn^2 d^2 + floor^2, with the ensemble spread s, the forecast revision r,
and the displacement d of an aircraft that is one along-track sigma early or late on the predicted path: across and
vertical only, and zero where the path is straight and level. Half-axes are factor sigma: all axes have the same
coverage, and `NOMINAL_COVERAGE` of the flights lie within all three at once.
"""

from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
from scipy.special import erfinv

from twin_worker.numerics.interpolation import interpolate_rows
from twin_worker.numerics.prediction_errors import AHEAD, NOMINAL_COVERAGE, displacement_along_path

KNOTS = np.array([1.0, 2, 3, 5, 8, 12, 18, 27, 40, 60, 80, 120, 180])  # look-aheads of the table rows [s]
COLUMN = np.searchsorted(AHEAD, KNOTS)  # of each in AHEAD
ATOMS = 20  # quantiles that represent a distribution, at the midpoints of equal shares
LEVELS = (np.arange(ATOMS) + 0.5) / ATOMS
INDEPENDENT = NOMINAL_COVERAGE ** (1 / 3)  # coverage of each axis where errors of the axes are independent [-]
_DEFAULT_ALONE = 0.94  # coverage of each axis by itself: measured 0.96 to 30 s, 0.94 to 60 s, 0.91 to 120 s
_GROWTH_LAW = {  # default spread along, cross, vertical: base [m], growth [m/s^power], power
    "dynamics": ((0.3, 0.3, 0.3), (0.4, 0.15, 0.15), 1.2),
    "hybrid": ((0.3, 0.3, 0.3), (0.4, 0.15, 0.15), 1.2),
    "both": ((0.3, 0.3, 0.3), (0.4, 0.15, 0.15), 1.2),
    "paper": ((0.3, 0.3, 0.3), (0.5, 0.2, 0.2), 1.3),
    "copter": ((0.3, 0.3, 0.3), (0.3, 0.1, 0.1), 1.1),
    "greybox": ((0.5, 0.4, 0.4), (0.5, 0.3, 0.2), 1.3),
    "imm": ((1.0, 1.0, 0.5), (1.6, 1.6, 0.5), 1.4),
}
_LAG_TIME_S = 10.0  # the forecast revision is not informative below about this look-ahead [s]
_MIN_SCORE = 0.01  # smaller errors over half-axes are as small as this [-]
_MAX_SPREAD_M = 1e6  # larger spreads are invalid [m]


@dataclass(frozen=True)
class CalibrationTable:
    """Calibration of one group, fitted to past flights.

    Attributes:
        group: method/law/airframe/parameters, `*` for any; the method alone for a default table
        starts, flights: number of predictions and flights it was fitted to
        scale: coefficient of the ensemble spread, by knot and axis, (13, 3) [-]
        lag: coefficient of the forecast revision, (13, 3) [-]
        turn: coefficient of the displacement along the path, zero along, (13, 3) [-]
        floor: constant part of sigma, (13, 3) [m]
        factor: from sigma to half-axes, (13, 3) [-]
        scores: largest error over its half-axis, `ATOMS` quantiles [-]
        risks: critical factors of the horizon, `ATOMS` quantiles [-]
        held_out: performance on held-out flights, by name
        alone: coverage of each half-axis by itself, `NOMINAL_COVERAGE` to its cube root [-]
        log_score: mean logarithm of errors over half-axes along, cross, vertical, as of
            `log_scores`; None: that of Student's t distribution
    """

    group: str
    starts: int
    flights: int
    scale: np.ndarray
    lag: np.ndarray
    turn: np.ndarray
    floor: np.ndarray
    factor: np.ndarray
    scores: np.ndarray
    risks: np.ndarray
    held_out: dict[str, float] = field(default_factory=dict)
    alone: float = _DEFAULT_ALONE
    log_score: tuple[float, float, float] | None = None

    def sigma(self, features: "UncertaintyFeatures", ahead: np.ndarray) -> np.ndarray:
        """Return the expected error standard deviation, extrapolated beyond the last knot, (..., n, 3) [m]."""
        scale, lag, turn, floor, _ = self._curves(ahead)
        sigma2 = (scale * features.spread) ** 2 + (lag * features.revision) ** 2 + floor**2
        displacement = displacement_along_path(features.path, np.sqrt(sigma2[..., 0]), ahead)
        return np.sqrt(sigma2 + (turn * displacement) ** 2)

    def half_axes(self, features: "UncertaintyFeatures", ahead: np.ndarray) -> np.ndarray:
        """Return the half-axes of coverage `NOMINAL_COVERAGE` at each look-ahead, (..., n, 3) [m]."""
        return self._curves(ahead)[4] * self.sigma(features, ahead)

    def _curves(self, ahead: np.ndarray) -> np.ndarray:
        """Return scale, lag, turn, floor and factor by look-ahead, (5, n, 3)."""
        n = len(ahead)
        return self._on_grid[:, :n] if np.array_equal(ahead, AHEAD[:n]) else self._interpolated(ahead)

    @cached_property
    def _on_grid(self) -> np.ndarray:
        return self._interpolated(AHEAD)

    def _interpolated(self, ahead: np.ndarray) -> np.ndarray:
        rows_by_name = self.scale, self.lag, self.turn, self.floor, self.factor
        out = np.array([at_look_aheads(ahead, rows) for rows in rows_by_name])
        out[3] *= np.maximum(ahead / KNOTS[-1], 1.0)[:, None]
        return out


@dataclass(frozen=True)
class UncertaintyFeatures:
    """Features of a prediction that predict its error.

    Attributes:
        spread: ensemble spread along, cross, vertical; `error_growth` without an ensemble, (..., n, 3) [m]
        revision: departure from the predictions made just before; the spread without any, (..., n, 3) [m]
        path: predicted positions, NED, (..., n, 3) [m]
    """

    spread: np.ndarray
    revision: np.ndarray
    path: np.ndarray


def log_scores(scores: np.ndarray) -> np.ndarray:
    """Return the logarithms of errors over half-axes; smaller ones count as `_MIN_SCORE`."""
    return np.log(np.maximum(scores, _MIN_SCORE))


def at_look_aheads(ahead: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Interpolate table rows by knot and axis, (13, 3), at look-aheads, (n, 3)."""
    return interpolate_rows(ahead, KNOTS, rows)


def error_growth(method: str, ahead: np.ndarray) -> np.ndarray:
    """Return the default spread of a method without an ensemble, (n, 3) [m]; not calibrated."""
    base, growth, power = _GROWTH_LAW.get(method, _GROWTH_LAW["greybox"])
    return np.hypot(base, np.outer(np.maximum(ahead, 0.0) ** power, growth))


def uncertainty_features(
    spread: np.ndarray | None, revision: np.ndarray | None, path: np.ndarray, method: str, ahead: np.ndarray
) -> UncertaintyFeatures:
    """Return the features of a prediction, with `error_growth` where the spread is absent or invalid."""
    complete = _fill_invalid(spread, error_growth(method, ahead))
    return UncertaintyFeatures(complete, _fill_invalid(revision, complete), path)


def _fill_invalid(values: np.ndarray | None, default: np.ndarray) -> np.ndarray:
    if values is None:
        return default
    return np.where(np.isfinite(values) & (values >= 0) & (values < _MAX_SPREAD_M), values, default)


@lru_cache(maxsize=32)
def default_table(method: str) -> CalibrationTable:
    """Return the table of a method without calibration flights: never narrower than `error_growth`."""
    law = error_growth(method, KNOTS)
    shape = np.sqrt(2.0) * erfinv(np.cbrt(LEVELS))  # the largest of three normal errors
    shape = shape / np.interp(NOMINAL_COVERAGE, LEVELS, shape)
    lag = np.tile((KNOTS / (KNOTS + _LAG_TIME_S))[:, None], 3)
    turn = np.tile([0.0, 1.0, 1.0], (len(KNOTS), 1))
    factor = np.full_like(law, 2.0)
    return CalibrationTable(method, 0, 0, np.ones_like(law), lag, turn, law, factor, shape, shape, alone=INDEPENDENT)
