"""Summary figures of every method over the included starts, for table and JSON."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.stats

from twin_worker.evaluation.scoring.case import Case
from twin_worker.evaluation.scoring.compare import compare
from twin_worker.evaluation.scoring.score import LIMITS, Scores, quantile, score, surviving
from twin_worker.evaluation.scoring.truth import WHOLE_S
from twin_worker.telemetry.flight_phase import MODES

LOOK_S = (5, 10, 16, 30, 60, 120, 180)  # reported look-aheads, as far as predictions reach [s]
_HEAD = ("t10", "t5", "t3")


def summary(cases: Sequence[Case]) -> dict[str, Any]:
    """Compute the figures of every method, the comparison with ours, and the excluded starts.

    Keys: every method's name; `compare`, by method; `apart`, excluded starts by reason.
    """
    counted = [case for case in cases if not case.apart]
    names = list(dict.fromkeys(name for case in counted for name in case.asked.told))
    whole = [case for case in counted if set(names) == set(case.asked.told)]  # every method on the same starts
    scores = {name: score(whole, name) for name in names} if whole else {}
    phases = np.array([case.phase for case in whole])
    out: dict[str, Any] = {name: figures(found) | {"phases": _phases(found, phases)} for name, found in scores.items()}
    out["compare"] = compare(scores)
    out["apart"] = _apart(cases)
    return out


def figures(found: Scores) -> dict[str, Any]:
    """Compute the figures of one method."""
    look = {str(s): column for s in LOOK_S if (column := found.at(s)) is not None}
    stand_ins = Counter(found.made_by.tolist())
    out: dict[str, Any] = {}
    for name, limit in zip(_HEAD, LIMITS, strict=True):
        out[f"m1_{name}_lq_s"] = _round(quantile(found.passages[limit], 0.25))
        out[f"m1_{name}_median_s"] = _round(quantile(found.passages[limit], 0.5))
    out["followed_s"] = _followed(found)
    out["survive_60"] = _round(surviving(found.passages[LIMITS[0]], WHOLE_S), 3)
    out["m2_t10_lq_s"] = _round(quantile(found.strict, 0.25))
    out["p50_m"] = {s: _round(_percentile(found.distance[:, k], 50)) for s, k in look.items()}
    out["p90_m"] = {s: _round(_percentile(found.distance[:, k], 90)) for s, k in look.items()}
    for i, axis in enumerate(("along", "cross", "vertical")):
        out[f"{axis}_p50_m"] = {s: _round(_percentile(np.abs(found.error[:, k, i]), 50)) for s, k in look.items()}
    out |= _trust(found, look)
    return out | {
        "starts": len(found.flight),
        "flights": len(set(found.flight.tolist())),
        "made_by": dict(stand_ins.most_common()),
    }


def _trust(found: Scores, look: dict[str, int]) -> dict[str, Any]:
    """Compute coverage and size of the tube, and accuracy of the horizon; null for a method without them."""
    inside = found.inside
    by_flight = [inside[found.flight == name] for name in np.unique(found.flight)]
    worst = {s: min((_mean(rows[:, k]) for rows in by_flight), default=np.nan) for s, k in look.items()}
    sizes = {s: [_round(_percentile(found.tube[:, k, i], 50)) for i in range(3)] for s, k in look.items()}
    hit, corr = _horizon(found)
    return {
        "coverage": {s: _round(_mean(inside[:, k]), 3) for s, k in look.items()},
        "coverage_worst_flight": {s: _round(value, 3) for s, value in worst.items()},
        "half_axes_m": sizes,
        "horizon_hit_rate": _round(hit, 3),
        "horizon_rank_corr": _round(corr, 3),
        "horizon_median_s": _round(_percentile(found.horizon, 50)),
    }


def _horizon(found: Scores) -> tuple[float, float]:
    """Compute the share that stayed within 10 % up to its horizon, and Spearman's correlation of horizon and passage.

    A horizon beyond the follow-up time is evaluated up to that time.
    """
    known = np.isfinite(found.horizon)
    if not known.any():
        return float("nan"), float("nan")
    time, censored = found.passages[LIMITS[0]][known].T
    horizon = found.horizon[known]
    due = np.where(censored == 1, np.minimum(horizon, time), horizon)
    hit = float(np.mean(time >= due - 1e-6))
    if len(set(time.tolist())) < 2 or len(set(horizon.tolist())) < 2:
        return hit, float("nan")
    return hit, float(scipy.stats.spearmanr(time, horizon).statistic)


def _phases(found: Scores, phases: np.ndarray) -> dict[str, Any]:
    """Compute passages and errors by flight phase after the start."""
    out = {}
    for phase in MODES:
        if not (rows := phases == phase).any():
            continue
        its = found.part(rows)
        look = {str(s): column for s in LOOK_S if (column := its.at(s)) is not None}
        out[phase] = {
            "starts": int(rows.sum()),
            "m1_t10_lq_s": _round(quantile(its.passages[LIMITS[0]], 0.25)),
            "followed_s": _followed(its),
            "survive_60": _round(surviving(its.passages[LIMITS[0]], WHOLE_S), 3),
            "p50_m": {s: _round(_percentile(its.distance[:, k], 50)) for s, k in look.items()},
            "p90_m": {s: _round(_percentile(its.distance[:, k], 90)) for s, k in look.items()},
        }
    return out


def _apart(cases: Sequence[Case]) -> dict[str, Any]:
    """Compute the number of excluded starts and the first passages of ours at them, by reason."""
    out = {}
    for why, n in Counter(case.apart for case in cases if case.apart).most_common():
        its = score([case for case in cases if case.apart == why], "ours")
        lower = _round(quantile(its.passages[LIMITS[0]], 0.25))
        out[why] = {"starts": n, "m1_t10_lq_s": lower, "followed_s": _followed(its)}
    return out


def _followed(found: Scores) -> float | None:
    """Return the longest follow-up time of any start [s]."""
    known = np.isfinite(found.distance).any(axis=0)
    return _round(float(found.ahead[known][-1])) if known.any() else None


def _percentile(values: np.ndarray, share: float) -> float:
    known = values[np.isfinite(values)]
    return float(np.percentile(known, share)) if len(known) else float("nan")


def _mean(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")


def _round(value: float, digits: int = 2) -> float | None:
    return round(float(value), digits) if np.isfinite(value) else None
