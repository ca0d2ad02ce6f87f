"""Compiled scoring of predictions against the flight, look-ahead by look-ahead."""

from math import sqrt
from typing import NamedTuple

import numba as nb
import numpy as np

from twin_worker.numerics.prediction_errors import AHEAD, ERROR_LIMIT

_GAP_S = 2.5  # positions farther apart than this are a telemetry gap [s]
_exact = nb.njit(cache=True, error_model="numpy", nogil=True)  # no fastmath: as numpy does it


class PredictionColumns(NamedTuple):
    """Arrays of `PredictionLog` that describe the predictions, one row each."""

    t0: np.ndarray
    size: np.ndarray
    path: np.ndarray
    direction: np.ndarray
    tube: np.ndarray
    min_length: np.ndarray


class ScoringState(NamedTuple):
    """Arrays of `PredictionLog` that describe the scores so far, changed in place."""

    score: np.ndarray
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
def _update_passage(row: int, column: int, relative_error: float, state: ScoringState) -> None:
    """Update the first passage of an uncensored prediction at one look-ahead."""
    last_error, last_ahead = state.last_error[row], AHEAD[max(column - 1, 0)]
    state.followed[row] = AHEAD[column]
    if relative_error > ERROR_LIMIT:
        fraction = (ERROR_LIMIT - last_error) / max(relative_error - last_error, 1e-9) if column > 0 else 0.0
        state.followed[row] = last_ahead + min(max(fraction, 0.0), 1.0) * (AHEAD[column] - last_ahead)
        state.exceeded[row], state.uncensored[row] = True, False
    state.last_error[row] = relative_error


@_exact
def evaluate_all(predictions: PredictionColumns, state: ScoringState, flight: tuple, evaluated: np.ndarray) -> int:
    """Score the look-aheads that have been flown, of every open prediction.

    Args:
        predictions, state: one row each
        flight: times, rising, (n,) [s since 1970], positions, NED, (n, 3) [m], and times and path lengths, (m, 2)
        evaluated: rows and columns that were evaluated, those in telemetry gaps included, filled in, (k, 2)
    Returns:
        how many
    """
    t, positions, odometer = flight
    n, until, error, axes = 0, t[-1], np.empty(3), np.empty(3)
    for row in range(len(predictions.t0)):
        if not state.live[row]:
            continue
        for column in range(state.next_column[row], predictions.size[row]):
            instant = predictions.t0[row] + AHEAD[column]
            if not instant <= until:
                break
            evaluated[n, 0], evaluated[n, 1] = row, column
            n += 1
            state.next_column[row] = column + 1
            if state.start_length[row] != state.start_length[row]:
                state.start_length[row] = _length_until(predictions.t0[row], odometer)
            k = _row_before(instant, t)
            if not (t[k + 1] - t[k] <= _GAP_S and instant >= t[0] - 1e-6):
                state.uncensored[row] = False
                continue
            for i in range(3):
                error[i] = (
                    _interpolate(instant, t[k], t[k + 1], positions[k, i], positions[k + 1, i])
                    - predictions.path[row, column, i]
                )
            c, s = predictions.direction[row, column, 0], predictions.direction[row, column, 1]
            axes[0], axes[1], axes[2] = error[0] * c + error[1] * s, error[1] * c - error[0] * s, error[2]
            max_ratio = 0.0
            for i in range(3):
                max_ratio = max(max_ratio, abs(axes[i]) / predictions.tube[row, column, i])
            state.score[row, column] = max_ratio
            if state.uncensored[row]:
                length = max(_length_until(instant, odometer) - state.start_length[row], predictions.min_length[row])
                _update_passage(row, column, sqrt(error[0] ** 2 + error[1] ** 2 + error[2] ** 2) / length, state)
        state.live[row] = state.next_column[row] < predictions.size[row]
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
