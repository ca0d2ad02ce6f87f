"""Write diagnoses as JSON, one object per flight, and the predicted specific force as `.npz` files."""

import json
from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from twin_worker.diagnosis.inference.report import DiagnosisFinding, Report, ReportOutcome

_VERDICT = {ReportOutcome.SUSPECTED: "none"}


def write(reports: Sequence[Report], path: Path) -> None:
    """Write the reports, and for each named outcome `<path>-<flight>.npz` with t, f_base, f_model."""
    path.write_text(
        json.dumps([as_json(report, _write_predictions(report, path)) for report in reports], indent=1) + "\n"
    )


def as_json(report: Report, predictions: Path | None = None) -> dict[str, Any]:
    """Return one report as plain values; a suspected outcome has verdict `none` and its effects under `suspects`."""
    named = report.findings if report.outcome is ReportOutcome.NAMED else ()
    located = [_located(finding.channel, finding.surface, finding.segments) for finding in named]
    if report.outcome is ReportOutcome.UNKNOWN:
        located = [_located(report.where[0], "", report.where[1])]
    return {
        "flight": report.flight,
        "abstained": report.outcome is ReportOutcome.UNKNOWN,
        "verdict": _VERDICT.get(report.outcome, report.outcome.value),
        "sentence": report.sentence,
        "named": [finding.hypothesis.effect.name for finding in named],
        "equivalents": [list(finding.rivals) for finding in named],
        "told_apart_by": [list(finding.manoeuvres) for finding in named],
        "located": located,
        "parameters": [_finite(finding.reported) for finding in named],
        "sigma": [_finite(finding.sigma) for finding in named],
        "suspects": [_suspect(finding) for finding in report.findings] if not named else [],
        "fit_before": _or_none(report.fit_before),
        "fit_after": _or_none(report.fit_after),
        "force_before": _or_none(report.force_before),
        "force_after": _or_none(report.force_after),
        "stray_before_deg": _or_none(report.free_run_error_before),
        "stray_after_deg": _or_none(report.free_run_error_after),
        "predictions": str(predictions) if predictions else None,
        "channels_before": _finite(report.ratio_before),
        "channels_after": _finite(report.ratio_after),
        "odd": report.anomaly_ratio,
        "free_form": report.terms,
        "lacks": list(report.limitations),
        "seconds": round(report.seconds, 2),
    }


def safe(name: str) -> str:
    """Convert a flight name to a safe file name."""
    return "".join(c if c.isalnum() or c in "-_" else "_" for c in name)[:80] or "flight"


def _write_predictions(report: Report, path: Path) -> Path | None:
    if report.outcome is not ReportOutcome.NAMED:
        return None
    target = path.absolute().with_name(f"{path.stem}-{safe(report.flight)}.npz")
    series = report.series
    np.savez_compressed(target, t=series.t, f_base=series.base, f_model=series.model)
    return target


def _located(channel: str, surface: str, segments: tuple[tuple[float, float], ...]) -> dict[str, Any]:
    return {"channel": channel, "surface": surface or None, "segments": [list(pair) for pair in segments]}


def _suspect(finding: DiagnosisFinding) -> dict[str, Any]:
    return {
        "name": finding.hypothesis.effect.name,
        "parameters": _finite(finding.reported),
        "sigma": _finite(finding.sigma),
    }


def _finite(values: dict[str, float]) -> dict[str, float | None]:
    return {name: _or_none(x) for name, x in values.items()}


def _or_none(x: float) -> float | None:
    return float(x) if isfinite(x) else None
