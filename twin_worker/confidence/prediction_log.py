"""Log of the newest predictions of one aircraft and their scores so far; bounded memory.

Every look-ahead is scored as soon as it has been flown, for all predictions at once. A gap in telemetry leaves its
look-aheads unscored and censors the first passage. An event ends the prediction and censors it too.
"""

from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

import numba as nb
import numpy as np

from twin_worker.confidence.calibration_table import COLUMN, KNOTS
from twin_worker.numerics.interpolation import interpolate_rows
from twin_worker.numerics.prediction_errors import AHEAD, ERROR_LIMIT, min_path_length, track_frame

KNOT_OF = np.full(len(AHEAD), -1)
KNOT_OF[COLUMN] = np.arange(len(KNOTS))
"""Number of the knot at each look-ahead, -1 elsewhere."""
_GAP_S = 2.5  # positions farther apart than this are a telemetry gap [s]
_exact = nb.njit(cache=True, error_model="numpy", nogil=True)  # no fastmath: as numpy does it


class LogArrays(NamedTuple):
    """Arrays of `PredictionLog` for the compiled scoring, one row per prediction; those from `score` on are changed."""

    t0: np.ndarray
    size: np.ndarray
    path: np.ndarray
    direction: np.ndarray
    tube: np.ndarray
    min_length: np.ndarray
    score: np.ndarray
    axis_score: np.ndarray
    next_column: np.ndarray
    live: np.ndarray
    followed: np.ndarray
    exceeded: np.ndarray
    uncensored: np.ndarray
    start_length: np.ndarray
    last_error: np.ndarray


@_exact
def _row_before(instant: float, t: np.ndarray) -> int:
    """Return the row before an instant, at least the first, at most the last but one."""
    k: int = np.searchsorted(t, instant)  # type: ignore[assignment]
    return max(min(k, len(t) - 1) - 1, 0)


@_exact
def _interpolate(instant: float, t0: float, t1: float, x0: float, x1: float) -> float:
    """Interpolate between two rows as `numpy.interp` does."""
    if instant <= t0:
        return x0
    return (x1 - x0) / (t1 - t0) * (instant - t0) + x0 if instant < t1 else x1


@_exact
def _length_until(instant: float, odometer: np.ndarray) -> float:
    """Return the path length flown until an instant [m]."""
    k = _row_before(instant, odometer[:, 0])
    (t0, x0), (t1, x1) = odometer[k], odometer[min(k + 1, len(odometer) - 1)]
    return _interpolate(instant, t0, t1, x0, x1)


@_exact
def _update_passage(row: int, column: int, relative_error: float, log: LogArrays) -> None:
    """Update the first passage of an uncensored prediction at one look-ahead."""
    last_error, last_ahead = log.last_error[row], AHEAD[max(column - 1, 0)]
    log.followed[row] = AHEAD[column]
    if relative_error > ERROR_LIMIT:
        fraction = (ERROR_LIMIT - last_error) / max(relative_error - last_error, 1e-9) if column > 0 else 0.0
        log.followed[row] = last_ahead + min(max(fraction, 0.0), 1.0) * (AHEAD[column] - last_ahead)
        log.exceeded[row], log.uncensored[row] = True, False
    log.last_error[row] = relative_error


@_exact
def evaluate_all(log: LogArrays, flight: tuple, evaluated: np.ndarray) -> int:
    """Score the look-aheads that have been flown, of every open prediction.

    Args:
        log: predictions and their scores
        flight: times, rising, (n,) [s since 1970], positions, NED, (n, 3) [m], and times and path lengths, (m, 2)
        evaluated: rows and columns that were evaluated, those in telemetry gaps included, filled in, (k, 2)
    Returns:
        how many
    """
    t, positions, odometer = flight
    n, until, error, axes = 0, t[-1], np.empty(3), np.empty(3)
    for row in range(len(log.t0)):
        if not log.live[row]:
            continue
        for column in range(log.next_column[row], log.size[row]):
            instant = log.t0[row] + AHEAD[column]
            if not instant <= until:
                break
            evaluated[n, 0], evaluated[n, 1] = row, column
            n += 1
            log.next_column[row] = column + 1
            if log.start_length[row] != log.start_length[row]:
                log.start_length[row] = _length_until(log.t0[row], odometer)
            k = _row_before(instant, t)
            if not (t[k + 1] - t[k] <= _GAP_S and instant >= t[0] - 1e-6):
                log.uncensored[row] = False
                continue
            for i in range(3):
                error[i] = (
                    _interpolate(instant, t[k], t[k + 1], positions[k, i], positions[k + 1, i])
                    - log.path[row, column, i]
                )
            c, s = log.direction[row, column, 0], log.direction[row, column, 1]
            axes[0], axes[1], axes[2] = error[0] * c + error[1] * s, error[1] * c - error[0] * s, error[2]
            max_ratio, knot = 0.0, KNOT_OF[column]
            for i in range(3):
                ratio = abs(axes[i]) / log.tube[row, column, i]
                max_ratio = max(max_ratio, ratio)
                if knot >= 0:
                    log.axis_score[row, knot, i] = ratio
            log.score[row, column] = max_ratio
            if log.uncensored[row]:
                length = max(_length_until(instant, odometer) - log.start_length[row], log.min_length[row])
                _update_passage(row, column, sqrt(error[0] ** 2 + error[1] ** 2 + error[2] ** 2) / length, log)
        log.live[row] = log.next_column[row] < log.size[row]
    return n


