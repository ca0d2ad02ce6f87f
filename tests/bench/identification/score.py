"""How good a model is on what it has not seen: the fit per axis of a 40 s free run, and 4 s, 1 s and one step ahead.

fit = 100 (1 - ||y - y_hat|| / ||y - mean(y)||) per state, between -100 and 100; an axis is the mean of its states.
"""

import numpy as np

from .flight import AXES, STATE_COLUMNS, Flight, Model, Oracle

AHEAD_S = 40.0  # length of the free run [s]
STEPS_S = {"4": 4.0, "1": 1.0, "_step": 0.0}  # k steps ahead from every start, one at least [s]
KEYS = tuple(axis + end for end in ("40", *STEPS_S) for axis in AXES)
_WORST = -100.0


def fit_percent(y: np.ndarray, y_hat: np.ndarray, ok: np.ndarray) -> np.ndarray:
    """Give the fit of each column over the good rows, (n,) [%]; the worst where anything is not finite."""
    y, e = y[ok], y[ok] - y_hat[ok]
    if len(y) < 2:
        return np.full(y.shape[1], np.nan)
    with np.errstate(over="ignore", invalid="ignore"):
        spread = np.linalg.norm(y - y.mean(axis=0), axis=0)
        fit = 100.0 * (1.0 - np.linalg.norm(e, axis=0) / np.maximum(spread, 1e-9))
    return np.clip(np.nan_to_num(fit, nan=_WORST, posinf=_WORST, neginf=_WORST), _WORST, 100.0)


def scores(model: Model, flight: Flight, start: int, stop: int) -> dict[str, float]:
    """Score a model identified before row `start` on the rows `start` to `stop`."""
    ahead = flight.part(start, stop)
    run = model.forecast(flight.part(0, start), ahead.u)
    found = per_axis("40", ahead.x, run, ahead.ok)
    for end, k in steps(flight.dt).items():
        both = ahead.ok[k:] & ahead.ok[:-k]
        found |= per_axis(end, ahead.x[k:], model.kstep(ahead, k), both)
    return found


def ceiling(oracle: Oracle, flight: Flight, start: int, stop: int) -> dict[str, float]:
    """Score the truth on the same rows; where it says nothing it is not asked."""
    ahead = flight.part(start, stop)
    found = per_axis("40", ahead.x, oracle.forecast(start, stop - start), ahead.ok)
    for end, k in steps(flight.dt).items():
        told = oracle.kstep(start, stop, k)
        both = ahead.ok[k:] & ahead.ok[:-k] & np.isfinite(told).all(axis=1)
        found |= per_axis(end, ahead.x[k:], told, both)
    return found


def steps(dt: float) -> dict[str, int]:
    """Give the number of samples of each short horizon."""
    return {end: max(round(seconds / dt), 1) for end, seconds in STEPS_S.items()}


def per_axis(end: str, y: np.ndarray, y_hat: np.ndarray, ok: np.ndarray) -> dict[str, float]:
    """Give the mean fit of both axes' states under the keys lon… and lat…; y and y_hat (n, 9)."""
    columns = STATE_COLUMNS.items()
    return {axis + end: float(np.mean(fit_percent(y[:, at], y_hat[:, at], ok))) for axis, at in columns}
