"""Write diagnoses as JSON, one object per flight, and the predicted specific force as `.npz` files."""

import json
from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from twin_worker.diagnosis.inference.report import Finding, Outcome, Report

_VERDICT = {Outcome.SUSPECTED: "none"}


def write(reports: Sequence[Report], path: Path) -> None:
    """Write the reports, and for each named outcome `<path>-<flight>.npz` with t, f_base, f_model."""
    path.write_text(json.dumps([as_json(report, _told(report, path)) for report in reports], indent=1) + "\n")


def as_json(report: Report, predictions: Path | None = None) -> dict[str, Any]:
    """Return one report as plain values; a suspected outcome has verdict `none` and its effects under `suspects`."""
    named = report.findings if report.outcome is Outcome.NAMED else ()
    located = [_located(one.channel, one.surface, one.segments) for one in named]
    if report.outcome is Outcome.UNKNOWN:
        located = [_located(report.where[0], "", report.where[1])]
    return {
        "flight": report.flight,
        "abstained": report.outcome is Outcome.UNKNOWN,
        "verdict": _VERDICT.get(report.outcome, report.outcome.value),
        "sentence": report.sentence,
        "named": [one.guess.effect.name for one in named],
        "equivalents": [list(one.rivals) for one in named],
        "told_apart_by": [list(one.apart) for one in named],
        "located": located,
        "parameters": [_finite(one.told) for one in named],
        "sigma": [_finite(one.sigma) for one in named],
        "suspects": [_suspect(one) for one in report.findings] if not named else [],
        "fit_before": _or_none(report.fit_before),
        "fit_after": _or_none(report.fit_after),
        "force_before": _or_none(report.force_before),
        "force_after": _or_none(report.force_after),
        "stray_before_deg": _or_none(report.stray_before),
        "stray_after_deg": _or_none(report.stray_after),
        "predictions": str(predictions) if predictions else None,
        "channels_before": _finite(report.ratio_before),
        "channels_after": _finite(report.ratio_after),
        "odd": report.odd,
        "free_form": report.terms,
        "lacks": list(report.lacks),
        "seconds": round(report.seconds, 2),
    }


def safe(name: str) -> str:
    """Convert a flight name to a safe file name."""
    return "".join(c if c.isalnum() or c in "-_" else "_" for c in name)[:80] or "flight"


def _told(report: Report, path: Path) -> Path | None:
    if report.outcome is not Outcome.NAMED:
        return None
    told = path.absolute().with_name(f"{path.stem}-{safe(report.flight)}.npz")
    series = report.series
    np.savez_compressed(told, t=series.t, f_base=series.base, f_model=series.model)
    return told


def _located(channel: str, surface: str, segments: tuple[tuple[float, float], ...]) -> dict[str, Any]:
    return {"channel": channel, "surface": surface or None, "segments": [list(pair) for pair in segments]}


def _suspect(one: Finding) -> dict[str, Any]:
    return {"name": one.guess.effect.name, "parameters": _finite(one.told), "sigma": _finite(one.sigma)}


def _finite(values: dict[str, float]) -> dict[str, float | None]:
    return {name: _or_none(x) for name, x in values.items()}


def _or_none(x: float) -> float | None:
    return float(x) if isfinite(x) else None
