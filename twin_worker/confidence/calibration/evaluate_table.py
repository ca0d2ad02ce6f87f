"""Evaluation of tables on given predictions: coverage, half-axes and horizons, with and without adaptation."""

from collections.abc import Iterable

import numpy as np
from scipy.stats import spearmanr

from twin_worker.confidence.calibration.fit_table import fit
from twin_worker.confidence.calibration.scored_predictions import Scored
from twin_worker.confidence.calibration_table import LEVELS, QUANTILE, Table
from twin_worker.confidence.horizon_risk import growth
from twin_worker.confidence.table_files import Tables
from twin_worker.confidence.tube_and_horizon import Made, Record
from twin_worker.numerics.prediction_errors import AHEAD, first_passage

SAID_S = (5, 16, 30, 60, 120, 180)
_COLUMNS = np.searchsorted(AHEAD, SAID_S)
Claims = tuple[np.ndarray, np.ndarray]  # tubes (s, k, 3) [m], horizons (s,) [s]


def claimed(table: Table, scored: Scored) -> Claims:
    """Return the regions of predictions from a table without adaptation."""
    tube = table.half_axes(scored.doubt, AHEAD)
    ratio = growth(tube, scored.predicted_length) * np.interp(QUANTILE, LEVELS, table.risks)
    return tube, np.array([first_passage(one)[0] for one in ratio])


def adapted(tables: Tables, scored: Scored) -> Claims:
    """Return the regions of predictions with adaptation in flight, each flight in time order."""
    tube, horizon = np.empty(scored.path.shape), np.empty(len(scored))
    for flight in dict.fromkeys(scored.flight.tolist()):
        rows = np.flatnonzero(scored.flight == flight)
        rows = rows[np.argsort(scored.t0[rows])]
        t, flown = _flight(scored.part(rows))
        record = Record(tables)
        for r in rows:
            seen = t <= scored.t0[r]
            record.answer(t[seen][-30:], flown[seen][-30:])
            speed = float(scored.length[r, 0] / 2.0)
            made = Made(
                scored.t0[r], scored.method[r], scored.group[r], AHEAD, scored.path[r], speed, scored.doubt.spread[r]
            )
            trust = record.trust(made)
            record.keep(made, trust)
            tube[r], horizon[r] = trust.tube, trust.horizon_s
    return tube, horizon


def _flight(scored: Scored) -> tuple[np.ndarray, np.ndarray]:
    """Merge the positions flown after each prediction into one flight: times (n,), positions (n, 3)."""
    t = (scored.t0[:, None] + AHEAD).ravel()
    flown = scored.flown.reshape(-1, 3)
    known = np.isfinite(flown).all(axis=1)
    t, first = np.unique(np.round(t[known], 3), return_index=True)
    return t, flown[known][first]


def left_out(scored: Scored, group: str) -> Claims:
    """Return cross-fitted regions: each flight (or each setting of a parent group) from a table fitted without it."""
    folds = scored.folds(group)
    tube, horizon = np.empty(scored.path.shape), np.empty(len(scored))
    for fold in np.unique(folds):
        mine = folds == fold
        tube[mine], horizon[mine] = claimed(fit(scored.part(~mine), group), scored.part(mine))
    return tube, horizon


def figures(scored: Scored, claims: Claims) -> dict[str, float]:
    """Compute coverage, half-axes and horizon figures of regions; shares 0..1, lengths in m, times in s."""
    tube, horizon = claims
    error = scored.errors()
    known: np.ndarray = np.isfinite(error[..., 0])
    inside = np.all(error[..., :3] <= tube, axis=2)
    out = {"coverage": _mean(inside[:, 1:][known[:, 1:]])}
    flights = [_mean(inside[mine, 1:][known[mine, 1:]]) for mine in _each(scored.flight)]
    out["coverage_worst_flight"] = float(np.nanmin(flights))
    for at, j in zip(SAID_S, _COLUMNS, strict=True):
        out[f"coverage_{at}"] = _mean(inside[known[:, j], j])
        for axis, name in enumerate(("along", "cross", "vertical")):
            out[f"{name}_{at}_m"] = float(np.median(tube[:, j, axis]))
    return out | _horizons(error[..., 3] / scored.length, known, horizon)


def _horizons(relative: np.ndarray, known: np.ndarray, horizon: np.ndarray) -> dict[str, float]:
    """Compute horizon figures from the predictions that were followed at least to their horizon."""
    followed = np.array([AHEAD[-1] if row.all() else AHEAD[max(int(row.argmin()) - 1, 0)] for row in known])
    passage = np.array([first_passage(row)[0] for row in relative])
    judged, whole = np.flatnonzero(followed >= horizon), np.flatnonzero(followed >= AHEAD[-1])
    out = {"hit_rate": _mean(passage[judged] >= horizon[judged]), "horizon_median_s": float(np.median(horizon))}
    out["horizon_beyond_60"] = _mean(horizon > 60)
    out["passage_median_s"] = float(np.median(passage[whole])) if len(whole) else float("nan")
    varied = len(whole) > 2 and np.ptp(passage[whole]) > 0 and np.ptp(horizon[whole]) > 0
    out["rank_correlation"] = float(spearmanr(passage[whole], horizon[whole]).statistic) if varied else float("nan")
    return out


def _each(names: np.ndarray) -> Iterable[np.ndarray]:
    return (names == name for name in dict.fromkeys(names.tolist()))


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if values.size else float("nan")


def said(name: str, got: dict[str, float]) -> str:
    """Format figures as a few lines of text."""
    lines = [
        f"{name}: coverage {got['coverage']:.1%}, worst flight {got['coverage_worst_flight']:.0%}; horizon hit "
        f"{got['hit_rate']:.1%}, rank correlation {got['rank_correlation']:.2f}, median {got['horizon_median_s']:.0f} s"
        f" (first passages {got['passage_median_s']:.0f} s), beyond 60 s {got['horizon_beyond_60']:.0%}"
    ]
    for at in SAID_S:
        axes = " / ".join(f"{got[f'{axis}_{at}_m']:.1f}" for axis in ("along", "cross", "vertical"))
        lines.append(f"  at {at:3d} s: coverage {got[f'coverage_{at}']:.1%}, half-axes {axes} m")
    return "\n".join(lines)
