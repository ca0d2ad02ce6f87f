"""Present ground velocity: reported, or from the positions where the reported one contradicts them."""

from functools import lru_cache

import numpy as np

MEAN_S = 1.0  # over which the newest reported velocities are compared with the positions [s]
_FIT_S = 1.0  # newest positions in the fit of a parabola [s]
_COMPARED_S = 20.0  # flight over which both are compared [s]
_CLEARLY = 0.7  # ratio of the errors below which the velocity from positions replaces the reported one [-]


def present_velocity(p: np.ndarray, v: np.ndarray, dt: float, rows: int) -> np.ndarray:
    """Return the ground velocity at the end of gap-free flight, NED, (3,) [m/s].

    An estimator with a wrong attitude reports a velocity that is not the derivative of its positions. Both are compared
    with the displacement over a second around each row.

    Args:
        p, v: positions and reported velocities, newest last, NED, (n, 3) [m, m/s]
        dt: interval of the rows [s]
        rows: newest rows in the mean of the reported velocity
    """
    n, half = round(_FIT_S / dt), round(0.5 / dt)
    p, v = p[-round(_COMPARED_S / dt) :], v[-round(_COMPARED_S / dt) :]
    reported = v[-rows:].mean(axis=0)
    if len(p) < 4 * n or not np.isfinite(p).all():
        return reported
    slope = _slope_of_parabola(n, dt)
    fitted = np.stack([np.convolve(column, slope[::-1], "valid") for column in p.T], axis=-1)  # from row n on
    displaced = (p[2 * half :] - p[: -2 * half]) / (2 * half * dt)  # around row `half` and later
    integral = np.vstack([np.zeros(3), np.cumsum(0.5 * dt * (v[1:] + v[:-1]), axis=0)])
    mean_reported = (integral[2 * half :] - integral[: -2 * half]) / (2 * half * dt)
    error_reported = np.linalg.norm((mean_reported - displaced)[:, :2], axis=1)
    error_fitted = np.linalg.norm((fitted[:-half] - displaced[n - half :])[:, :2], axis=1)
    if np.sqrt(np.mean(error_fitted**2)) < _CLEARLY * np.sqrt(np.mean(error_reported**2)):
        return np.array([*fitted[-1, :2], reported[2]])
    return reported


@lru_cache
def _slope_of_parabola(n: int, dt: float) -> np.ndarray:
    """Return the slope at the end of a parabola through n + 1 rows, by position, (n + 1,) [1/s]."""
    slope: np.ndarray = np.linalg.pinv(np.vander(dt * np.arange(-n, 1), 3, increasing=True))[1]
    return slope


def corrected_velocity(t: np.ndarray, p: np.ndarray, velocity_t: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the newest reported ground velocity, corrected by the displacement, NED, (3,) [m/s]; nan if unknown.

    The mean difference of reported velocity and displacement over a second, an error of the estimator, is subtracted.

    Args:
        t, p: times and positions, newest last, NED, (n,) and (n, 3) [s, m]
        velocity_t, v: times and reported velocities, newest last, NED, (k,) and (k, 3) [s, m/s]
    """
    unknown = np.full(3, np.nan)
    if not len(t) or not len(velocity_t):
        return unknown
    newest = min(t[-1], velocity_t[-1])
    first, first_v = int(t.searchsorted(newest - MEAN_S)), int(velocity_t.searchsorted(newest - MEAN_S))
    duration, duration_v = t[-1] - t[first], velocity_t[-1] - velocity_t[first_v]
    if max(t[-1], velocity_t[-1]) - newest > MEAN_S or min(duration, duration_v) < 0.5 * MEAN_S:
        return unknown
    v, steps = v[first_v:], np.diff(velocity_t[first_v:])
    mean = 0.5 * steps @ (v[1:] + v[:-1]) / duration_v
    return v[-1] + (p[-1] - p[first]) / duration - mean
