"""How predictions fared against the flight: along, across and down; the relative error M1 and its first passage.

M1 is |p_hat - p| / max(path flown, 2 s of ground speed). Every function takes one prediction or many at once.
"""

import numpy as np

AHEAD = np.concatenate([np.arange(0.0, 61.0), np.arange(64.0, 181.0, 4.0)])  # look-ahead of every prediction, (91,) [s]
LIMIT = 0.10  # relative error at which trust ends [-]
QUANTILE = 0.9  # share of flights that tube and horizon are meant to hold [-]
_NORTH = np.array([1.0, 0.0])
_FLOOR_S = 2.0  # least path length, as seconds of ground speed [s]


def track_frame(path: np.ndarray, ahead: np.ndarray = AHEAD) -> np.ndarray:
    """Give the horizontal unit vector along paths (..., n, 3) at each point, (..., n, 2); north where one stands."""
    step = _slope(path[..., :2], ahead[: path.shape[-2]])
    length = np.sqrt(step[..., 0] ** 2 + step[..., 1] ** 2)[..., None]
    still = length <= 1e-6
    return np.where(still, _NORTH, step / np.where(still, 1.0, length))


def _slope(x: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Give the slope of x (..., n, 2) over uneven times (n,), of second order inside, (..., n, 2)."""
    rate = np.diff(x, axis=-2) / np.diff(t)[:, None]
    before = (np.diff(t)[1:] / (t[2:] - t[:-2]))[:, None]  # the nearer side weighs more
    out = np.empty_like(x)
    out[..., 1:-1, :] = before * rate[..., :-1, :] + (1.0 - before) * rate[..., 1:, :]
    out[..., 0, :], out[..., -1, :] = rate[..., 0, :], rate[..., -1, :]
    return out


def along_cross_down(along: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Turn NED errors (..., 3) into along, cross, vertical, by the unit vector along the path, (..., 2) [m]."""
    ahead = error[..., 0] * along[..., 0] + error[..., 1] * along[..., 1]
    across = error[..., 1] * along[..., 0] - error[..., 0] * along[..., 1]
    return np.stack([ahead, across, error[..., 2]], axis=-1)


def axes_error(path: np.ndarray, flown: np.ndarray, ahead: np.ndarray = AHEAD) -> np.ndarray:
    """Split errors of paths (..., n, 3) into along, cross, vertical and distance, (..., n, 4) [m]."""
    error = flown - path
    parts = along_cross_down(track_frame(path, ahead), error)
    return np.abs(np.concatenate([parts, np.linalg.norm(error, axis=-1, keepdims=True)], axis=-1))


def path_length(path: np.ndarray, speed: float, before: float = 0.0) -> np.ndarray:
    """Give the path length so far, at least two seconds of ground speed, (n,) [m].

    Args:
        path: positions, (n, 3) [m]
        speed: over ground at the start [m/s]
        before: length flown before the first of them [m]
    """
    flown = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    return np.maximum(before + flown, least_length(speed))


def least_length(speed: float) -> float:
    """Give the length below which no path counts: two seconds of ground speed, at least a metre [m]."""
    return max(_FLOOR_S * speed, 1.0)


def first_passage(relative: np.ndarray, ahead: np.ndarray = AHEAD) -> tuple[float, bool]:
    """Give the time the relative error first passes 10 % [s], and whether it never did while it was followed.

    The flight was followed up to the first that is not finite; the time is then that of the last before.
    """
    broken = np.flatnonzero(~np.isfinite(relative))
    n = int(broken[0]) if len(broken) else len(relative)
    over = np.flatnonzero(relative[:n] > LIMIT)
    if not len(over):
        return float(ahead[max(n - 1, 0)]), True
    k = int(over[0])
    if k == 0:
        return 0.0, False
    share = (LIMIT - relative[k - 1]) / (relative[k] - relative[k - 1])
    return float(ahead[k - 1] + share * (ahead[k] - ahead[k - 1])), False
