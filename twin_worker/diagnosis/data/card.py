"""Read the aircraft card (mass, inertia, geometry, servo mapping) from an airframe TOML or JSON; fault hypotheses."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from fleet.airframes import load
from fleet.airframes.airframe import servo_map, servo_parameters
from fleet.effects import SURFACES, Body, Effect, Onset

_REQUIRED = ("m", "S", "b", "c", "Ixx", "Iyy", "Izz", "Ixz")
_MAX_VALUE = 1e6


@dataclass(frozen=True)
class AircraftCard:
    """Properties of the aircraft that are known before any flight.

    Attributes:
        name: of the aircraft
        body: mass and geometry
        inertia: J_x J_y J_z J_xz [kg m2]
        throw: surface angle at full command, down and up, aileron elevator rudder, (3, 2) [rad]; ones where unknown
        pulses: use the fixed servo mapping of a JSON card instead of the autopilot parameters
        servo_params: servo map of the card as SERVOn_* parameters, instead of those of the autopilot; empty: none given
        known: False for the unit body of an aircraft without a card
    """

    name: str
    body: Body
    inertia: tuple[float, float, float, float]
    throw: tuple[tuple[float, float], ...] = ((1.0, 1.0),) * 3
    pulses: bool = False
    servo_params: dict[str, float] = field(default_factory=dict)
    known: bool = True

    def servo_parameters(self, params: Mapping[str, float]) -> Mapping[str, float]:
        """Return the parameters that describe the servo map: those of the card where it has a map."""
        return self.servo_params or params

    def commands(self, pulses: np.ndarray, params: Mapping[str, float]) -> np.ndarray:
        """Convert servo pulses, (n, 8) or (n, 16) [us], to delta_a delta_e delta_r delta_t of full command, (n, 4)."""
        if not self.pulses:
            return servo_map(self.servo_parameters(params)).inputs(pulses)
        u = (pulses[:, [0, 1, 3]] - 1500.0) / 500.0
        return np.column_stack([u, (pulses[:, 2] - 1000.0) / 1000.0])

    def angle(self, surface: int, u: np.ndarray) -> np.ndarray:
        """Convert commands of one surface [-] to angles [rad]."""
        low, high = self.throw[surface]
        return np.where(u > 0, high, low) * u

    def deflections(self, u: np.ndarray) -> np.ndarray:
        """Convert commands to surface angles [rad] and throttle, (4, n)."""
        return np.stack([*(self.angle(i, u[i]) for i in range(3)), u[3]])


UNKNOWN = AircraftCard("no card", Body(), (1.0, 1.0, 1.0, 0.0), known=False)
"""Unit mass, geometry and inertia: derivatives become dimensional, and forces specific."""


def read_card(path: Path) -> AircraftCard:
    """Read an aircraft card.

    Raises:
        ValueError: if the file is no valid card; the message names the wrong entry.
        OSError: if the file does not exist.
    """
    if path.suffix != ".json":
        airframe = load(str(path) if path.suffix or path.exists() else path.name)
        v = airframe.value
        body = Body(v["mass"], v["S"], v["b"], v["c"], v["c"])
        inertia = (v["J_x"], v["J_y"], v["J_z"], v["J_xz"])
        return AircraftCard(airframe.name, body, inertia, servo_params=airframe.servo_params)
    try:
        document = json.loads(path.read_text())
    except (ValueError, UnicodeDecodeError) as error:
        raise ValueError(f"{path.name}: found no JSON ({error}), expected an airframe card; correct it") from None
    if not isinstance(document, dict):
        raise ValueError(f"{path.name}: found a {type(document).__name__}, expected an airframe card; correct it")
    value = {name: _number(path.name, document, name) for name in _REQUIRED}
    diameter = _number(path.name, document, "Dprop") if "Dprop" in document else value["c"]
    body = Body(value["m"], value["S"], value["b"], value["c"], diameter)
    throw = _throws(path.name, document.get("surface_full_deg"))
    inertia = (value["Ixx"], value["Iyy"], value["Izz"], value["Ixz"])
    servos, name = document.get("servo"), str(document.get("airframe", path.stem))
    if isinstance(servos, list):
        return AircraftCard(name, body, inertia, throw, servo_params=servo_parameters(path.name, servos))
    return AircraftCard(name, body, inertia, throw, pulses=servos is not None)


def _number(file: str, document: Mapping[str, object], name: str) -> float:
    value = document.get(name)
    good = (
        isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value) and abs(value) < _MAX_VALUE
    )
    if not good or (name != "Ixz" and not float(value) > 0):  # type: ignore[arg-type]
        raise ValueError(f"{file}: found {name} = {value!r}, expected a number above 0; correct it")
    return float(value)  # type: ignore[arg-type]


def _throws(file: str, entry: object) -> tuple[tuple[float, float], ...]:
    if not isinstance(entry, dict):
        return ((1.0, 1.0),) * 3
    out = []
    for name in SURFACES:
        pair = entry.get(name)
        if not isinstance(pair, list) or len(pair) != 2 or not all(isinstance(x, int | float) for x in pair):
            raise ValueError(f"{file}: found surface_full_deg.{name} = {pair!r}, expected [down, up]; correct it")
        out.append((abs(float(np.radians(pair[0]))), abs(float(np.radians(pair[1])))))
    return tuple(out)


@dataclass(frozen=True)
class OnsetProfile:
    """Onset profile of an effect: always, or from t0 on [s since the start]; a ramp or bump lasts T [s]."""

    kind: Onset = Onset.ALWAYS
    t0: float = 0.0
    T: float = 0.0

    def gate(self, t: np.ndarray) -> np.ndarray:
        """Return the factor of the parameters at times t, 0..1, (n,)."""
        if self.kind is Onset.ALWAYS:
            return np.ones_like(t)
        if self.kind is Onset.STEP:
            return (t >= self.t0).astype(float)
        share = np.clip((t - self.t0) / max(self.T, 1e-6), 0.0, 1.0)
        return share if self.kind is Onset.RAMP else np.sin(np.pi * share) ** 2

    @property
    def n_parameters(self) -> int:
        """Return the number of parameters of the profile."""
        return {Onset.ALWAYS: 0, Onset.STEP: 1}.get(self.kind, 2)

    def shifted(self, dt: float) -> "OnsetProfile":
        """Shift the onset by dt [s]."""
        return replace(self, t0=self.t0 + dt)

    def stretched(self, by: float) -> "OnsetProfile":
        """Scale the duration; a bump is scaled about its middle."""
        earlier = 0.5 * (by - 1.0) * self.T if self.kind is Onset.BUMP else 0.0
        return replace(self, t0=self.t0 - earlier, T=self.T * by)


ALWAYS = OnsetProfile()


@dataclass(frozen=True)
class FaultHypothesis:
    """One active effect.

    Attributes:
        effect: the effect
        of: target, one of `effect.of`, or empty
        par: parameters, (k,)
        onset: onset profile
    """

    effect: Effect
    target: str
    par: tuple[float, ...]
    onset: OnsetProfile = ALWAYS

    @property
    def label(self) -> str:
        """Return effect and target, e.g. `actuator_lag:elevator`."""
        return f"{self.effect.name}:{self.target}" if self.target else self.effect.name

    @property
    def degrees_of_freedom(self) -> int:
        """Return the number of parameters, those of the onset profile included."""
        return self.effect.degrees_of_freedom + self.onset.n_parameters

    def parameters_at(self, t: np.ndarray) -> np.ndarray:
        """Return the parameters scaled by the onset profile at times t (n,), (k, n)."""
        return np.asarray(self.par, float)[:, None] * self.onset.gate(t)

    def act(self, on: Any, par: Iterable[Any]) -> dict[str, Any]:
        """Evaluate the effect, of any stage but delta, at parameters `par` on a flow or on readings."""
        target = {"of": self.target} if self.target else {}
        return self.effect.act(on, *par, **target)  # type: ignore[no-any-return]

    def with_parameters(self, par: np.ndarray, onset: OnsetProfile | None = None) -> "FaultHypothesis":
        """Return a copy with other parameters, limited to their physical bounds."""
        low, high = (np.array([getattr(p, side) for p in self.effect.parameters]) for side in ("low", "high"))
        within = np.clip(np.asarray(par, float), low, high)
        return replace(self, par=tuple(float(x) for x in within), onset=onset or self.onset)
