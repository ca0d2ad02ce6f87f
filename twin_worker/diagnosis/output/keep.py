"""Save and load the calibrated simulation as a JSON model file; write the report as text."""

import json
from collections.abc import Sequence
from dataclasses import asdict, fields
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from fleet.effects import Body, Onset, catalogue
from twin_worker.diagnosis.data.card import AircraftCard, FaultHypothesis, OnsetProfile
from twin_worker.diagnosis.inference.report import DiagnosisFinding, Report, ReportOutcome
from twin_worker.diagnosis.model.baseline import CHANNELS, ActuatorTiming, Baseline, Noise
from twin_worker.diagnosis.model.equations import TERMS

FORMAT = "parauav.simulation.1"


def save(path: Path, base: Baseline, findings: Sequence[DiagnosisFinding] = ()) -> None:
    """Write the simulation and its effects, with parameters, standard deviations and onset profiles."""
    effects = [
        {
            "effect": finding.hypothesis.effect.name,
            "of": finding.hypothesis.target,
            "par": list(finding.hypothesis.par),
            "when": asdict(finding.hypothesis.onset),
            "told": finding.reported,
            "sigma": finding.sigma,
        }
        for finding in findings
    ]
    simulation = {field.name: _plain(getattr(base, field.name)) for field in fields(base)}
    path.write_text(json.dumps({"format": FORMAT, **simulation, "effects": effects}, indent=1) + "\n")


def load(path: Path) -> tuple[Baseline, tuple[FaultHypothesis, ...]]:
    """Read a simulation and its effects.

    Raises:
        ValueError: if the file is no valid model; the message names the fault.
        OSError: if the file cannot be read.
    """
    try:
        document = json.loads(path.read_text())
    except (ValueError, UnicodeDecodeError) as error:
        raise ValueError(
            f"{path.name}: found no JSON ({error}), expected a model; make it with `fleet calibrate`"
        ) from None
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        format_name = document.get("format") if isinstance(document, dict) else type(document).__name__
        raise ValueError(
            f"{path.name}: found format {format_name!r}, expected {FORMAT}; make it with `fleet calibrate`"
        )
    try:
        return _baseline(document), tuple(_hypothesis(entry) for entry in document["effects"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"{path.name}: found {error!r}, expected a complete model; make it with `fleet calibrate`"
        ) from None


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, dict):
        return {name: _plain(x) for name, x in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(x) for x in value]
    if hasattr(value, "__dataclass_fields__"):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    return value


def _baseline(document: dict[str, Any]) -> Baseline:
    card, noise = document["card"], document["noise"]
    inertia, throw = tuple(card["inertia"]), tuple(tuple(pair) for pair in card["throw"])
    coef = _coefficients(document["coef"])
    return Baseline(
        card=AircraftCard(card["name"], Body(**card["body"]), inertia, throw, card["pulses"], card["known"]),  # type: ignore[arg-type]
        coef=coef,
        speed=_number(document["speed"]),
        airspeed=_number(document["airspeed"]),
        timing=ActuatorTiming(**document["timing"]),
        vane=bool(document["vane"]),
        r2={name: float(x) for name, x in document["r2"].items()},
        noise=Noise(_array(noise["ar"], (len(CHANNELS), 2)), _array(noise["sigma"], (len(CHANNELS),))),
        spread={name: float(x) for name, x in document["spread"].items()},
        chance={name: float(x) for name, x in document["chance"].items()},
        others=tuple(_coefficients(other) for other in document["others"]),
        usual=_array(document["usual"], (len(CHANNELS),)),
        flights=tuple(document["flights"]),
    )


def _coefficients(entry: dict[str, list[float]]) -> dict[str, np.ndarray]:
    return {name: _array(entry[name], (len(terms),)) for name, terms in TERMS.items()}


def _array(values: Any, shape: tuple[int, ...]) -> np.ndarray:
    array = np.array(values, float)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"shape {array.shape} or non-finite numbers, expected finite numbers of shape {shape}")
    return array


def _number(value: Any) -> float:
    if not isinstance(value, int | float) or not isfinite(value) or value <= 0:
        raise ValueError(f"{value!r}, expected a number above 0")
    return float(value)


def _hypothesis(entry: dict[str, Any]) -> FaultHypothesis:
    effect = catalogue()[entry["effect"]]
    onset = entry["when"]
    hypothesis = FaultHypothesis(effect, str(entry["of"]), (0.0,) * effect.n_parameters)
    return hypothesis.with_parameters(
        _array(entry["par"], (effect.n_parameters,)),
        OnsetProfile(Onset(onset["kind"]), float(onset["t0"]), float(onset["T"])),
    )


_VERDICT = {ReportOutcome.SUSPECTED: "none"}


def write(reports: Sequence[Report], path: Path, refused: Sequence[tuple[str, str]] = ()) -> None:
    """Write the reports, and for each named outcome `<path>-<flight>.npz` with t, f_base, f_model.

    Args:
        reports: reports
        path: JSON file
        refused: name and reason of each recording that could not be diagnosed, with verdict `refused`
    """
    rows = [as_json(report, _write_predictions(report, path)) for report in reports]
    rows += [{"flight": name, "verdict": "refused", "sentence": reason} for name, reason in refused]
    path.write_text(json.dumps(rows, indent=1) + "\n")


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
