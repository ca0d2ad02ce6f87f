"""Prediction errors against the recorded flight: along, cross and vertical; relative error M1 and its first passage.

M1 is |p_hat - p| / max(path flown, 2 s of ground speed). Every function accepts one prediction or a batch.
"""

from math import sqrt

import numba as nb
import numpy as np

AHEAD = np.concatenate([np.arange(0.0, 61.0), np.arange(64.0, 181.0, 4.0)])  # look-ahead of every prediction, (91,) [s]
ERROR_LIMIT = 0.10  # relative error that ends the confidence horizon [-]
NOMINAL_COVERAGE = 0.9  # nominal coverage of tube and horizon [-]
_FLOOR_S = 2.0  # minimum path length, in seconds of ground speed [s]
_FLOOR_M = 5.0  # and at least this: ten times the position error of a GNSS receiver in hover [m]


def track_frame(path: np.ndarray, ahead: np.ndarray = AHEAD) -> np.ndarray:
    """Return the horizontal unit vector along paths (..., n, 3), (..., n, 2); north where the path is stationary."""
    out = np.empty((*path.shape[:-1], 2))
    paths = np.ascontiguousarray(path, float).reshape(-1, *path.shape[-2:])
    _fill_track_frames(paths, np.ascontiguousarray(ahead, float), out.reshape(-1, path.shape[-2], 2))
    return out


@nb.njit(cache=True, error_model="numpy", nogil=True, _nrt=False)  # type: ignore[call-overload]  # no fastmath
def _fill_track_frames(path: np.ndarray, t: np.ndarray, out: np.ndarray) -> None:
    """Compute the unit vectors of each path into `out`, (m, n, 2): slope over uneven times, second order inside."""
    n = path.shape[1]
    for i in range(len(path)):
        for k in range(n):
            first, last = max(k - 1, 0), min(k, n - 2)
            east, north = 0.0, 0.0
            weight_before = (t[k + 1] - t[k]) / (t[k + 1] - t[k - 1]) if 0 < k < n - 1 else 1.0  # nearer side
            for j in range(first, last + 1):
                weight, step = (weight_before if j == first else 1.0 - weight_before), t[j + 1] - t[j]
                north += weight * ((path[i, j + 1, 0] - path[i, j, 0]) / step)
                east += weight * ((path[i, j + 1, 1] - path[i, j, 1]) / step)
            length = sqrt(north * north + east * east)
            stationary = length <= 1e-6  # false for nan
            out[i, k, 0], out[i, k, 1] = (1.0, 0.0) if stationary else (north / length, east / length)


