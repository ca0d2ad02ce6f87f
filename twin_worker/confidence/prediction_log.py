"""The newest predictions of one aircraft, and what the flight has answered of each so far; bounded memory.

Every look-ahead is answered as soon as it has been flown, all predictions at once. A hole in telemetry leaves those
look-aheads without an answer and ends the wait for the first passage; so do events, which end the prediction.
"""

import numpy as np

from twin_worker.confidence.calibration_table import KNOTS
from twin_worker.confidence.prediction_log_kernel import Known, Said, answer_each, run_on
from twin_worker.numerics.interpolation import straight
from twin_worker.numerics.prediction_errors import AHEAD, least_length, track_frame

ROWS = 96  # predictions remembered
EVERY_S = 5.0  # a prediction is remembered this often [s]
_STRIDE_S = 1.0  # the path flown is measured in strides of so long [s]
_STRIDES = int(1.3 * AHEAD[-1] / _STRIDE_S)  # remembered


class Ledger:
    """Predictions in a ring, one array per quantity, over the first n of `AHEAD`.

    Args:
        rows: predictions remembered
        n: look-aheads of each
    """

    def __init__(self, rows: int = ROWS, n: int = len(AHEAD)) -> None:
        self.t0 = np.full(rows, -np.inf)  # [s since 1970]
        self.group = np.full(rows, "", dtype=object)
        self.method = np.full(rows, "", dtype=object)
        self.size = np.zeros(rows, int)  # look-aheads of each
        self.path = np.zeros((rows, n, 3))  # NED [m]
        self.along = np.zeros((rows, n, 2), np.float32)  # unit vector along it
        self.tube = np.ones((rows, n, 3), np.float32)  # half-axes as published [m]
        self.factor = np.ones((rows, len(KNOTS)))  # how much wider than the table that was [-]
        self.ratio = np.zeros((rows, n), np.float32)  # largest half-axes of the table over path length so far [-]
        self.horizon = np.zeros(rows)  # as published [s]
        self.score = np.full((rows, n), np.nan, np.float32)  # largest error over its half-axis [-]
        self.next = np.zeros(rows, int)  # first look-ahead not yet flown
        self.live = np.zeros(rows, bool)  # more answers are to come
        self.followed = np.zeros(rows)  # within 10 % up to here, unless passed [s]
        self.passed = np.zeros(rows, bool)
        self.watched = np.zeros(rows, bool)  # neither passed nor lost from sight
        self.claimed = np.zeros(rows, bool)  # its horizon has neither held nor failed yet
        self.until = -np.inf  # flown up to here [s since 1970]
        self._least = np.ones(rows)  # least path length [m]
        self._begun = np.full(rows, np.nan)  # odometer at t0 [m]
        self._before = np.zeros(rows)  # relative error at the look-ahead before [-]
        self._odometer = np.empty((0, 2))  # time, and length flown until then [s since 1970, m]
        self._stride_from = np.zeros(3)  # where the odometer stands
        self._at = -1  # newest row

    @property
    def newest(self) -> float:
        """Return when the newest prediction was made [s since 1970]."""
        return float(self.t0[self._at]) if self._at >= 0 else -np.inf

    def add(self, t0: float, method: str, group: str, path: np.ndarray, speed: float) -> int:
        """Begin to follow a prediction over the first n of `AHEAD`, path (n, 3); return its row, to be completed."""
        r = self._at = (self._at + 1) % len(self.t0)
        n = len(path)
        self.t0[r], self.method[r], self.group[r], self.size[r] = t0, method, group, n
        self.path[r, :n], self.along[r, :n] = path, track_frame(path, AHEAD[:n])
        self.score[r], self.next[r], self.live[r] = np.nan, 0, True
        self.followed[r], self.passed[r], self.watched[r], self.claimed[r] = 0.0, False, True, True
        self._least[r], self._begun[r], self._before[r] = least_length(speed), np.nan, 0.0
        return r

    @property
    def coverage(self) -> tuple[float, int]:
        """Return the share of answered look-aheads inside the tube (nan before any), and the predictions behind it."""
        score = self.score[:, 1:].copy()  # at once: another thread may read while this one scores
        known = np.isfinite(score)
        n = int(known.any(axis=1).sum())
        return (float((score[known] <= 1.0).mean()) if n else float("nan")), n

    def restart(self) -> None:
        """Measure the path flown anew: positions are in another frame from now on."""
        self._odometer = self._odometer[:0]

    def end(self) -> np.ndarray:
        """Follow no prediction any further; return the rows this ended."""
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
        answered = np.empty((int((self.size - self.next)[self.live].sum()), 2), np.int64)
        said = Said(self.t0, self.size, self.path, self.along, self.tube, self._least)
        known = Known(
            self.score, self.next, self.live, self.followed, self.passed, self.watched, self._begun, self._before
        )
        happened = np.ascontiguousarray(t, float), np.ascontiguousarray(flown, float), self._odometer
        n = answer_each(said, known, happened, answered)  # type: ignore[call-arg]
        rows, columns = np.ascontiguousarray(answered[:n].T)  # as one answer alone would lie
        return rows, columns

    def _measure(self, t: np.ndarray, flown: np.ndarray) -> None:
        """Let the odometer run on."""
        last = self._odometer[-1, 0] if len(self._odometer) else -np.inf
        if not last <= t[-1]:
            self._odometer = self._odometer[:0]
            last = -np.inf
        if not np.isfinite(last):
            self._odometer = np.array([[t[0], 0.0]])
            self._stride_from, last = flown[0], float(t[0])
        at = np.append(np.arange(last + _STRIDE_S, t[-1], _STRIDE_S), t[-1])
        at = at[at > last]
        if not len(at):
            return
        points, more = straight(at, t, flown), np.empty((len(at), 2))
        run_on(at, points, self._stride_from, float(self._odometer[-1, 1]), more)
        self._odometer = np.concatenate([self._odometer, more])[-_STRIDES:]
        self._stride_from = points[-1]
