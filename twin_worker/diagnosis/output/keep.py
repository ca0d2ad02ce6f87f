"""Save and load the calibrated simulation with its effects as a JSON model file."""

import json
from collections.abc import Sequence
from dataclasses import asdict, fields
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from fleet.effects import Body, Onset, catalogue
from twin_worker.diagnosis.data.card import AircraftCard, FaultHypothesis, OnsetProfile
from twin_worker.diagnosis.inference.report import DiagnosisFinding
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
