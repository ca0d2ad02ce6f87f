"""Write our predictions and the flown positions to a file for independent scoring."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.special import ndtri

from fleet.frames import to_geodetic
from twin_worker.evaluation.scoring.case import OURS, EvaluationCase
from twin_worker.numerics.prediction_errors import NOMINAL_COVERAGE, path_length, track_frame

KEYS = {
    "t0": "start, (s,) [s since 1970]",
    "t": "predicted instants, (s, k) [s since 1970]",
    "latitude": "(s, k) [deg]",
    "longitude": "(s, k) [deg]",
    "altitude": "above mean sea level, (s, k) [m]",
    "covariance": "of the normal distribution equivalent to the tube, NED, (s, k, 3, 3) [m2]",
    "horizon": "confidence horizon, (s,) [s]",
    "flight": "recording and aircraft, (s,)",
    "uav": "id, (s,)",
    "apart": "reason for exclusion of a start; empty: included, (s,)",
    "ahead": "look-ahead, (k,) [s]",
    "path": "predicted, NED from the aircraft's first position; nan beyond its end, (s, k, 3) [m]",
    "tube": "half-axes along, cross, vertical, (s, k, 3) [m]",
    "spread": "standard deviations of the ensemble along, cross, vertical; nan without one, (s, k, 3) [m]",
    "flown": "flown positions, NED; nan where unknown or after an event, (s, k, 3) [m]",
    "length": "path flown so far, at least two seconds of ground speed, (s, k) [m]",
    "predicted_length": "the same along the prediction, (s, k) [m]",
    "group": "method / law / vehicle / parameters, (s,)",
    "method": "prediction method, (s,)",
}


def write_predictions(path: Path, cases: Sequence[EvaluationCase]) -> None:
    """Write our predictions and the flown positions; keys and units: `KEYS`."""
    rows = [_row(case) for case in cases]
    arrays = {name: np.array([row[name] for row in rows]) for name in KEYS if name != "ahead"}
    np.savez_compressed(path, ahead=cases[0].start.ahead, **arrays)  # type: ignore[arg-type]


def _row(case: EvaluationCase) -> dict[str, object]:
    start, forecast = case.start, case.start.forecasts[OURS]
    geodetic, valid = np.full(forecast.path.shape, np.nan), np.isfinite(forecast.path).all(axis=1)
    geodetic[valid] = to_geodetic(start.origin, forecast.path[valid]) * np.array([1e-7, 1e-7, 1e-3])
    assert forecast.tube is not None
    return {
        "t0": start.t,
        "t": start.t + start.ahead,
        "latitude": geodetic[:, 0],
        "longitude": geodetic[:, 1],
        "altitude": geodetic[:, 2],
        "covariance": covariance(forecast.path, forecast.tube).astype(np.float32),
        "horizon": forecast.horizon_s,
        "flight": start.flight,
        "uav": start.uav,
        "apart": case.exclusion,
        "path": forecast.path,
        "tube": forecast.tube,
        "spread": start.spread,
        "flown": case.positions,
        "length": case.length,
        "predicted_length": path_length(forecast.path, start.speed),
        "group": start.group,
        "method": forecast.source,
    }


def covariance(path: np.ndarray, tube: np.ndarray) -> np.ndarray:
    """Return the NED covariance of independent normal errors with the coverage of the tube, (k, 3, 3) [m2]."""
    sigma = tube / ndtri(0.5 + 0.5 * NOMINAL_COVERAGE ** (1 / 3))
    along = track_frame(path)
    axes = np.zeros((len(path), 3, 3))
    axes[:, :2, 0] = along
    axes[:, 0, 1], axes[:, 1, 1] = -along[:, 1], along[:, 0]
    axes[:, 2, 2] = 1.0
    return np.einsum("kij,kj,klj->kil", axes, sigma**2, axes)
