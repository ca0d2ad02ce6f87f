"""Summary figures of every method over the included starts, for table and JSON."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.stats

from twin_worker.evaluation.scoring.compare import MIN_EVENT_FREE_S, compare
from twin_worker.evaluation.scoring.log import EvaluationCase
from twin_worker.evaluation.scoring.score import LIMITS, MethodScores, passage_quantile, score_method, survival_at
from twin_worker.telemetry.flight_phase import PHASES

REPORTED_S = (5, 10, 16, 30, 60, 120, 180)  # reported look-aheads, as far as predictions reach [s]
_PASSAGE_KEYS = ("t10", "t5", "t3")


def summarise(cases: Sequence[EvaluationCase]) -> dict[str, Any]:
    """Compute the figures of every method, the comparison with ours, and the excluded starts.

    Keys: every method's name; `compare`, by method; `apart`, excluded starts by reason.
    """
    counted = [case for case in cases if not case.exclusion]
    names = list(dict.fromkeys(name for case in counted for name in case.start.forecasts))
    complete = [case for case in counted if set(names) == set(case.start.forecasts)]  # every method on the same starts
    scores = {name: score_method(complete, name) for name in names} if complete else {}
    out: dict[str, Any] = {
        name: method_figures(method_scores) | {"phases": _phase_figures(complete, name)}
        for name, method_scores in scores.items()
    }
    out["compare"] = compare(scores)
    out["apart"] = _exclusion_figures(cases)
    return out


def short_flights(cases: Sequence[EvaluationCase]) -> list[str]:
    """Return the flights whose mission is too short for full starts; they are scored as far as they go."""
    return sorted({case.start.flight for case in cases if not case.exclusion and _is_short(case)})


def _is_short(case: EvaluationCase) -> bool:
    """Return whether the flight after a start is known for less than is required elsewhere."""
    known = case.start.ahead[np.isfinite(case.positions).all(axis=1)]
    return not len(known) or float(known[-1]) < MIN_EVENT_FREE_S - 1e-6


def method_figures(method_scores: MethodScores) -> dict[str, Any]:
    """Compute the figures of one method."""
    columns = _reported_columns(method_scores)
    sources = Counter(method_scores.source.tolist())
    out: dict[str, Any] = {}
    for name, limit in zip(_PASSAGE_KEYS, LIMITS, strict=True):
        out[f"m1_{name}_lq_s"] = _round(passage_quantile(method_scores.passages[limit], 0.25))
        out[f"m1_{name}_median_s"] = _round(passage_quantile(method_scores.passages[limit], 0.5))
    out |= _error_figures(method_scores)
    out["m2_t10_lq_s"] = _round(passage_quantile(method_scores.m2_passages, 0.25))
    for i, axis in enumerate(("along", "cross", "vertical")):
        out[f"{axis}_p50_m"] = {
            s: _round(_percentile(np.abs(method_scores.error[:, k, i]), 50)) for s, k in columns.items()
        }
    out |= _region_figures(method_scores, columns)
    return out | {
        "starts": len(method_scores.flight),
        "flights": len(set(method_scores.flight.tolist())),
        "made_by": dict(sources.most_common()),
    }


def _reported_columns(method_scores: MethodScores) -> dict[str, int]:
    return {str(s): column for s in REPORTED_S if (column := method_scores.column_at(s)) is not None}


def _error_figures(method_scores: MethodScores) -> dict[str, Any]:
    """Compute survival and quantiles of the error by look-ahead."""
    columns = _reported_columns(method_scores)
    return {
        "followed_s": _max_followed(method_scores),
        "survive_60": _round(survival_at(method_scores.passages[LIMITS[0]], MIN_EVENT_FREE_S), 3),
        "p50_m": {s: _round(_percentile(method_scores.distance[:, k], 50)) for s, k in columns.items()},
        "p90_m": {s: _round(_percentile(method_scores.distance[:, k], 90)) for s, k in columns.items()},
    }


def _region_figures(method_scores: MethodScores, columns: dict[str, int]) -> dict[str, Any]:
    """Compute coverage and size of the tube, and accuracy of the horizon; null for a method without them."""
    inside = method_scores.inside
    by_flight = [inside[method_scores.flight == name] for name in np.unique(method_scores.flight)]
    worst = {s: min((_mean(rows[:, k]) for rows in by_flight), default=np.nan) for s, k in columns.items()}
    sizes = {s: [_round(_percentile(method_scores.tube[:, k, i], 50)) for i in range(3)] for s, k in columns.items()}
    hit, corr = _horizon_scores(method_scores)
    return {
        "coverage": {s: _round(_mean(inside[:, k]), 3) for s, k in columns.items()},
        "coverage_worst_flight": {s: _round(value, 3) for s, value in worst.items()},
        "half_axes_m": sizes,
        "horizon_hit_rate": _round(hit, 3),
        "horizon_rank_corr": _round(corr, 3),
        "horizon_median_s": _round(_percentile(method_scores.horizon, 50)),
    }


def _horizon_scores(method_scores: MethodScores) -> tuple[float, float]:
    """Compute the share that stayed within 10 % up to its horizon, and Spearman's correlation of horizon and passage.

    A horizon beyond the follow-up time is evaluated up to that time.
    """
    valid = np.isfinite(method_scores.horizon)
    if not valid.any():
        return float("nan"), float("nan")
    time, censored = method_scores.passages[LIMITS[0]][valid].T
    horizon = method_scores.horizon[valid]
    required = np.where(censored == 1, np.minimum(horizon, time), horizon)
    hit = float(np.mean(time >= required - 1e-6))
    if len(set(time.tolist())) < 2 or len(set(horizon.tolist())) < 2:
        return hit, float("nan")
    return hit, float(scipy.stats.spearmanr(time, horizon).statistic)


def _phase_figures(cases: Sequence[EvaluationCase], method: str) -> dict[str, Any]:
    """Compute passages and errors of a method by flight phase after the start."""
    out = {}
    for phase in PHASES:
        if phase_cases := [case for case in cases if case.phase == phase]:
            scores = score_method(phase_cases, method)
            lower = _round(passage_quantile(scores.passages[LIMITS[0]], 0.25))
            out[phase] = {"starts": len(phase_cases), "m1_t10_lq_s": lower} | _error_figures(scores)
    return out


def _exclusion_figures(cases: Sequence[EvaluationCase]) -> dict[str, Any]:
    """Compute the number of excluded starts and the first passages of ours at them, by reason."""
    out = {}
    for reason, n in Counter(case.exclusion for case in cases if case.exclusion).most_common():
        excluded_scores = score_method([case for case in cases if case.exclusion == reason], "ours")
        lower = _round(passage_quantile(excluded_scores.passages[LIMITS[0]], 0.25))
        out[reason] = {"starts": n, "m1_t10_lq_s": lower, "followed_s": _max_followed(excluded_scores)}
    return out


def _max_followed(method_scores: MethodScores) -> float | None:
    """Return the longest follow-up time of any start [s]."""
    valid = np.isfinite(method_scores.distance).any(axis=0)
    return _round(float(method_scores.ahead[valid][-1])) if valid.any() else None


def _percentile(values: np.ndarray, share: float) -> float:
    valid = values[np.isfinite(values)]
    return float(np.percentile(valid, share)) if len(valid) else float("nan")


def _mean(values: np.ndarray) -> float:
    valid = values[np.isfinite(values)]
    return float(valid.mean()) if len(valid) else float("nan")


def _round(value: float, digits: int = 2) -> float | None:
    return round(float(value), digits) if np.isfinite(value) else None
