"""Forecast revision: departure of a prediction from those made seconds before it, a measure of its uncertainty.

Source: Hoffman & Kalnay 1983, "Lagged average forecasting, an alternative to Monte Carlo forecasting".
"""

from collections import deque

import numpy as np
from scipy.interpolate import CubicSpline

from twin_worker.numerics.prediction_errors import along_cross_down, track_frame

_MIN_AGE_S, _MAX_AGE_S = 4.0, 21.0  # age of the predictions used [s]
_MEMBERS = 3  # predictions stored


class LaggedForecasts:
    """The last few predictions of one aircraft, as curves over time."""

    def __init__(self) -> None:
        self._members: deque[tuple[float, float, CubicSpline]] = deque(maxlen=_MEMBERS)

    def add(self, t: float, ahead: np.ndarray, path: np.ndarray) -> None:
        """Store a prediction made at `t` [s since 1970], path (n, 3) [m] at look-aheads (n,) [s]."""
        self._members.append((t, t + float(ahead[-1]), CubicSpline(ahead, path)))

    def clear(self) -> None:
        """Delete all predictions, as after an event that invalidates them."""
        self._members.clear()

    def revision(self, t: float, ahead: np.ndarray, path: np.ndarray) -> np.ndarray | None:
        """Return the root mean square departure along, cross, vertical, (n, 3) [m]; None without earlier predictions.

        Beyond the end of an earlier prediction its last departure is used.
        """
        members = [
            member
            for member in self._members
            if _MIN_AGE_S <= t - member[0] <= _MAX_AGE_S and ahead[0] <= member[1] - t
        ]
        if not members:
            return None
        departures = np.empty((len(members), *path.shape))
        for departure, (made_t, end, curve) in zip(departures, members, strict=True):
            n = int(np.searchsorted(ahead, end - t, side="right"))
            departure[:n] = curve(ahead[:n] + (t - made_t)) - path[:n]
            departure[n:] = departure[n - 1]
        return np.sqrt(np.mean(along_cross_down(track_frame(path, ahead), departures) ** 2, axis=0))
