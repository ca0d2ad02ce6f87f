"""Result of a blind test as terminal tables and as JSON values."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from fleet.blind_test.course import BlindTestConfig, BlindTestResult
from fleet.blind_test.mark import REQUIREMENTS, GradedFlight, meets_requirement, score_rows


def as_json_values(config: BlindTestConfig, outcome: BlindTestResult, scores: Mapping[str, Any]) -> dict[str, Any]:
    """Return the result as JSON values: scores, hashes, requirements met, confusion counts, every flight."""
    return {
        **scores,
        "seed": config.seed,
        "flights": config.flights,
        "smallest": config.smallest,
        "aircraft": config.aircraft,
        "injected": _injected(config),
        "labels_sha256": outcome.labels_sha256,
        "reports_sha256": outcome.reports_sha256,
        "asked_met": {name: meets_requirement(name, scores[name]) for name in REQUIREMENTS},
        "confusion": [[*pair, count] for pair, count in sorted(confusion(outcome.results).items())],
        "marks": [asdict(result) | {"hit": result.hit} for result in outcome.results],
    }


def _injected(config: BlindTestConfig) -> dict[str, Any] | None:
    """Return the recordings that faults were concealed in, and the reference; None for simulated flights."""
    if config.injected is None:
        return None
    paths = sorted(config.folder.glob("*/source.json"))
    sources = {path.parent.name: json.loads(path.read_text()) for path in paths}
    return {"reference": config.injected.reference, "sources": sources}


def confusion(results: Sequence[GradedFlight]) -> Counter[tuple[str, str]]:
    """Count pairs of true and reported names, one pair for each true or reported effect."""
    pairs: Counter[tuple[str, str]] = Counter()
    for result in results:
        correct = set(result.concealed) & set(result.named)
        pairs.update((name, name) for name in correct)
        missed = [name for name in result.concealed if name not in correct]
        extra = [name for name in result.named if name not in correct]
        no_name = result.reported_names[0] if not result.named else "nothing"
        for k in range(max(len(missed), len(extra))):
            pairs[(missed[k] if k < len(missed) else "nothing", extra[k] if k < len(extra) else no_name)] += 1
        if not result.concealed and not result.named:
            pairs["nothing", no_name] += 1
    return pairs


def misses_first(results: Sequence[GradedFlight]) -> list[GradedFlight]:
    """Sort the flights, misses first."""
    return sorted(results, key=lambda one: (one.hit, one.role, one.concealed, one.flight))


def table(results: Sequence[GradedFlight], scores: Mapping[str, Any]) -> RenderableType:
    """Render the flights, misses first, and the scores."""
    return Group(_flights(results), Text(""), _scores(scores))


def _flights(results: Sequence[GradedFlight]) -> Table:
    flight_table = Table(box=None, pad_edge=False)
    for heading in ("", "flight", "concealed", "named", "reported (true)", "onset", "force error [m/s2]"):
        flight_table.add_column(heading, overflow="fold")
    for result in misses_first(results):
        flight_table.add_row(
            Text("ok", "green") if result.hit else Text("MISS", "red"),
            f"{result.airframe} {result.flight}",
            ", ".join(result.concealed) or "nothing",
            ", ".join(result.reported_names),
            "\n".join(parameter_texts(result)),
            "\n".join(f"{dt:+.1f} s" for dt, _ in result.late),
            fit_text(result),
        )
    return flight_table


def parameter_texts(result: GradedFlight) -> list[str]:
    """Format each parameter: reported value, standard deviation and true value."""
    texts = []
    for _, parameter in result.sizes:
        value = "not reported" if parameter.told is None else f"{parameter.told:.3g}"
        deviation = f" ± {parameter.sigma:.2g}" if parameter.sigma else ""
        texts.append(f"{parameter.name} {value}{deviation} ({parameter.truth:.3g})")
    return texts


def fit_text(result: GradedFlight) -> str:
    """Format the error of predicted forces on held-out blocks before and after [m/s2]."""
    return f"{result.force.before:.2f} → {result.force.after:.2f}" if result.force else ""


def _scores(scores: Mapping[str, Any]) -> Table:
    score_table = Table(box=None, pad_edge=False)
    for heading in ("", "score", "required", "achieved (95 % interval)"):
        score_table.add_column(heading)
    for met, *cells in score_rows(scores):
        verdict = Text("") if met is None else Text("met", "green") if met else Text("missed", "red")
        score_table.add_row(verdict, *cells)
    return score_table
