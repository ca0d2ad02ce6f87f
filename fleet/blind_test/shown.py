"""Result of a blind test as terminal tables and as JSON values."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from fleet.blind_test.course import Marked, Paper
from fleet.blind_test.mark import Mark
from fleet.blind_test.score import ASKED, lines, met


def written(paper: Paper, marked: Marked, scores: Mapping[str, Any]) -> dict[str, Any]:
    """Return the result as JSON values: scores, hashes, requirements met, confusion counts, every flight."""
    return {
        **scores,
        "seed": paper.seed,
        "flights": paper.flights,
        "labels_sha256": marked.sealed,
        "reports_sha256": marked.reports,
        "asked_met": {name: met(name, scores[name]) for name in ASKED},
        "confusion": [[*pair, count] for pair, count in sorted(confusion(marked.marks).items())],
        "marks": [asdict(one) | {"hit": one.hit} for one in marked.marks],
    }


def confusion(marks: Sequence[Mark]) -> Counter[tuple[str, str]]:
    """Count pairs of true and reported names, one pair for each true or reported effect."""
    pairs: Counter[tuple[str, str]] = Counter()
    for one in marks:
        right = set(one.concealed) & set(one.named)
        pairs.update((name, name) for name in right)
        missed = [name for name in one.concealed if name not in right]
        extra = [name for name in one.named if name not in right]
        nothing = one.said[0] if not one.named else "nothing"
        for k in range(max(len(missed), len(extra))):
            pairs[(missed[k] if k < len(missed) else "nothing", extra[k] if k < len(extra) else nothing)] += 1
        if not one.concealed and not one.named:
            pairs["nothing", nothing] += 1
    return pairs


def ordered(marks: Sequence[Mark]) -> list[Mark]:
    """Sort the flights, misses first."""
    return sorted(marks, key=lambda one: (one.hit, one.role, one.concealed, one.flight))


def table(marks: Sequence[Mark], scores: Mapping[str, Any]) -> RenderableType:
    """Render the flights, misses first, and the scores."""
    return Group(_flights(marks), Text(""), _scores(scores))


def _flights(marks: Sequence[Mark]) -> Table:
    out = Table(box=None, pad_edge=False)
    for heading in ("", "flight", "concealed", "named", "reported (true)", "onset", "held out"):
        out.add_column(heading, overflow="fold")
    for one in ordered(marks):
        out.add_row(
            Text("ok", "green") if one.hit else Text("MISS", "red"),
            f"{one.airframe} {one.flight}",
            ", ".join(one.concealed) or "nothing",
            ", ".join(one.said),
            "\n".join(numbers(one)),
            "\n".join(f"{dt:+.1f} s" for dt, _ in one.late),
            fit(one),
        )
    return out


def numbers(one: Mark) -> list[str]:
    """Format each parameter: reported value, standard deviation and true value."""
    out = []
    for _, size in one.sizes:
        told = "not reported" if size.told is None else f"{size.told:.3g}"
        doubt = f" ± {size.sigma:.2g}" if size.sigma else ""
        out.append(f"{size.name} {told}{doubt} ({size.truth:.3g})")
    return out


def fit(one: Mark) -> str:
    """Format the residual on held-out blocks before and after."""
    return f"{one.before:.2f} → {one.after:.2f}" if one.before and one.after is not None else ""


def _scores(scores: Mapping[str, Any]) -> Table:
    out = Table(box=None, pad_edge=False)
    for heading in ("", "score", "required", "achieved"):
        out.add_column(heading)
    for one in lines(scores):
        out.add_row(Text("met", "green") if one.met else Text("missed", "red"), one.words, one.asked, one.reached)
    return out
