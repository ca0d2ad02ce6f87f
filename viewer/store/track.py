"""The whole flown path of one UAV in a fixed number of points: the longer the flight, the farther apart they are."""

from math import dist

import numpy as np

from viewer.store.place import UNIT_M

POINTS = 800
TRAIL_ROWS = 900  # about 90 s at 10 Hz
STEP_S = 0.5  # between two points, until they are full for the first time [s]
SETTLE_S = 30.0  # so long first positions may be wrong: a leap among them begins the path anew [s]
LEAP_M, LEAP_M_S = 50.0, 60.0  # farther than this, and this for every second between, is a leap [m], [m/s]


class Track:
    """Times and places, thinned to every other one whenever there is no room left."""

    def __init__(self) -> None:
        self._rows = np.full((POINTS, 4), np.nan)  # t [s], scene ENU [10 m]; all its memory is taken at once
        self._n, self._step, self._last = 0, STEP_S, -np.inf

    def add(self, spots: list[tuple[float, float, float, float]]) -> bool:
        """Add times and places, rising: t [s], scene ENU [10 m]; what does not rise is left out. Tell of a leap."""
        if leapt := self._leaps(spots[0]):
            self.clear()
        for spot in spots:
            if spot[0] < self._last + self._step:
                continue
            if self._n == POINTS:
                self._n, self._step = POINTS // 2, 2 * self._step
                self._rows[: self._n] = self._rows[::2].copy()
            self._rows[self._n] = spot
            self._n, self._last = self._n + 1, spot[0]
        return leapt

    def _leaps(self, spot: tuple[float, float, float, float]) -> bool:
        if not self._n or spot[0] - self._rows[0, 0] > SETTLE_S:
            return False
        last = self._rows[self._n - 1].tolist()
        return UNIT_M * dist(spot[1:], last[1:]) > LEAP_M + LEAP_M_S * max(spot[0] - last[0], 0.0)

    def lay_before(self, rows: np.ndarray) -> None:
        """Put earlier points first: (n, 4) as of `rows`; what is not earlier than all that is held is left out."""
        held = self.rows()
        joined = np.vstack([_before(rows, held), held])
        self.clear()
        if len(joined):
            self.add([tuple(row) for row in joined.tolist()])

    def clear(self) -> None:
        """Forget the flight."""
        self._n, self._step, self._last = 0, STEP_S, -np.inf

    def rows(self) -> np.ndarray:
        """Copy all points: (n, 4) t [s], scene ENU [10 m]."""
        return self._rows[: self._n].copy()


class Trail:
    """The newest stretch of the flown path, as it was heard: t [s], scene ENU [10 m], Va [m/s]."""

    def __init__(self) -> None:
        self._rows = np.full((TRAIL_ROWS, 5), np.nan)  # all its memory is taken at once
        self._n = 0  # ever written; the newest `TRAIL_ROWS` are held

    def add(self, *row: float) -> None:
        """Add one row of five."""
        self._rows[self._n % TRAIL_ROWS] = row
        self._n += 1

    def lay_before(self, rows: np.ndarray) -> None:
        """Put earlier rows first, (n, 5), as many as there is room for; what is not earlier is left out."""
        held = self.rows()
        joined = np.vstack([_before(rows, held), held])[-TRAIL_ROWS:]
        self._rows[: len(joined)], self._n = joined, len(joined)

    def clear(self) -> None:
        """Forget it."""
        self._n = 0

    def rows(self) -> np.ndarray:
        """Copy what is held, oldest first: (n, 5)."""
        if self._n <= TRAIL_ROWS:
            return self._rows[: self._n].copy()
        return np.roll(self._rows, -(self._n % TRAIL_ROWS), axis=0)


def _before(rows: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Return the rows whose time is before the first one held."""
    return rows[rows[:, 0] < held[0, 0]] if len(held) else rows


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
