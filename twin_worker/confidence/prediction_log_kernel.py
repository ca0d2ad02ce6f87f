"""Compiled scoring of predictions against the flight, look-ahead by look-ahead."""

from math import sqrt
from typing import NamedTuple

import numba as nb
import numpy as np

from twin_worker.numerics.prediction_errors import AHEAD, LIMIT

_GAP_S = 2.5  # positions farther apart than this are a telemetry gap [s]
_exact = nb.njit(cache=True, error_model="numpy", nogil=True)  # no fastmath: as numpy does it


class Said(NamedTuple):
    """Arrays of `PredictionLog` that describe the predictions, one row each."""

    t0: np.ndarray
    size: np.ndarray
    path: np.ndarray
    along: np.ndarray
    tube: np.ndarray
    least: np.ndarray


class Known(NamedTuple):
    """Arrays of `PredictionLog` that describe the scores so far, changed in place."""

    score: np.ndarray
    next: np.ndarray
    live: np.ndarray
    followed: np.ndarray
    passed: np.ndarray
    watched: np.ndarray
    begun: np.ndarray
    before: np.ndarray


@_exact
def _before(at: float, t: np.ndarray) -> int:
    """Return the row before an instant, at least the first, at most the last but one."""
    k: int = np.searchsorted(t, at)  # type: ignore[assignment]
    return max(min(k, len(t) - 1) - 1, 0)


@_exact
def _between(at: float, t0: float, t1: float, x0: float, x1: float) -> float:
    """Interpolate between two rows as `numpy.interp` does."""
    if at <= t0:
        return x0
    return (x1 - x0) / (t1 - t0) * (at - t0) + x0 if at < t1 else x1


@_exact
def _run(at: float, odometer: np.ndarray) -> float:
    """Return the path length flown until an instant [m]."""
    k = _before(at, odometer[:, 0])
    (t0, x0), (t1, x1) = odometer[k], odometer[min(k + 1, len(odometer) - 1)]
    return _between(at, t0, t1, x0, x1)


@_exact
def _watch(r: int, j: int, relative: float, known: Known) -> None:
    """Update the first passage of an uncensored prediction at one look-ahead."""
    before, last = known.before[r], AHEAD[max(j - 1, 0)]
    known.followed[r] = AHEAD[j]
    if relative > LIMIT:
        share = (LIMIT - before) / max(relative - before, 1e-9) if j > 0 else 0.0
        known.followed[r] = last + min(max(share, 0.0), 1.0) * (AHEAD[j] - last)
        known.passed[r], known.watched[r] = True, False
    known.before[r] = relative


@_exact
def answer_each(said: Said, known: Known, happened: tuple, answered: np.ndarray) -> int:
    """Score the look-aheads that have been flown, of every open prediction.

    Args:
        predictions, state: one row each
        flight: times, rising, (n,) [s since 1970], positions, NED, (n, 3) [m], and times and path lengths, (m, 2)
        evaluated: rows and columns that were evaluated, those in telemetry gaps included, filled in, (k, 2)
    Returns:
        how many
    """
    t, flown, odometer = happened
    n, until, error, axes = 0, t[-1], np.empty(3), np.empty(3)
    for r in range(len(said.t0)):
        if not known.live[r]:
            continue
        for j in range(known.next[r], said.size[r]):
            at = said.t0[r] + AHEAD[j]
            if not at <= until:
                break
            answered[n, 0], answered[n, 1] = r, j
            n += 1
            known.next[r] = j + 1
            if known.begun[r] != known.begun[r]:
                known.begun[r] = _run(said.t0[r], odometer)
            k = _before(at, t)
            if not (t[k + 1] - t[k] <= _GAP_S and at >= t[0] - 1e-6):
                known.watched[r] = False
                continue
            for i in range(3):
                error[i] = _between(at, t[k], t[k + 1], flown[k, i], flown[k + 1, i]) - said.path[r, j, i]
            c, s = said.along[r, j, 0], said.along[r, j, 1]
            axes[0], axes[1], axes[2] = error[0] * c + error[1] * s, error[1] * c - error[0] * s, error[2]
            most = 0.0
            for i in range(3):
                most = max(most, abs(axes[i]) / said.tube[r, j, i])
            known.score[r, j] = most
            if known.watched[r]:
                length = max(_run(at, odometer) - known.begun[r], said.least[r])
                _watch(r, j, sqrt(error[0] ** 2 + error[1] ** 2 + error[2] ** 2) / length, known)
        known.live[r] = known.next[r] < said.size[r]
    return n


@_exact
def run_on(at: np.ndarray, points: np.ndarray, begin: np.ndarray, before: float, out: np.ndarray) -> None:
    """Compute the path length flown until each time, (n, 2) [s since 1970, m].

    Args:
        t, points: times and positions, NED, (n,) and (n, 3) [s since 1970, m]
        start: position at which the first interval begins, (3,) [m]
        start_length: path length flown until there [m]
        out: times and path lengths, filled in
    """
    run, north, east, down = 0.0, begin[0], begin[1], begin[2]
    for k in range(len(at)):
        n, e, d = points[k, 0] - north, points[k, 1] - east, points[k, 2] - down
        run += sqrt(n * n + e * e + d * d)
        out[k, 0], out[k, 1] = at[k], before + run
        north, east, down = points[k, 0], points[k, 1], points[k, 2]
