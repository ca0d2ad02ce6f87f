"""Flown path of one UAV: the whole flight in a fixed number of points, and the newest stretch in full."""

from math import dist

import numpy as np

from viewer.store.place import UNIT_M

POINTS = 800
TRAIL_ROWS = 900  # about 90 s at 10 Hz
STEP_S = 0.5  # initial spacing of the points [s]
STARTUP_S = 30.0  # initial positions may be wrong: a jump within this time restarts the path [s]
JUMP_M, JUMP_M_S = 50.0, 60.0  # a jump exceeds JUMP_M plus JUMP_M_S times the interval [m], [m/s]


class FlightTrack:
    """Path of a flight; when the buffer is full, every second point is dropped."""

    def __init__(self) -> None:
        self._rows = np.full((POINTS, 4), np.nan)  # t [s], scene ENU [10 m]; preallocated
        self._n, self._step, self._first, self._last = 0, STEP_S, -np.inf, -np.inf

    def add(self, points: list[tuple[float, float, float, float]]) -> bool:
        """Append points in time order, t [s], scene ENU [10 m]; skip older ones. Return whether the path jumped."""
        if jumped := self._is_jump(points[0]):
            self.clear()
        for point in points:
            if point[0] < self._last + self._step:
                continue
            if self._n == POINTS:
                self._n, self._step = POINTS // 2, 2 * self._step
                self._rows[: self._n] = self._rows[::2].copy()
            self._first = self._first if self._n else point[0]
            self._rows[self._n] = point
            self._n, self._last = self._n + 1, point[0]
        return jumped

    def _is_jump(self, point: tuple[float, float, float, float]) -> bool:
        if not self._n or point[0] - self._first > STARTUP_S:
            return False
        last = self._rows[self._n - 1].tolist()
        return UNIT_M * dist(point[1:], last[1:]) > JUMP_M + JUMP_M_S * max(point[0] - last[0], 0.0)

    def prepend(self, rows: np.ndarray) -> None:
        """Prepend earlier points (n, 4), as of `rows`; skip points that are not earlier."""
        current = self.rows()
        joined = np.vstack([_before(rows, current), current])
        self.clear()
        if len(joined):
            self.add([tuple(row) for row in joined.tolist()])

    def clear(self) -> None:
        """Remove all points."""
        self._n, self._step, self._first, self._last = 0, STEP_S, -np.inf, -np.inf

    def rows(self) -> np.ndarray:
        """Copy all points: (n, 4) t [s], scene ENU [10 m]."""
        return self._rows[: self._n].copy()


class Trail:
    """Newest stretch of the flown path, as received: t [s], scene ENU [10 m], Va [m/s]."""

    def __init__(self) -> None:
        self._rows = np.full((TRAIL_ROWS, 5), np.nan)  # preallocated
        self._n = 0  # rows ever written; the newest `TRAIL_ROWS` are stored

    def add(self, row: tuple[float, float, float, float, float]) -> None:
        """Add one row."""
        self._rows[self._n % TRAIL_ROWS] = row
        self._n += 1

    def prepend(self, rows: np.ndarray) -> None:
        """Prepend earlier rows (n, 5) up to the capacity; skip rows that are not earlier."""
        current = self.rows()
        joined = np.vstack([_before(rows, current), current])[-TRAIL_ROWS:]
        self._rows[: len(joined)], self._n = joined, len(joined)

    def clear(self) -> None:
        """Remove all rows."""
        self._n = 0

    def rows(self) -> np.ndarray:
        """Copy the stored rows, oldest first: (n, 5)."""
        if self._n <= TRAIL_ROWS:
            return self._rows[: self._n].copy()
        oldest = self._n % TRAIL_ROWS
        return np.concatenate([self._rows[oldest:], self._rows[:oldest]])


def _before(rows: np.ndarray, current: np.ndarray) -> np.ndarray:
    """Return the rows earlier than the first current one."""
    return rows[rows[:, 0] < current[0, 0]] if len(current) else rows


def positions_at(rows: np.ndarray, t: np.ndarray, slack: float = 2.0) -> np.ndarray:
    """Interpolate positions on a path.

    Args:
        rows: of a track, (n, 4)
        t: times, (k,) [s]
        slack: tolerance before the first and after the last point [s]
    Returns:
        (k, 3) [10 m]; NaN outside the path
    """
    t = np.asarray(t, float)
    if not len(rows):
        return np.full((len(t), 3), np.nan)
    positions = np.stack([np.interp(t, rows[:, 0], rows[:, k]) for k in (1, 2, 3)], axis=-1)
    positions[(t < rows[0, 0] - slack) | (t > rows[-1, 0] + slack)] = np.nan
    return positions