def along_cross_down(tangent: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Convert NED errors (..., 3) to along, cross, vertical, by the unit vector along the path, (..., 2) [m]."""
    along_error = error[..., 0] * tangent[..., 0] + error[..., 1] * tangent[..., 1]
    cross_error = error[..., 1] * tangent[..., 0] - error[..., 0] * tangent[..., 1]
    return np.stack([along_error, cross_error, error[..., 2]], axis=-1)


def displacement_along_path(path: np.ndarray, along_error: np.ndarray, ahead: np.ndarray = AHEAD) -> np.ndarray:
    """Return the cross-track and vertical errors of an aircraft that flies the predicted path early or late.

    It then lies `along_error` ahead of or behind the predicted position. On a straight and level path both errors are
    zero; where the path turns or climbs they are not.

    Args:
        path: predicted positions, NED, (..., n, 3) [m]
        along_error: along-track error at each position, not negative, (..., n) [m]
        ahead: look-ahead of each position, (n,) [s]
    Returns:
        zero along; root mean square of both displacements across and vertical, (..., n, 3) [m]
    """
    out = np.zeros(path.shape)
    n = path.shape[-2]
    paths = np.ascontiguousarray(path, float).reshape(-1, n, 3)
    errors = np.ascontiguousarray(along_error, float).reshape(-1, n)
    _fill_displacements(paths, track_frame(paths, ahead), errors, out.reshape(-1, n, 3))
    return out


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _fill_displacements(path: np.ndarray, tangent: np.ndarray, along_error: np.ndarray, out: np.ndarray) -> None:
    """Compute the displacements of each path into `out`, (m, n, 3); beyond an end of the path the other side counts."""
    n = path.shape[1]
    length = np.zeros(n)
    for i in range(len(path)):
        for k in range(1, n):
            north, east = path[i, k, 0] - path[i, k - 1, 0], path[i, k, 1] - path[i, k - 1, 1]
            length[k] = length[k - 1] + sqrt(north * north + east * east)
        for k in range(n):
            cross2 = vertical2 = 0.0
            sides = 0
            for sign in (-1.0, 1.0):
                target, j = length[k] + sign * along_error[i, k], k
                if target < 0.0 if sign < 0.0 else target > length[n - 1] and sides:
                    continue  # the path does not reach so far; the other side counts
                sides += 1
                while j > 0 and length[j] > target:
                    j -= 1
                while j < n - 2 and length[j + 1] < target:
                    j += 1
                step = length[j + 1] - length[j] if j < n - 1 else 0.0
                fraction = min(max((target - length[j]) / step, 0.0), 1.0) if step > 0.0 else 0.0
                following, rest = min(j + 1, n - 1), 1.0 - fraction
                # Hermite cubic between the tangents at both positions, because an arc of several seconds is no chord
                weight, slope = fraction * fraction * (3.0 - 2.0 * fraction), step * fraction * rest
                start, end = tangent[i, j], tangent[i, following]
                north = path[i, j, 0] + weight * (path[i, following, 0] - path[i, j, 0]) - path[i, k, 0]
                east = path[i, j, 1] + weight * (path[i, following, 1] - path[i, j, 1]) - path[i, k, 1]
                north += slope * (rest * start[0] - fraction * end[0])
                east += slope * (rest * start[1] - fraction * end[1])
                down = path[i, j, 2] + fraction * (path[i, following, 2] - path[i, j, 2]) - path[i, k, 2]
                cross = east * tangent[i, k, 0] - north * tangent[i, k, 1]
                cross2, vertical2 = cross2 + cross * cross, vertical2 + down * down
            out[i, k, 1], out[i, k, 2] = sqrt(cross2 / sides), sqrt(vertical2 / sides)


def axes_error(path: np.ndarray, actual: np.ndarray, ahead: np.ndarray = AHEAD) -> np.ndarray:
    """Split errors of paths (..., n, 3) into along, cross, vertical and distance, (..., n, 4) [m]."""
    error = actual - path
    parts = along_cross_down(track_frame(path, ahead), error)
    return np.abs(np.concatenate([parts, np.linalg.norm(error, axis=-1, keepdims=True)], axis=-1))


def path_length(path: np.ndarray, speed: float, length_before: float = 0.0) -> np.ndarray:
    """Return the cumulative path length, at least `min_path_length`, (n,) [m].

    Args:
        path: positions, (n, 3) [m]
        speed: over ground at the start [m/s]
        length_before: length flown before the first position [m]
    """
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    return np.maximum(length_before + length, min_path_length(speed))


def min_path_length(speed: float) -> float:
    """Return the minimum path length: two seconds of ground speed, at least 5 m [m]."""
    return max(_FLOOR_S * speed, _FLOOR_M)


def first_passage(relative: np.ndarray, ahead: np.ndarray = AHEAD) -> tuple[float, bool]:
    """Return the time at which the relative error first exceeds 10 % [s], and whether it is censored.

    A censored flight never exceeds 10 %; its time is that of the last finite value before the first non-finite one.
    """
    not_finite = np.flatnonzero(~np.isfinite(relative))
    n = int(not_finite[0]) if len(not_finite) else len(relative)
    exceeded = np.flatnonzero(relative[:n] > ERROR_LIMIT)
    if not len(exceeded):
        return float(ahead[max(n - 1, 0)]), True
    k = int(exceeded[0])
    if k == 0:
        return 0.0, False
    fraction = (ERROR_LIMIT - relative[k - 1]) / (relative[k] - relative[k - 1])
    return float(ahead[k - 1] + fraction * (ahead[k] - ahead[k - 1])), False
