"""Save and load the calibrated simulation as a JSON model file; write the report as text."""

import json
from collections.abc import Sequence
from dataclasses import asdict, fields
from math import isfinite
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fleet.effects import catalogue
from twin_worker.diagnosis.data.card import FaultHypothesis, OnsetProfile
from twin_worker.diagnosis.inference.report import DiagnosisFinding, Report, ReportOutcome
from twin_worker.diagnosis.model.baseline import CHANNELS, Baseline
from twin_worker.diagnosis.model.equations import TERMS
from twin_worker.diagnosis.multirotor.baseline import FORMAT as ROTOR_FORMAT
from twin_worker.diagnosis.multirotor.baseline import RotorBaseline, load_rotors

FORMAT = "parauav.simulation.2"
_OPTIONAL = ("envelope", "block_sigma", "block_chance", "undetermined")  # fields that earlier models lack


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
    simulation = msgspec.to_builtins(base, enc_hook=np.ndarray.tolist)
    path.write_text(json.dumps({"format": FORMAT, **simulation, "effects": effects}, indent=1) + "\n")


def load(path: Path) -> tuple[Baseline | RotorBaseline, tuple[FaultHypothesis, ...]]:
    """Read a simulation and its effects; a rotor model has none.

    Raises:
        ValueError: if the file is no valid model; the message names the fault.
        OSError: if the file cannot be read.
    """
    try:
        document = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(
            f"{path.name}: found no JSON ({error}), expected a model; make it with `fleet calibrate`"
        ) from None
    if isinstance(document, dict) and document.get("format") == ROTOR_FORMAT:
        return load_rotors(path, document), ()
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        format_name = document.get("format") if isinstance(document, dict) else type(document).__name__
        raise ValueError(
            f"{path.name}: found format {format_name!r}, expected {FORMAT}; make it with `fleet calibrate`"
        )
    try:
        if missing := [field.name for field in fields(Baseline) if field.name not in (*document, *_OPTIONAL)]:
            raise KeyError(*missing)
        base = msgspec.convert(document, Baseline, dec_hook=lambda _, x: np.array(x, float))
        _check_shapes(base)
        return base, tuple(_hypothesis(entry) for entry in document["effects"])
    except (KeyError, TypeError, ValueError, msgspec.ValidationError) as error:
        raise ValueError(
            f"{path.name}: found {error!r}, expected a complete model; make it with `fleet calibrate`"
        ) from None


def _check_shapes(base: Baseline) -> None:
    n = len(CHANNELS)
    for coef in (base.coef, *base.others):
        for name, terms in TERMS.items():
            _check_array(coef[name], (len(terms),))
    for array, shape in (
        *((base.noise.ar, (n, 2)), (base.noise.sigma, (n,))),
        *((base.usual, (n,)), (base.block_sigma, (n,))),
    ):
        _check_array(array, shape)
    for value in (base.speed, base.airspeed):
        if not isfinite(value) or value <= 0:
            raise ValueError(f"{value!r}, expected a number above 0")


def _check_array(array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"shape {array.shape} or non-finite numbers, expected finite numbers of shape {shape}")


def _hypothesis(entry: dict[str, Any]) -> FaultHypothesis:
    effect, par = catalogue()[entry["effect"]], np.array(entry["par"], float)
    _check_array(par, (effect.n_parameters,))
    onset = msgspec.convert(entry["when"], OnsetProfile)
    return FaultHypothesis(effect, str(entry["of"]), ()).with_parameters(par, onset)


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
    suspects = [
        {
            "name": finding.hypothesis.effect.name,
            "parameters": _finite(finding.reported),
            "sigma": _finite(finding.sigma),
            "equivalents": list(finding.rivals),
            "posterior": _or_none(finding.probability),
            "name_posterior": _or_none(finding.name_probability),
        }
        for finding in report.findings
    ]
    return {
        "flight": report.flight,
        "abstained": report.outcome is ReportOutcome.UNKNOWN,
        "verdict": "none" if report.outcome is ReportOutcome.SUSPECTED else report.outcome.value,
        "sentence": report.sentence,
        "named": [finding.hypothesis.effect.name for finding in named],
        "equivalents": [list(finding.rivals) for finding in named],
        "told_apart_by": [list(finding.manoeuvres) for finding in named],
        "located": located,
        "onset_intervals": [finding.onset_interval and list(finding.onset_interval) for finding in named],
        "parameters": [_finite(finding.reported) for finding in named],
        "sigma": [_finite(finding.sigma) for finding in named],
        "posterior": [_or_none(finding.probability) for finding in named],
        "name_posterior": [_or_none(finding.name_probability) for finding in named],
        "explanations": report.posterior,
        "suspects": suspects if not named else [],
        "fit_before": _or_none(report.fit_before),
        "fit_after": _or_none(report.fit_after),
        "force_before": _or_none(report.force_before),
        "force_after": _or_none(report.force_after),
        "stray_before_deg": _or_none(report.free_run_error_before),
        "stray_after_deg": _or_none(report.free_run_error_after),
        "predictions": str(predictions) if predictions else None,
        "channels_before": _finite(report.ratio_before),
        "channels_after": _finite(report.ratio_after),
        "free_form": report.terms,
        "lacks": list(report.limitations),
        "detection_limits": list(report.detection_limits),
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


def _finite(values: dict[str, float]) -> dict[str, float | None]:
    return {name: _or_none(x) for name, x in values.items()}


def _or_none(x: float) -> float | None:
    return float(x) if isfinite(x) else None
