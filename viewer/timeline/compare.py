"""Compare a past prediction with the flown path: errors, band, coverage."""

from typing import NamedTuple

import numpy as np

from viewer.scene.selection.tube import frame_of
from viewer.store.forecast import Forecast
from viewer.store.place import UNIT_M

STEPS_S = (5.0, 10.0, 20.0, 30.0, 60.0, 120.0)  # look-aheads compared in the text [s]
WHISKER_S = 5.0  # between error lines [s]


class Miss(NamedTuple):
    """Prediction error at one look-ahead."""

    ahead: float  # from the time shown [s]
    miss: float  # distance between predicted and flown position [m]
    band: float  # cross-track half-axis of the prediction region [m]
    held: bool  # flown position within all three half-axes


def answered(told: Forecast, flown: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return predicted and flown positions at some times.

    Args:
        forecast: the prediction
        track: the flown path, (n, 4) time [s], scene ENU [10 m]
        times: data times [s since 1970], (k,)
    Returns:
        predicted and flown, each (k, 3) [10 m]
    """
    happened = np.stack([np.interp(at, flown[:, 0], flown[:, k]) for k in (1, 2, 3)], axis=-1)
    return told.at(at - told.t), happened


def until(told: Forecast, flown: np.ndarray) -> float:
    """Return the time up to which a prediction can be compared: horizon or newest row [s since 1970]."""
    return min(told.t + told.until, float(flown[-1, 0])) if len(flown) else told.t


def misses(told: Forecast, flown: np.ndarray, then: float) -> list[Miss]:
    """Compute the errors at the look-aheads `STEPS_S` from the time shown, `shown_t` [s since 1970]."""
    ahead = np.array([step for step in STEPS_S if then + step <= until(told, flown)])
    if not len(ahead):
        return []
    at = then + ahead
    predicted, happened = answered(told, flown, at)
    cross, up = frame_of(told.path)
    k = np.clip(np.searchsorted(told.ahead, at - told.t), 0, len(told.path) - 1)
    along = np.cross(cross, up)[k]
    off = (happened - predicted) * UNIT_M
    parts = np.abs(np.stack([np.sum(off * axis, axis=1) for axis in (along, cross[k], up[k])], axis=-1))
    axes = told.width(at - told.t) * UNIT_M
    held = (parts <= axes).all(axis=1)
    return [
        Miss(float(s), float(np.linalg.norm(d)), float(a[1]), bool(h))
        for s, d, a, h in zip(ahead, off, axes, held, strict=True)
    ]


def whiskers(told: Forecast, flown: np.ndarray, then: float) -> np.ndarray:
    """Return lines from predicted to flown positions every 5 s from the time shown: (k, 2, 3) [10 m]."""
    at = np.arange(then + WHISKER_S, until(told, flown), WHISKER_S)
    return np.stack(answered(told, flown, at), axis=1) if len(at) else np.zeros((0, 2, 3))
