"""Save and load the calibrated simulation with its effects as a JSON model file."""

import json
from collections.abc import Sequence
from dataclasses import asdict, fields
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from fleet.effects import Body, Onset, catalogue
from twin_worker.diagnosis.data.card import Card
from twin_worker.diagnosis.data.fault_hypothesis import Guess, When
from twin_worker.diagnosis.inference.report import Finding
from twin_worker.diagnosis.model.baseline import CHANNELS, Baseline, Noise, Timing
from twin_worker.diagnosis.model.equations import TERMS

FORMAT = "parauav.simulation.1"


def save(path: Path, base: Baseline, findings: Sequence[Finding] = ()) -> None:
    """Write the simulation and its effects, with parameters, standard deviations and onset profiles."""
    effects = [
        {
            "effect": one.guess.effect.name,
            "of": one.guess.of,
            "par": list(one.guess.par),
            "when": asdict(one.guess.when),
            "told": one.told,
            "sigma": one.sigma,
        }
        for one in findings
    ]
    simulation = {field.name: _plain(getattr(base, field.name)) for field in fields(base)}
    path.write_text(json.dumps({"format": FORMAT, **simulation, "effects": effects}, indent=1) + "\n")


def load(path: Path) -> tuple[Baseline, tuple[Guess, ...]]:
    """Read a simulation and its effects.

    Raises:
        ValueError: if the file is no valid model; the message names the fault.
        OSError: if the file cannot be read.
    """
    try:
        found = json.loads(path.read_text())
    except (ValueError, UnicodeDecodeError) as error:
        raise ValueError(
            f"{path.name}: found no JSON ({error}), expected a model; make it with `fleet calibrate`"
        ) from None
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        named = found.get("format") if isinstance(found, dict) else type(found).__name__
        raise ValueError(f"{path.name}: found format {named!r}, expected {FORMAT}; make it with `fleet calibrate`")
    try:
        return _baseline(found), tuple(_guess(one) for one in found["effects"])
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


def _baseline(found: dict[str, Any]) -> Baseline:
    card, noise = found["card"], found["noise"]
    inertia, throw = tuple(card["inertia"]), tuple(tuple(pair) for pair in card["throw"])
    coef = _coefficients(found["coef"])
    return Baseline(
        card=Card(card["name"], Body(**card["body"]), inertia, throw, card["pulses"], card["known"]),  # type: ignore[arg-type]
        coef=coef,
        speed=_number(found["speed"]),
        airspeed=_number(found["airspeed"]),
        timing=Timing(**found["timing"]),
        vane=bool(found["vane"]),
        r2={name: float(x) for name, x in found["r2"].items()},
        noise=Noise(_array(noise["ar"], (len(CHANNELS), 2)), _array(noise["sigma"], (len(CHANNELS),))),
        spread={name: float(x) for name, x in found["spread"].items()},
        chance={name: float(x) for name, x in found["chance"].items()},
        others=tuple(_coefficients(other) for other in found["others"]),
        usual=_array(found["usual"], (len(CHANNELS),)),
        flights=tuple(found["flights"]),
    )


def _coefficients(found: dict[str, list[float]]) -> dict[str, np.ndarray]:
    return {name: _array(found[name], (len(terms),)) for name, terms in TERMS.items()}


def _array(found: Any, shape: tuple[int, ...]) -> np.ndarray:
    array = np.array(found, float)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"shape {array.shape} or non-finite numbers, expected finite numbers of shape {shape}")
    return array


def _number(found: Any) -> float:
    if not isinstance(found, int | float) or not isfinite(found) or found <= 0:
        raise ValueError(f"{found!r}, expected a number above 0")
    return float(found)


def _guess(found: dict[str, Any]) -> Guess:
    effect = catalogue()[found["effect"]]
    when = found["when"]
    guess = Guess(effect, str(found["of"]), (0.0,) * effect.size)
    return guess.at(
        _array(found["par"], (effect.size,)), When(Onset(when["kind"]), float(when["t0"]), float(when["T"]))
    )
