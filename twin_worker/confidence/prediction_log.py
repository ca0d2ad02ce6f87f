"""Log of the newest predictions of one aircraft and their scores so far; bounded memory.

Every look-ahead is scored as soon as it has been flown, for all predictions at once. A gap in telemetry leaves its
look-aheads unscored and censors the first passage. An event ends the prediction and censors it too.
"""

import numpy as np

from twin_worker.confidence.calibration_table import KNOTS
from twin_worker.confidence.prediction_log_kernel import Known, Said, answer_each, run_on
from twin_worker.numerics.interpolation import straight
from twin_worker.numerics.prediction_errors import AHEAD, least_length, track_frame

ROWS = 96  # predictions stored
EVERY_S = 5.0  # between stored predictions [s]
_STRIDE_S = 1.0  # interval at which the path length flown is measured [s]
_STRIDES = int(1.3 * AHEAD[-1] / _STRIDE_S)  # intervals stored


class Ledger:
    """Ring buffer of predictions, one array per quantity, over the first n of `AHEAD`.

    Args:
        rows: predictions stored
        n: look-aheads of each
    """

    def __init__(self, rows: int = ROWS, n: int = len(AHEAD)) -> None:
        self.t0 = np.full(rows, -np.inf)  # [s since 1970]
        self.group = np.full(rows, "", dtype=object)
        self.method = np.full(rows, "", dtype=object)
        self.size = np.zeros(rows, int)  # look-aheads of each
        self.path = np.zeros((rows, n, 3))  # NED [m]
        self.along = np.zeros((rows, n, 2), np.float32)  # unit vector along the path
        self.tube = np.ones((rows, n, 3), np.float32)  # half-axes as published [m]
        self.factor = np.ones((rows, len(KNOTS)))  # published half-axes over those of the table [-]
        self.ratio = np.zeros((rows, n), np.float32)  # running maximum of table half-axes over path length [-]
        self.horizon = np.zeros(rows)  # as published [s]
        self.score = np.full((rows, n), np.nan, np.float32)  # largest error over its half-axis [-]
        self.next = np.zeros(rows, int)  # first look-ahead not yet flown
        self.live = np.zeros(rows, bool)  # look-aheads remain to be scored
        self.followed = np.zeros(rows)  # follow-up time: first passage of 10 %, or censoring time [s]
        self.passed = np.zeros(rows, bool)  # the error has exceeded 10 %
        self.watched = np.zeros(rows, bool)  # neither exceeded nor censored
        self.claimed = np.zeros(rows, bool)  # its horizon is neither met nor missed yet
        self.until = -np.inf  # end of the scored flight [s since 1970]
        self._least = np.ones(rows)  # least path length [m]
        self._begun = np.full(rows, np.nan)  # path length at t0 [m]
        self._before = np.zeros(rows)  # relative error at the previous look-ahead [-]
        self._odometer = np.empty((0, 2))  # time, and path length flown until then [s since 1970, m]
        self._stride_from = np.zeros(3)  # position at the end of the last interval
        self._at = -1  # newest row

    @property
    def newest(self) -> float:
        """Return the start time of the newest prediction [s since 1970]."""
        return float(self.t0[self._at]) if self._at >= 0 else -np.inf

    def add(self, t0: float, method: str, group: str, path: np.ndarray, speed: float) -> int:
        """Add a prediction over the first n of `AHEAD`, path (n, 3); return its row, which the caller completes."""
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
        """Return the share of scored look-aheads inside the tube (nan before any), and the number of predictions."""
        score = self.score[:, 1:].copy()  # one copy: another thread may score meanwhile
        known = np.isfinite(score)
        n = int(known.any(axis=1).sum())
        return (float((score[known] <= 1.0).mean()) if n else float("nan")), n

    def restart(self) -> None:
        """Restart the path length: positions are in another frame from now on."""
        self._odometer = self._odometer[:0]

    def end(self) -> np.ndarray:
        """Censor every open prediction; return the rows this ended."""
        rows = np.flatnonzero(self.live)
        self.live[:] = self.watched[:] = False
        return rows

    def answer(self, t: np.ndarray, flown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Score every look-ahead that has been flown.

        Args:
            t: times of the flown path, rising, from before `evaluated_until` on, (n,) [s since 1970]
            positions: flown positions, NED, (n, 3) [m]
        Returns:
            rows and columns evaluated, those in telemetry gaps included
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
        rows, columns = np.ascontiguousarray(answered[:n].T)  # contiguous rows and columns
        return rows, columns

    def _measure(self, t: np.ndarray, flown: np.ndarray) -> None:
        """Extend the path length flown."""
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
