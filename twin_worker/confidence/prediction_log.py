"""Log of the newest predictions of one aircraft and their scores so far; bounded memory.

Every look-ahead is scored as soon as it has been flown, for all predictions at once. A gap in telemetry leaves its
look-aheads unscored and censors the first passage. An event ends the prediction and censors it too.
"""

import numpy as np

from twin_worker.confidence.calibration_table import KNOTS
from twin_worker.confidence.prediction_log_kernel import (
    PredictionColumns,
    ScoringState,
    accumulate_length,
    evaluate_all,
)
from twin_worker.numerics.interpolation import interpolate_rows
from twin_worker.numerics.prediction_errors import AHEAD, min_path_length, track_frame

CAPACITY = 96  # predictions stored
EVERY_S = 5.0  # between stored predictions [s]
_STRIDE_S = 1.0  # interval at which the path length flown is measured [s]
_STRIDES = int(1.3 * AHEAD[-1] / _STRIDE_S)  # intervals stored


class PredictionLog:
    """Ring buffer of predictions, one array per quantity, over the first n of `AHEAD`.

    Args:
        rows: predictions stored
        n: look-aheads of each
    """

    def __init__(self, rows: int = CAPACITY, n: int = len(AHEAD)) -> None:
        self.t0 = np.full(rows, -np.inf)  # [s since 1970]
        self.group = np.full(rows, "", dtype=object)
        self.method = np.full(rows, "", dtype=object)
        self.size = np.zeros(rows, int)  # look-aheads of each
        self.path = np.zeros((rows, n, 3))  # NED [m]
        self.direction = np.zeros((rows, n, 2), np.float32)  # unit vector along the path
        self.tube = np.ones((rows, n, 3), np.float32)  # half-axes as published [m]
        self.factor = np.ones((rows, len(KNOTS)))  # published half-axes over those of the table [-]
        self.ratio = np.zeros((rows, n), np.float32)  # running maximum of table half-axes over path length [-]
        self.horizon = np.zeros(rows)  # as published [s]
        self.score = np.full((rows, n), np.nan, np.float32)  # largest error over its half-axis [-]
        self.next_column = np.zeros(rows, int)  # first look-ahead not yet flown
        self.live = np.zeros(rows, bool)  # look-aheads remain to be scored
        self.followed = np.zeros(rows)  # follow-up time: first passage of 10 %, or censoring time [s]
        self.exceeded = np.zeros(rows, bool)  # the error has exceeded 10 %
        self.uncensored = np.zeros(rows, bool)  # neither exceeded nor censored
        self.horizon_pending = np.zeros(rows, bool)  # its horizon is neither met nor missed yet
        self.evaluated_until = -np.inf  # end of the scored flight [s since 1970]
        self._min_length = np.ones(rows)  # least path length [m]
        self._start_length = np.full(rows, np.nan)  # path length at t0 [m]
        self._last_error = np.zeros(rows)  # relative error at the previous look-ahead [-]
        self._odometer = np.empty((0, 2))  # time, and path length flown until then [s since 1970, m]
        self._stride_start = np.zeros(3)  # position at the end of the last interval
        self._newest_row = -1  # newest row

    @property
    def newest_t(self) -> float:
        """Return the start time of the newest prediction [s since 1970]."""
        return float(self.t0[self._newest_row]) if self._newest_row >= 0 else -np.inf

    def add(self, t0: float, method: str, group: str, path: np.ndarray, speed: float) -> int:
        """Add a prediction over the first n of `AHEAD`, path (n, 3); return its row, which the caller completes."""
        row = self._newest_row = (self._newest_row + 1) % len(self.t0)
        n = len(path)
        self.t0[row], self.method[row], self.group[row], self.size[row] = t0, method, group, n
        self.path[row, :n], self.direction[row, :n] = path, track_frame(path, AHEAD[:n])
        self.score[row], self.next_column[row], self.live[row] = np.nan, 0, True
        self.followed[row], self.exceeded[row], self.uncensored[row], self.horizon_pending[row] = 0.0, False, True, True
        self._min_length[row], self._start_length[row], self._last_error[row] = min_path_length(speed), np.nan, 0.0
        return row

    @property
    def coverage(self) -> tuple[float, int]:
        """Return the share of scored look-aheads inside the tube (nan before any), and the number of predictions."""
        score = self.score[:, 1:].copy()  # one copy: another thread may score meanwhile
        scored = np.isfinite(score)
        n = int(scored.any(axis=1).sum())
        return (float((score[scored] <= 1.0).mean()) if n else float("nan")), n

    def reset_odometer(self) -> None:
        """Restart the path length: positions are in another frame from now on."""
        self._odometer = self._odometer[:0]

    def censor_open(self) -> np.ndarray:
        """Censor every open prediction; return the rows this ended."""
        rows = np.flatnonzero(self.live)
        self.live[:] = self.uncensored[:] = False
        return rows

    def evaluate(self, t: np.ndarray, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Score every look-ahead that has been flown.

        Args:
            t: times of the flown path, rising, from before `evaluated_until` on, (n,) [s since 1970]
            positions: flown positions, NED, (n, 3) [m]
        Returns:
            rows and columns evaluated, those in telemetry gaps included
        """
        self._update_odometer(t, positions)
        self.evaluated_until = float(t[-1])
        evaluated = np.empty((int((self.size - self.next_column)[self.live].sum()), 2), np.int64)
        predictions = PredictionColumns(self.t0, self.size, self.path, self.direction, self.tube, self._min_length)
        state = ScoringState(
            self.score,
            self.next_column,
            self.live,
            self.followed,
            self.exceeded,
            self.uncensored,
            self._start_length,
            self._last_error,
        )
        flight = np.ascontiguousarray(t, float), np.ascontiguousarray(positions, float), self._odometer
        n = evaluate_all(predictions, state, flight, evaluated)  # type: ignore[call-arg]
        rows, columns = np.ascontiguousarray(evaluated[:n].T)  # contiguous rows and columns
        return rows, columns

    def _update_odometer(self, t: np.ndarray, positions: np.ndarray) -> None:
        """Extend the path length flown."""
        last = self._odometer[-1, 0] if len(self._odometer) else -np.inf
        if not last <= t[-1]:
            self._odometer = self._odometer[:0]
            last = -np.inf
        if not np.isfinite(last):
            self._odometer = np.array([[t[0], 0.0]])
            self._stride_start, last = positions[0], float(t[0])
        stride_t = np.append(np.arange(last + _STRIDE_S, t[-1], _STRIDE_S), t[-1])
        stride_t = stride_t[stride_t > last]
        if not len(stride_t):
            return
        points, readings = interpolate_rows(stride_t, t, positions), np.empty((len(stride_t), 2))
        accumulate_length(stride_t, points, self._stride_start, float(self._odometer[-1, 1]), readings)
        self._odometer = np.concatenate([self._odometer, readings])[-_STRIDES:]
        self._stride_start = points[-1]
