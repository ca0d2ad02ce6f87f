"""Scores of a blind test and the requirement for each."""

from collections.abc import Iterable, Mapping, Sequence
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from fleet.blind_test.mark import GradedFlight

_NEAR_EQUIVALENT = {("thrust_asymmetry", "thrust_loss"), ("stall", "drag_increase"), ("ground_effect", "drag_increase")}
_ONSET_TOLERANCE_S = 5.0

REQUIREMENTS = {  # score: bound and meaning
    "top1_naming": (0.88, "single effects named first"),
    "in_class": (0.94, "single effects named or in the reported equivalence class"),
    "false_alarm": (-1 / 60, "controls with an alarm"),
    "compound_recall": (0.85, "effects of compound flights named"),
    "compound_extra_per_flight": (-0.2, "wrong names per compound flight"),
    "unknown_abstained": (12 / 14, "effects outside the catalogue reported as unknown"),
    "magnitude_median_err": (-0.05, "relative error of reported parameters, median"),
    "onset_within_5s": (0.9, "onsets reported within 5 s"),
    "sigma2_coverage": (0.85, "true values within two standard deviations"),
    "class_size_median": (-2.0, "size of the equivalence class, median"),
    "named_improving": (1.0, "named flights whose held-out residual decreases"),
}
"""Bounds: a positive value is a minimum, a negative value the negative of a maximum."""


class ScoreRow(NamedTuple):
    """One score with its meaning and requirement, formatted."""

    met: bool
    meaning: str
    required: str
    achieved: str


def score_rows(scores: Mapping[str, Any]) -> list[ScoreRow]:
    """Format every score with its requirement."""
    rows = []
    for name, (required, meaning) in REQUIREMENTS.items():
        value = scores[name]
        bound = f"at most {-required:.3g}" if required < 0 else f"at least {required:.3g}"
        rows.append(
            ScoreRow(meets_requirement(name, value), meaning, bound, "no data" if value is None else f"{value:.3g}")
        )
    return rows


def meets_requirement(name: str, value: float | None) -> bool:
    """Return whether a score meets its requirement; a score without data does."""
    required = REQUIREMENTS[name][0]
    return value is None or (value <= -required + 1e-9 if required < 0 else value >= required - 1e-9)


def score(results: Sequence[GradedFlight]) -> dict[str, Any]:
    """Compute all scores; None where no flight contributes."""
    by_role = {
        kind: [result for result in results if result.role == kind]
        for kind in ("control", "single", "compound", "unknown")
    }
    parameters = [parameter for one in results for _, parameter in one.sizes]
    errors = [size.error for size in parameters]
    onset_errors = [pair for one in results for pair in one.late]
    fits = [(one.before, one.after) for one in results if one.before and one.after is not None]
    correct = [len(set(one.concealed) & set(one.named)) for one in by_role["compound"]]
    extra = [len(set(one.named) - set(one.concealed)) for one in by_role["compound"]]
    named = [one for one in results if one.named]
    return {
        "top1_naming": _fraction(one.hit for one in by_role["single"]),
        "in_class": _fraction(one.in_class for one in by_role["single"]),
        "spurious_extra_names": sum(_spurious(one) for one in by_role["single"]),
        "channel_ok": _fraction(ok for one in results for ok in one.located),
        "surface_ok": _fraction(ok for one in results for ok in one.surfaces),
        "onset_ok": _fraction(abs(dt) <= tolerance for dt, tolerance in onset_errors),
        "onset_within_5s": _fraction(abs(dt) <= _ONSET_TOLERANCE_S for dt, _ in onset_errors),
        "onset_median_err_s": _median(abs(dt) for dt, _ in onset_errors),
        "false_alarm": _fraction(not one.hit for one in by_role["control"]),
        "compound_recall": sum(correct) / sum(len(one.concealed) for one in by_role["compound"]) if correct else None,
        "compound_extra": sum(extra),
        "compound_extra_per_flight": sum(extra) / len(extra) if extra else None,
        "unknown_abstained": _fraction(one.hit for one in by_role["unknown"]),
        "magnitude_median_err": _median(errors),
        "magnitude_p90_err": float(np.percentile(errors, 90)) if errors else None,
        "sigma2_coverage": _fraction(size.covered for size in parameters if size.covered is not None),
        "heldout_improvement_median": _median(1.0 - after / before for before, after in fits),
        "named_improving": _fraction(after < before for before, after in fits),
        "class_size_median": _median(1 + len(rivals) for one in named for rivals in one.rivals),
        "n": {kind: len(flights) for kind, flights in by_role.items()}
        | {"sizes": len(parameters), "onsets": len(onset_errors)},
    }


def _spurious(result: GradedFlight) -> int:
    return sum((result.concealed[0], extra) not in _NEAR_EQUIVALENT for extra in result.named[1:])


def _fraction(outcomes: Iterable[bool | None]) -> float | None:
    items = list(outcomes)
    return sum(map(bool, items)) / len(items) if items else None


def _median(values: Iterable[float]) -> float | None:
    items = list(values)
    return float(median(items)) if items else None
