"""Evaluation of tables on given predictions: coverage, half-axes and horizons, with and without adaptation."""

import numpy as np
from scipy.stats import spearmanr

from twin_worker.confidence.calibration.fit_table import fit
from twin_worker.confidence.calibration.scored_predictions import ScoredPredictions
from twin_worker.confidence.calibration_table import LEVELS, NOMINAL_COVERAGE, CalibrationTable
from twin_worker.confidence.table_files import TableSet
from twin_worker.confidence.tube_and_horizon import ConfidenceTracker, PointForecast
from twin_worker.confidence.weighted_quantile import running_max_error_ratio
from twin_worker.numerics.prediction_errors import AHEAD, first_passage

REPORTED_S = (5, 16, 30, 60, 120, 180)
_COLUMNS = np.searchsorted(AHEAD, REPORTED_S)
Regions = tuple[np.ndarray, np.ndarray]  # tubes (s, k, 3) [m], horizons (s,) [s]


def regions_of_table(table: CalibrationTable, predictions: ScoredPredictions) -> Regions:
    """Return the regions of predictions from a table without adaptation."""
    tube = table.half_axes(predictions.features, AHEAD)
    ratio = running_max_error_ratio(tube, predictions.predicted_length) * np.interp(
        NOMINAL_COVERAGE, LEVELS, table.risks
    )
    return tube, np.array([first_passage(row)[0] for row in ratio])


def regions_adapted(tables: TableSet, predictions: ScoredPredictions) -> Regions:
    """Return the regions of predictions with adaptation in flight, each flight in time order."""
    tube, horizon = np.empty(predictions.path.shape), np.empty(len(predictions))
    for flight in dict.fromkeys(predictions.flight.tolist()):
        rows = np.flatnonzero(predictions.flight == flight)
        rows = rows[np.argsort(predictions.t0[rows])]
        t, positions = _recorded_path(predictions.select(rows))
        tracker = ConfidenceTracker(tables)
        for r in rows:
            past = t <= predictions.t0[r]
            tracker.evaluate(t[past][-30:], positions[past][-30:])
            speed = float(predictions.length[r, 0] / 2.0)
            forecast = PointForecast(
                predictions.t0[r],
                predictions.method[r],
                predictions.group[r],
                AHEAD,
                predictions.path[r],
                speed,
                predictions.features.spread[r],
            )
            confidence = tracker.confidence_of(forecast)
            tracker.add(forecast, confidence)
            tube[r], horizon[r] = confidence.tube, confidence.horizon_s
    return tube, horizon


def _recorded_path(predictions: ScoredPredictions) -> tuple[np.ndarray, np.ndarray]:
    """Merge the positions flown after each prediction into one flight: times (n,), positions (n, 3)."""
    t = (predictions.t0[:, None] + AHEAD).ravel()
    positions = predictions.flown.reshape(-1, 3)
    valid = np.isfinite(positions).all(axis=1)
    t, first = np.unique(np.round(t[valid], 3), return_index=True)
    return t, positions[valid][first]


def regions_cross_fitted(predictions: ScoredPredictions, group: str) -> Regions:
    """Return cross-fitted regions: each flight (or each setting of a parent group) from a table fitted without it."""
    folds = predictions.folds(group)
    tube, horizon = np.empty(predictions.path.shape), np.empty(len(predictions))
    for fold in np.unique(folds):
        in_fold = folds == fold
        tube[in_fold], horizon[in_fold] = regions_of_table(
            fit(predictions.select(~in_fold), group), predictions.select(in_fold)
        )
    return tube, horizon


def figures(predictions: ScoredPredictions, regions: Regions) -> dict[str, float]:
    """Compute coverage, half-axes and horizon figures of regions; shares 0..1, lengths in m, times in s."""
    tube, horizon = regions
    error = predictions.errors()
    valid: np.ndarray = np.isfinite(error[..., 0])
    inside = np.all(error[..., :3] <= tube, axis=2)
    out = {"coverage": _mean(inside[:, 1:][valid[:, 1:]])}
    masks = [predictions.flight == name for name in dict.fromkeys(predictions.flight.tolist())]
    flights = [_mean(inside[in_flight, 1:][valid[in_flight, 1:]]) for in_flight in masks]
    out["coverage_worst_flight"] = float(np.nanmin(flights))
    for ahead_s, j in zip(REPORTED_S, _COLUMNS, strict=True):
        out[f"coverage_{ahead_s}"] = _mean(inside[valid[:, j], j])
        for axis, name in enumerate(("along", "cross", "vertical")):
            out[f"{name}_{ahead_s}_m"] = float(np.median(tube[:, j, axis]))
    return out | _horizon_figures(error[..., 3] / predictions.length, valid, horizon)


def _horizon_figures(relative: np.ndarray, valid: np.ndarray, horizon: np.ndarray) -> dict[str, float]:
    """Compute horizon figures from the predictions that were followed at least to their horizon."""
    followed = np.array([AHEAD[-1] if row.all() else AHEAD[max(int(row.argmin()) - 1, 0)] for row in valid])
    passage = np.array([first_passage(row)[0] for row in relative])
    decided, complete = np.flatnonzero(followed >= horizon), np.flatnonzero(followed >= AHEAD[-1])
    out = {"hit_rate": _mean(passage[decided] >= horizon[decided]), "horizon_median_s": float(np.median(horizon))}
    out["horizon_beyond_60"] = _mean(horizon > 60)
    out["passage_median_s"] = float(np.median(passage[complete])) if len(complete) else float("nan")
    varied = len(complete) > 2 and np.ptp(passage[complete]) > 0 and np.ptp(horizon[complete]) > 0
    out["rank_correlation"] = (
        float(spearmanr(passage[complete], horizon[complete]).statistic) if varied else float("nan")
    )
    return out


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if values.size else float("nan")


def report_text(name: str, figures_by_name: dict[str, float]) -> str:
    """Format figures as a few lines of text."""
    lines = [
        f"{name}: coverage {figures_by_name['coverage']:.1%}, worst flight "
        f"{figures_by_name['coverage_worst_flight']:.0%}; horizon hit "
        f"{figures_by_name['hit_rate']:.1%}, rank correlation {figures_by_name['rank_correlation']:.2f}, "
        f"median {figures_by_name['horizon_median_s']:.0f} s"
        f" (first passages {figures_by_name['passage_median_s']:.0f} s), beyond 60 s "
        f"{figures_by_name['horizon_beyond_60']:.0%}"
    ]
    for ahead_s in REPORTED_S:
        axes = " / ".join(f"{figures_by_name[f'{axis}_{ahead_s}_m']:.1f}" for axis in ("along", "cross", "vertical"))
        lines.append(f"  at {ahead_s:3d} s: coverage {figures_by_name[f'coverage_{ahead_s}']:.1%}, half-axes {axes} m")
    return "\n".join(lines)
