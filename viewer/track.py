"""The whole flown path of one UAV in a fixed number of points: the longer the flight, the farther apart they are."""

import numpy as np

from viewer.place import UNIT_M

POINTS = 800
STEP_S = 0.5  # between two points, until they are full for the first time [s]
SETTLE_S = 30.0  # so long first positions may be wrong: a leap among them begins the path anew [s]
LEAP_M, LEAP_M_S = 50.0, 60.0  # farther than this, and this for every second between, is a leap [m], [m/s]


class Track:
    """Times and places, thinned to every other one whenever there is no room left."""

    def __init__(self) -> None:
        self._rows = np.empty((POINTS, 4))  # t [s], scene ENU [10 m]
        self._n, self._step = 0, STEP_S

    def add(self, t: np.ndarray, enu: np.ndarray) -> bool:
        """Add places, t (n,) rising [s], enu (n, 3) [10 m]; what does not rise is left out. Tell of a leap."""
        if leapt := self._leaps(float(t[0]), enu[0]):
            self.clear()
        last = self._rows[self._n - 1, 0] if self._n else -np.inf
        for at, place in zip(t, enu, strict=True):
            if at < last + self._step:
                continue
            if self._n == POINTS:
                self._n, self._step = POINTS // 2, 2 * self._step
                self._rows[: self._n] = self._rows[::2].copy()
            self._rows[self._n] = at, *place
            self._n, last = self._n + 1, at
        return leapt

    def _leaps(self, t: float, place: np.ndarray) -> bool:
        if not self._n or t - self._rows[0, 0] > SETTLE_S:
            return False
        last = self._rows[self._n - 1]
        return bool(np.linalg.norm(place - last[1:]) * UNIT_M > LEAP_M + LEAP_M_S * max(t - last[0], 0.0))

    def clear(self) -> None:
        """Forget the flight."""
        self._n, self._step = 0, STEP_S

    def rows(self) -> np.ndarray:
        """Copy all points: (n, 4) t [s], scene ENU [10 m]."""
        return self._rows[: self._n].copy()


def placed(rows: np.ndarray, t: np.ndarray, slack: float = 2.0) -> np.ndarray:
    """Interpolate where the UAV was.

    Args:
        rows: of a track, (n, 4)
        t: when, (k,) [s]
        slack: how far before the first and after the last point it is still said to have been there [s]
    Returns:
        (k, 3) [10 m]; not a number where the flown path does not reach
    """
    t = np.asarray(t, float)
    if not len(rows):
        return np.full((len(t), 3), np.nan)
    found = np.stack([np.interp(t, rows[:, 0], rows[:, k]) for k in (1, 2, 3)], axis=-1)
    found[(t < rows[0, 0] - slack) | (t > rows[-1, 0] + slack)] = np.nan
    return found
