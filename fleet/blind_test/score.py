"""Scores of a blind test and the requirement for each."""

from collections.abc import Iterable, Mapping, Sequence
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from fleet.blind_test.mark import Mark

_SAME = {("thrust_asymmetry", "thrust_loss"), ("stall", "drag_increase"), ("ground_effect", "drag_increase")}
_PROMPT_S = 5.0

ASKED = {  # score: bound and meaning
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


class Line(NamedTuple):
    """One score with its meaning and requirement, formatted."""

    met: bool
    words: str
    asked: str
    reached: str


def lines(scores: Mapping[str, Any]) -> list[Line]:
    """Format every score with its requirement."""
    out = []
    for name, (asked, words) in ASKED.items():
        value = scores[name]
        bound = f"at most {-asked:.3g}" if asked < 0 else f"at least {asked:.3g}"
        out.append(Line(met(name, value), words, bound, "no data" if value is None else f"{value:.3g}"))
    return out


def met(name: str, value: float | None) -> bool:
    """Return whether a score meets its requirement; a score without data does."""
    asked = ASKED[name][0]
    return value is None or (value <= -asked + 1e-9 if asked < 0 else value >= asked - 1e-9)


def score(marks: Sequence[Mark]) -> dict[str, Any]:
    """Compute all scores; None where no flight contributes."""
    role = {kind: [one for one in marks if one.role == kind] for kind in ("control", "single", "compound", "unknown")}
    sizes = [size for one in marks for _, size in one.sizes]
    errors = [size.error for size in sizes]
    late = [pair for one in marks for pair in one.late]
    fits = [(one.before, one.after) for one in marks if one.before and one.after is not None]
    right = [len(set(one.concealed) & set(one.named)) for one in role["compound"]]
    extra = [len(set(one.named) - set(one.concealed)) for one in role["compound"]]
    named = [one for one in marks if one.named]
    return {
        "top1_naming": _share(one.hit for one in role["single"]),
        "in_class": _share(one.in_class for one in role["single"]),
        "spurious_extra_names": sum(_spurious(one) for one in role["single"]),
        "channel_ok": _share(ok for one in marks for ok in one.located),
        "surface_ok": _share(ok for one in marks for ok in one.surfaces),
        "onset_ok": _share(abs(dt) <= within for dt, within in late),
        "onset_within_5s": _share(abs(dt) <= _PROMPT_S for dt, _ in late),
        "onset_median_err_s": _median(abs(dt) for dt, _ in late),
        "false_alarm": _share(not one.hit for one in role["control"]),
        "compound_recall": sum(right) / sum(len(one.concealed) for one in role["compound"]) if right else None,
        "compound_extra": sum(extra),
        "compound_extra_per_flight": sum(extra) / len(extra) if extra else None,
        "unknown_abstained": _share(one.hit for one in role["unknown"]),
        "magnitude_median_err": _median(errors),
        "magnitude_p90_err": float(np.percentile(errors, 90)) if errors else None,
        "sigma2_coverage": _share(size.covered for size in sizes if size.covered is not None),
        "heldout_improvement_median": _median(1.0 - after / before for before, after in fits),
        "named_improving": _share(after < before for before, after in fits),
        "class_size_median": _median(1 + len(rivals) for one in named for rivals in one.rivals),
        "n": {kind: len(flights) for kind, flights in role.items()} | {"sizes": len(sizes), "onsets": len(late)},
    }


def _spurious(one: Mark) -> int:
    return sum((one.concealed[0], extra) not in _SAME for extra in one.named[1:])


def _share(answers: Iterable[bool | None]) -> float | None:
    listed = list(answers)
    return sum(map(bool, listed)) / len(listed) if listed else None


def _median(values: Iterable[float]) -> float | None:
    listed = list(values)
    return float(median(listed)) if listed else None