@_exact
def accumulate_length(
    t: np.ndarray, points: np.ndarray, start: np.ndarray, start_length: float, out: np.ndarray
) -> None:
    """Compute the path length flown until each time, (n, 2) [s since 1970, m].

    Args:
        t, points: times and positions, NED, (n,) and (n, 3) [s since 1970, m]
        start: position at which the first interval begins, (3,) [m]
        start_length: path length flown until there [m]
        out: times and path lengths, filled in
    """
    length, north, east, down = 0.0, start[0], start[1], start[2]
    for k in range(len(t)):
        n, e, d = points[k, 0] - north, points[k, 1] - east, points[k, 2] - down
        length += sqrt(n * n + e * e + d * d)
        out[k, 0], out[k, 1] = t[k], start_length + length
        north, east, down = points[k, 0], points[k, 1], points[k, 2]


CAPACITY = 96  # predictions stored
EVERY_S = 5.0  # between stored predictions [s]
_STRIDE_S = 1.0  # interval at which the path length flown is measured [s]
_STRIDES = int(1.3 * AHEAD[-1] / _STRIDE_S)  # intervals stored


@dataclass(init=False, eq=False)
class PredictionLog:
    """Ring buffer of predictions, one array per quantity, over the first n of `AHEAD`.

    Args:
        rows: predictions stored
        n: look-aheads of each
    """

    t0: np.ndarray  # [s since 1970]
    group: np.ndarray
    method: np.ndarray
    size: np.ndarray  # look-aheads of each
    path: np.ndarray  # NED [m]
    direction: np.ndarray  # unit vector along the path
    tube: np.ndarray  # half-axes as published [m]
    factor: np.ndarray  # published half-axes over those of the table, by knot and axis [-]
    ratio: np.ndarray  # running maximum of table half-axes over path length [-]
    horizon: np.ndarray  # as published [s]
    score: np.ndarray  # largest error over its half-axis [-]
    axis_score: np.ndarray  # error over each half-axis, at the knots [-]
    next_column: np.ndarray  # first look-ahead not yet flown
    live: np.ndarray  # look-aheads remain to be scored
    followed: np.ndarray  # follow-up time: first passage of 10 %, or censoring time [s]
    exceeded: np.ndarray  # the error has exceeded 10 %
    uncensored: np.ndarray  # neither exceeded nor censored
    horizon_pending: np.ndarray  # its horizon is neither met nor missed yet
    evaluated_until: float  # end of the scored flight [s since 1970]
    min_length: np.ndarray  # least path length [m]
    start_length: np.ndarray  # path length at t0 [m]
    last_error: np.ndarray  # relative error at the previous look-ahead [-]
    _odometer: np.ndarray  # time, and path length flown until then [s since 1970, m]
    _stride_start: np.ndarray  # position at the end of the last interval
    _newest_row: int  # newest row

    def __init__(self, rows: int = CAPACITY, n: int = len(AHEAD)) -> None:
        self.t0 = np.full(rows, -np.inf)
        self.group = np.full(rows, "", dtype=object)
        self.method = np.full(rows, "", dtype=object)
        self.size = np.zeros(rows, int)
        self.path = np.zeros((rows, n, 3))
        self.direction = np.zeros((rows, n, 2), np.float32)
        self.tube = np.ones((rows, n, 3), np.float32)
        self.factor = np.ones((rows, len(KNOTS), 3))
        self.ratio = np.zeros((rows, n), np.float32)
        self.horizon = np.zeros(rows)
        self.score = np.full((rows, n), np.nan, np.float32)
        self.axis_score = np.full((rows, len(KNOTS), 3), np.nan, np.float32)
        self.next_column = np.zeros(rows, int)
        self.live = np.zeros(rows, bool)
        self.followed = np.zeros(rows)
        self.exceeded = np.zeros(rows, bool)
        self.uncensored = np.zeros(rows, bool)
        self.horizon_pending = np.zeros(rows, bool)
        self.evaluated_until = -np.inf
        self.min_length = np.ones(rows)
        self.start_length = np.full(rows, np.nan)
        self.last_error = np.zeros(rows)
        self._odometer = np.empty((0, 2))
        self._stride_start = np.zeros(3)
        self._newest_row = -1

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
        self.score[row], self.axis_score[row], self.next_column[row], self.live[row] = np.nan, np.nan, 0, True
        self.followed[row], self.exceeded[row], self.uncensored[row], self.horizon_pending[row] = 0.0, False, True, True
        self.min_length[row], self.start_length[row], self.last_error[row] = min_path_length(speed), np.nan, 0.0
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
        arrays = LogArrays(*(getattr(self, name) for name in LogArrays._fields))
        flight = np.ascontiguousarray(t, float), np.ascontiguousarray(positions, float), self._odometer
        n = evaluate_all(arrays, flight, evaluated)  # type: ignore[call-arg]
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
