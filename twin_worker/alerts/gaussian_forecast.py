"""Prediction as Gaussian positions on a time grid common to all aircraft, the input of all alerts.

The tube contains `quantile` q of flights within all three half-axes (along, cross, vertical) at once; it is a box, not
an ellipsoid. The coverage L of each axis by itself depends on the correlation of the axes and is measured in the
calibration of the tube (`axis_quantile`). A half-axis is then z standard deviations of a normal error:

    z = Phi^-1((1 + L) / 2),    q <= L <= q^(1/3):  1.64 for fully dependent axes, 2.11 for independent ones

for q = 0.9. Without a measurement the axes count as independent, which is the upper bound: the coverage of a box of
normal errors is at least the product of the coverages of its axes, for any correlation.
Source: Sidak 1967, "Rectangular confidence regions for the means of multivariate normal distributions".

The error of one prediction is one draw for its whole length (an aircraft that is late stays late), rotated from along
and cross to NED by the path direction at each time. The covariance grows with the look-ahead, so distant positions
contribute little and need no cut-off horizon.
"""

from functools import lru_cache
from math import ceil, floor, isfinite
from typing import NamedTuple

import numba as nb
import numpy as np
from scipy.stats import norm, qmc

from fleet.contract import Prediction
from fleet.frames import Origin, to_geodetic
from twin_worker.numerics.interpolation import interpolate_rows
from twin_worker.numerics.prediction_errors import track_frame

STEP = 2.0  # grid in fleet time, the same for all: instants k STEP [s since 1970]
MAX_AHEAD_S = 180.0  # longest look-ahead used [s]
DRAWS = norm.ppf(qmc.Sobol(3, scramble=True, seed=5).random(128))  # quasi-random normal errors, (128, 3) [-]
_MAX_DISTANCE = 1e6  # positions farther from their origin are invalid [m]
_MIN_SIGMA = 0.1  # minimum standard deviation [m]


class GaussianForecast(NamedTuple):
    """A validated prediction on the common grid."""

    prediction: Prediction
    first: int  # instant of the first row, in steps since 1970
    path: np.ndarray  # mean position, NED from the prediction's origin, (n, 3) [m]
    along: np.ndarray  # direction of the path, horizontal unit vector, (n, 2)
    sigma: np.ndarray  # standard deviations along, cross, vertical, (n, 3) [m]

    @property
    def t(self) -> np.ndarray:
        """Return the instants, (n,) [s since 1970]."""
        return STEP * (self.first + np.arange(len(self.path)))

    def covariance(self) -> np.ndarray:
        """Return nn, ne, ee of the horizontal covariance and the vertical variance, (n, 4) [m2]."""
        c, s = self.along.T
        a, b, vertical = self.sigma.T**2
        return np.column_stack([a * c * c + b * s * s, (a - b) * c * s, a * s * s + b * c * c, vertical])

    def draws(self, until: float = np.inf) -> np.ndarray:
        """Return 128 equally probable paths up to an instant [s since 1970], NED, (128, k, 3) [m]."""
        k = max(int(np.searchsorted(self.t, until, side="right")), 1)
        e = DRAWS[:, None, :] * self.sigma[:k]
        c, s = self.along[:k].T
        error = [e[..., 0] * c - e[..., 1] * s, e[..., 0] * s + e[..., 1] * c, e[..., 2]]
        return self.path[:k] + np.stack(error, axis=-1)

    def position(self, k: int) -> Origin:
        """Return the mean position at row `k`."""
        return Origin(*map(int, to_geodetic(self.prediction.ned_origin(), self.path[k])))


@lru_cache(maxsize=64)
def axis_z(quantile: float, axis_quantile: float = 0.0) -> float:
    """Return the half-axis of a tube of coverage `quantile`, in standard deviations of one axis.

    Args:
        quantile: joint coverage of all three half-axes
        axis_quantile: coverage of each half-axis; a value out of range, such as 0, means independent axes
    """
    independent = quantile ** (1 / 3)
    return float(norm.ppf((1 + (axis_quantile if quantile <= axis_quantile < independent else independent)) / 2))


def to_gaussian(prediction: Prediction) -> GaussianForecast | None:
    """Validate a prediction and interpolate it on the common grid; None if it is invalid or too short."""
    try:
        ahead, path, tube = (
            array.numpy().astype(float)
            for array in (prediction.ahead, prediction.path, prediction.prediction_region_half_axes)
        )
    except ValueError:
        return None
    if not _is_valid(prediction, ahead, path, tube):
        return None
    t = prediction.t + ahead
    first, last = ceil(t[0] / STEP), floor(min(t[-1], t[0] + MAX_AHEAD_S) / STEP)
    if last < first:
        return None
    grid = STEP * np.arange(first, last + 1)
    mean = interpolate_rows(grid, t, path)
    sigma = np.maximum(
        interpolate_rows(grid, t, tube) / axis_z(prediction.quantile, prediction.axis_quantile), _MIN_SIGMA
    )
    along = track_frame(mean, grid - grid[0]) if len(grid) > 1 else np.array([[1.0, 0.0]])
    return GaussianForecast(prediction, first, mean, along, sigma)


def _is_valid(prediction: Prediction, ahead: np.ndarray, path: np.ndarray, tube: np.ndarray) -> bool:
    """Return whether times rise, shapes agree, numbers are finite and the origin is a valid position."""
    n = len(ahead) if ahead.ndim == 1 else 0
    if n < 1 or path.shape != (n, 3) or tube.shape != (n, 3):
        return False
    lat, lon, alt = prediction.origin
    return bool(
        0 < prediction.t < 4e9
        and 0 < prediction.quantile < 1
        and isfinite(prediction.quantile)
        and _rises_within_limits(ahead, path, tube)
        and abs(lat) < 8.9e8
        and abs(lon) <= 1.8e9
        and abs(alt) <= 1e8
    )


@nb.njit(cache=True, nogil=True, _nrt=False)  # type: ignore[call-overload]  # no fastmath: comparisons are false for nan
def _rises_within_limits(ahead: np.ndarray, path: np.ndarray, tube: np.ndarray) -> bool:
    """Return whether look-aheads, (n,), are finite and rise, and positions and half-axes, (n, 3), are plausible."""
    for k in range(len(ahead)):
        if not abs(ahead[k]) < np.inf or (k > 0 and not ahead[k] > ahead[k - 1]):
            return False
        for j in range(3):
            if not abs(path[k, j]) < _MAX_DISTANCE or not 0.0 <= tube[k, j] < _MAX_DISTANCE:
                return False
    return True
