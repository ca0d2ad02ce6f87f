"""One prediction as what alerts are judged on: Gaussian positions on a grid of times that all aircraft share.

The tube holds `quantile` q of flights within all three half-axes (along, cross, vertical) at once; it is a box, not an
ellipsoid. How much each axis alone holds, L, depends on how errors of the axes go together and is measured where the
tube is calibrated (`axis_quantile`). A half-axis is then z standard deviations of a normal error:

    z = Phi^-1((1 + L) / 2),    q <= L <= q^(1/3):  1.64 where all axes err at once, 2.11 where they are independent

for q = 0.9. Without a measurement they count as independent, the upper bound: for normal errors of whatever correlation
a box holds no less than the product of what its axes hold.
Source: Sidak 1967, "Rectangular confidence regions for the means of multivariate normal distributions".

Errors of one prediction are taken as one draw for its whole length (an aircraft that is late stays late), along and
cross turned to NED by the direction of the path at each time. The covariance grows with the look-ahead, so what is far
ahead weighs little by itself and no horizon cuts it off.
"""

from functools import lru_cache
from math import ceil, floor, isfinite
from typing import NamedTuple

import numba as nb
import numpy as np
from scipy.stats import norm, qmc

from fleet.contract import Prediction
from fleet.frames import Origin, to_geodetic
from twin_worker.confidence.tube_and_horizon import track_frame
from twin_worker.numerics.interpolation import straight

STEP = 2.0  # grid in fleet time, the same for all: instants k STEP [s since 1970]
LONGEST_S = 180.0  # of a prediction that is judged [s]
DRAWS = norm.ppf(qmc.Sobol(3, scramble=True, seed=5).random(128))  # evenly spread normal errors, (128, 3) [-]
_MOST = 1e6  # places farther from their own origin are noise [m]
_LEAST = 0.1  # standard deviations are never smaller [m]


class Forecast(NamedTuple):
    """A prediction, checked, on the common grid."""

    made: Prediction
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
        out = np.empty((len(self.path), 4))
        _turned(self.along, self.sigma, out)
        return out

    def draws(self, until: float = np.inf) -> np.ndarray:
        """Return 128 equally probable flights up to an instant [s since 1970], NED, (128, k, 3) [m]."""
        k = max(int(np.searchsorted(self.t, until, side="right")), 1)
        e = DRAWS[:, None, :] * self.sigma[:k]
        c, s = self.along[:k].T
        error = [e[..., 0] * c - e[..., 1] * s, e[..., 0] * s + e[..., 1] * c, e[..., 2]]
        return self.path[:k] + np.stack(error, axis=-1)

    def place(self, k: int) -> Origin:
        """Return the mean position at row `k`."""
        return Origin(*map(int, to_geodetic(self.made.ned_origin(), self.path[k])))


@lru_cache(maxsize=64)
def axis_z(quantile: float, alone: float = 0.0) -> float:
    """Return the half-axis of a tube that holds `quantile`, in standard deviations of one axis.

    Args:
        quantile: share that all three half-axes hold at once
        alone: share that each of them alone holds; beyond what is possible, as 0, the axes count as independent
    """
    independent = quantile ** (1 / 3)
    return float(norm.ppf((1 + (alone if quantile <= alone < independent else independent)) / 2))


def forecast(made: Prediction) -> Forecast | None:
    """Check a prediction and lay it on the common grid; None where it cannot be judged."""
    try:
        ahead, path, tube = (array.numpy().astype(float) for array in (made.ahead, made.path, made.tube))
    except ValueError:
        return None
    if not _sound(made, ahead, path, tube):
        return None
    t = made.t + ahead
    first, last = ceil(t[0] / STEP), floor(min(t[-1], t[0] + LONGEST_S) / STEP)
    if last < first:
        return None
    at = STEP * np.arange(first, last + 1)
    mean = straight(at, t, path)
    sigma = np.maximum(straight(at, t, tube) / axis_z(made.quantile, made.axis_quantile), _LEAST)
    along = track_frame(mean, at - at[0]) if len(at) > 1 else np.array([[1.0, 0.0]])
    return Forecast(made, first, mean, along, sigma)


@nb.njit(cache=True, nogil=True, _nrt=False)  # type: ignore[call-overload]
def _turned(along: np.ndarray, sigma: np.ndarray, out: np.ndarray) -> None:
    """Fill in the covariance of every row, (n, 4)."""
    for k in range(len(out)):
        c, s = along[k, 0], along[k, 1]
        a, b = sigma[k, 0] ** 2, sigma[k, 1] ** 2
        out[k, 0], out[k, 1], out[k, 2] = a * c * c + b * s * s, (a - b) * c * s, a * s * s + b * c * c
        out[k, 3] = sigma[k, 2] ** 2


def _sound(made: Prediction, ahead: np.ndarray, path: np.ndarray, tube: np.ndarray) -> bool:
    """Return whether times rise, shapes agree, numbers are finite and the origin is on this earth."""
    n = len(ahead) if ahead.ndim == 1 else 0
    if n < 1 or path.shape != (n, 3) or tube.shape != (n, 3):
        return False
    lat, lon, alt = made.origin
    return bool(
        0 < made.t < 4e9
        and 0 < made.quantile < 1
        and isfinite(made.quantile)
        and _credible(ahead, path, tube)
        and abs(lat) < 8.9e8
        and abs(lon) <= 1.8e9
        and abs(alt) <= 1e8
    )


@nb.njit(cache=True, nogil=True, _nrt=False)  # type: ignore[call-overload]
def _credible(ahead: np.ndarray, path: np.ndarray, tube: np.ndarray) -> bool:
    """Return whether times are finite and rise, and places and half-axes are near; false for nan."""
    for k in range(len(ahead)):
        if not np.isfinite(ahead[k]) or (k and not ahead[k] > ahead[k - 1]):
            return False
        for i in range(3):
            if not (abs(path[k, i]) < _MOST and 0.0 <= tube[k, i] < _MOST):
                return False
    return True
