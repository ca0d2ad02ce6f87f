"""Forecast revision: departure of a prediction from those made seconds before it, a measure of its uncertainty.

Source: Hoffman & Kalnay 1983, "Lagged average forecasting, an alternative to Monte Carlo forecasting".
"""

from collections import deque

import numpy as np
from scipy.interpolate import CubicSpline

from twin_worker.numerics.prediction_errors import along_cross_down, track_frame

_LEAST_S, _MOST_S = 4.0, 21.0  # age of the predictions used [s]
_KEPT = 3  # predictions stored


class Earlier:
    """The last few predictions of one aircraft, as curves over time."""

    def __init__(self) -> None:
        self._kept: deque[tuple[float, float, CubicSpline]] = deque(maxlen=_KEPT)

    def add(self, t: float, ahead: np.ndarray, path: np.ndarray) -> None:
        """Store a prediction made at `t` [s since 1970], path (n, 3) [m] at look-aheads (n,) [s]."""
        self._kept.append((t, t + float(ahead[-1]), CubicSpline(ahead, path)))

    def clear(self) -> None:
        """Delete all predictions, as after an event that invalidates them."""
        self._kept.clear()

    def revised(self, t: float, ahead: np.ndarray, path: np.ndarray) -> np.ndarray | None:
        """Return the root mean square departure along, cross, vertical, (n, 3) [m]; None without earlier predictions.

        Beyond the end of an earlier prediction its last departure is used.
        """
        found = [kept for kept in self._kept if _LEAST_S <= t - kept[0] <= _MOST_S and ahead[0] <= kept[1] - t]
        if not found:
            return None
        apart = np.empty((len(found), *path.shape))
        for one, (made, end, curve) in zip(apart, found, strict=True):
            n = int(np.searchsorted(ahead, end - t, side="right"))
            one[:n] = curve(ahead[:n] + (t - made)) - path[:n]
            one[n:] = one[n - 1]
        return np.sqrt(np.mean(along_cross_down(track_frame(path, ahead), apart) ** 2, axis=0))
