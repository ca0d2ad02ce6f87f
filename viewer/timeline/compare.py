"""Compare a past prediction with the flown path: errors, band, coverage."""

from typing import NamedTuple

import numpy as np

from viewer.scene.selection.pins import path_frame
from viewer.store.forecast import ScenePrediction
from viewer.store.place import UNIT_M

STEPS_S = (5.0, 10.0, 20.0, 30.0, 60.0, 120.0)  # look-aheads compared in the text [s]
ERROR_LINE_S = 5.0  # between error lines [s]


class LeadTimeError(NamedTuple):
    """Prediction error at one look-ahead."""

    ahead: float  # from the time shown [s]
    distance: float  # distance between predicted and flown position [m]
    band: float  # cross-track half-axis of the prediction region [m]
    inside: bool  # flown position within all three half-axes


def predicted_and_actual(
    forecast: ScenePrediction, track: np.ndarray, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return predicted and flown positions at some times.

    Args:
        forecast: the prediction
        track: the flown path, (n, 4) time [s], scene ENU [10 m]
        times: data times [s since 1970], (k,)
    Returns:
        predicted and flown, each (k, 3) [10 m]
    """
    actual = np.stack([np.interp(times, track[:, 0], track[:, k]) for k in (1, 2, 3)], axis=-1)
    return forecast.position_at(times - forecast.t), actual


def answered_until(forecast: ScenePrediction, track: np.ndarray) -> float:
    """Return the time up to which a prediction can be compared: horizon or newest row [s since 1970]."""
    return min(forecast.t + forecast.horizon_s, float(track[-1, 0])) if len(track) else forecast.t


def lead_time_errors(forecast: ScenePrediction, track: np.ndarray, shown_t: float) -> list[LeadTimeError]:
    """Compute the errors at the look-aheads `STEPS_S` from the time shown, `shown_t` [s since 1970]."""
    ahead = np.array([step for step in STEPS_S if shown_t + step <= answered_until(forecast, track)])
    if not len(ahead):
        return []
    times = shown_t + ahead
    predicted, actual = predicted_and_actual(forecast, track, times)
    cross, up = path_frame(forecast.path)
    k = np.clip(np.searchsorted(forecast.ahead, times - forecast.t), 0, len(forecast.path) - 1)
    along = np.cross(cross, up)[k]
    offsets = (actual - predicted) * UNIT_M
    parts = np.abs(np.stack([np.sum(offsets * axis, axis=1) for axis in (along, cross[k], up[k])], axis=-1))
    axes = forecast.half_axes_at(times - forecast.t) * UNIT_M
    inside = (parts <= axes).all(axis=1)
    return [
        LeadTimeError(float(s), float(np.linalg.norm(d)), float(a[1]), bool(h))
        for s, d, a, h in zip(ahead, offsets, axes, inside, strict=True)
    ]


def error_lines(forecast: ScenePrediction, track: np.ndarray, shown_t: float) -> np.ndarray:
    """Return lines from predicted to flown positions every 5 s from the time shown: (k, 2, 3) [10 m]."""
    times = np.arange(shown_t + ERROR_LINE_S, answered_until(forecast, track), ERROR_LINE_S)
    return np.stack(predicted_and_actual(forecast, track, times), axis=1) if len(times) else np.zeros((0, 2, 3))
