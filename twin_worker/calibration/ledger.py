"""The newest predictions of one aircraft, and what the flight has answered of each so far; bounded memory.

Every look-ahead is answered as soon as it has been flown, all predictions at once. A hole in telemetry leaves those
look-aheads without an answer and ends the wait for the first passage; so do events, which end the prediction.
"""

from collections import deque

import numpy as np

from twin_worker.calibration.miss import AHEAD, LIMIT, along_cross_down, least_length, track_frame
from twin_worker.calibration.table import KNOTS

ROWS = 96  # predictions remembered
EVERY_S = 5.0  # a prediction is remembered this often [s]
_GAP_S = 2.5  # positions farther apart than this are a hole [s]
_STRIDE_S = 1.0  # the path flown is measured in strides of so long [s]


class Ledger:
    """Predictions in a ring of `ROWS`, one array per quantity, n = 91 look-aheads."""

    def __init__(self) -> None:
        n = len(AHEAD)
        self.t0 = np.full(ROWS, -np.inf)  # [s since 1970]
        self.group = np.full(ROWS, "", dtype=object)
        self.method = np.full(ROWS, "", dtype=object)
        self.size = np.zeros(ROWS, int)  # look-aheads of each
        self.path = np.zeros((ROWS, n, 3))  # NED [m]
        self.along = np.zeros((ROWS, n, 2), np.float32)  # unit vector along it
        self.tube = np.ones((ROWS, n, 3), np.float32)  # half-axes as published [m]
        self.factor = np.ones((ROWS, len(KNOTS)))  # how much wider than the table that was [-]
        self.ratio = np.zeros((ROWS, n), np.float32)  # largest half-axes of the table over path length so far [-]
        self.horizon = np.zeros(ROWS)  # as published [s]
        self.score = np.full((ROWS, n), np.nan, np.float32)  # largest error over its half-axis [-]
        self.next = np.zeros(ROWS, int)  # first look-ahead not yet flown
        self.live = np.zeros(ROWS, bool)  # more answers are to come
        self.followed = np.zeros(ROWS)  # within 10 % up to here, unless passed [s]
        self.passed = np.zeros(ROWS, bool)
        self.watched = np.zeros(ROWS, bool)  # neither passed nor lost from sight
        self.claimed = np.zeros(ROWS, bool)  # its horizon has neither held nor failed yet
        self.until = -np.inf  # flown up to here [s since 1970]
        self._least = np.ones(ROWS)  # least path length [m]
        self._begun = np.full(ROWS, np.nan)  # odometer at t0 [m]
        self._before = np.zeros(ROWS)  # relative error at the look-ahead before [-]
        self._odometer: deque[tuple[float, float]] = deque(maxlen=int(1.3 * AHEAD[-1] / _STRIDE_S))
        self._stride_from = np.zeros(3)  # where the odometer stands
        self._at = -1  # newest row

    @property
    def newest(self) -> float:
        """Give when the newest prediction was made [s since 1970]."""
        return float(self.t0[self._at]) if self._at >= 0 else -np.inf

    def add(self, t0: float, method: str, group: str, path: np.ndarray, speed: float) -> int:
        """Begin to follow a prediction over the first n of `AHEAD`, path (n, 3); give its row, to be completed."""
        r = self._at = (self._at + 1) % ROWS
        n = len(path)
        self.t0[r], self.method[r], self.group[r], self.size[r] = t0, method, group, n
        self.path[r, :n], self.along[r, :n] = path, track_frame(path, AHEAD[:n])
        self.score[r], self.next[r], self.live[r] = np.nan, 0, True
        self.followed[r], self.passed[r], self.watched[r], self.claimed[r] = 0.0, False, True, True
        self._least[r], self._begun[r], self._before[r] = least_length(speed), np.nan, 0.0
        return r

    def end(self) -> np.ndarray:
        """Follow no prediction any further; give the rows this ended."""
        rows = np.flatnonzero(self.live)
        self.live[:] = self.watched[:] = False
        return rows

    def answer(self, t: np.ndarray, flown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Answer every look-ahead that has been flown by now.

        Args:
            t: times of the flown path, rising, from before `until` on, (n,) [s since 1970]
            flown: positions, NED, (n, 3) [m]
        Returns:
            rows and columns answered, holes among them
        """
        self._measure(t, flown)
        self.until = float(t[-1])
        rows = np.flatnonzero(self.live)
        column = np.arange(len(AHEAD))
        due = (self.t0[rows, None] + AHEAD <= self.until) & (column >= self.next[rows, None])
        due &= column < self.size[rows, None]
        k, j = np.nonzero(due)
        if not len(k):
            return k, j
        r = rows[k]
        self._score(r, j, *self._flown(self.t0[r] + AHEAD[j], t, flown))
        np.maximum.at(self.next, r, j + 1)
        self.live[rows] = self.next[rows] < self.size[rows]
        return r, j

    def _measure(self, t: np.ndarray, flown: np.ndarray) -> None:
        """Let the odometer run on."""
        last = self._odometer[-1][0] if self._odometer else -np.inf
        if not last <= t[-1]:
            self._odometer.clear()
            last = -np.inf
        if not np.isfinite(last):
            self._odometer.append((float(t[0]), 0.0))
            self._stride_from, last = flown[0], float(t[0])
        at = np.append(np.arange(last + _STRIDE_S, t[-1], _STRIDE_S), t[-1])
        at = at[at > last]
        if not len(at):
            return
        points = np.column_stack([np.interp(at, t, column) for column in flown.T])
        strides = np.linalg.norm(np.diff(np.vstack([self._stride_from, points]), axis=0), axis=1)
        run = self._odometer[-1][1] + np.cumsum(strides)
        self._odometer.extend(zip(at.tolist(), run.tolist(), strict=True))
        self._stride_from = points[-1]

    def _flown(self, at: np.ndarray, t: np.ndarray, flown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Give where it was at some times, (m, 3), and whether that is known, (m,)."""
        right = np.clip(np.searchsorted(t, at), 1, max(len(t) - 1, 1))
        right = np.minimum(right, len(t) - 1)
        known = (t[right] - t[np.maximum(right - 1, 0)] <= _GAP_S) & (at >= t[0] - 1e-6)
        return np.column_stack([np.interp(at, t, column) for column in flown.T]), known

    def _score(self, r: np.ndarray, j: np.ndarray, flown: np.ndarray, known: np.ndarray) -> None:
        """Enter scores and passages of rows and columns, in the order of their look-aheads."""
        error = flown - self.path[r, j]
        axes = np.abs(along_cross_down(self.along[r, j], error))
        self.score[r[known], j[known]] = (axes / self.tube[r, j]).max(axis=1)[known]
        times, run = np.array(self._odometer).T
        fresh = r[np.isnan(self._begun[r])]
        self._begun[fresh] = np.interp(self.t0[fresh], times, run)
        length = np.interp(self.t0[r] + AHEAD[j], times, run) - self._begun[r]
        relative = np.linalg.norm(error, axis=1) / np.maximum(length, self._least[r])
        again = np.append(False, r[1:] == r[:-1])  # several of one prediction are taken one after the other
        nth = np.arange(len(r)) - np.maximum.accumulate(np.where(again, 0, np.arange(len(r))))
        for round_ in range(int(nth.max()) + 1):
            now = nth == round_
            self._pass(r[now], j[now], relative[now], known[now])

    def _pass(self, r: np.ndarray, j: np.ndarray, relative: np.ndarray, known: np.ndarray) -> None:
        """See whether predictions, each once, have passed 10 % at a look-ahead."""
        self.watched[r[~known]] = False
        seen = self.watched[r]
        r, j, relative = r[seen], j[seen], relative[seen]
        over = relative > LIMIT
        before = self._before[r]
        share = np.where(j > 0, (LIMIT - before) / np.maximum(relative - before, 1e-9), 0.0)
        last = AHEAD[np.maximum(j - 1, 0)]
        self.followed[r] = np.where(over, last + np.clip(share, 0.0, 1.0) * (AHEAD[j] - last), AHEAD[j])
        self._before[r] = relative
        self.passed[r[over]], self.watched[r[over]] = True, False
