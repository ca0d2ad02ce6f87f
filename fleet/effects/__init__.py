"""Effects: candidates for missing physics, one file each; with all parameters zero an effect changes nothing.

An effect acts at one stage of the loop, on scalars and on time series, so the same function serves simulation,
signature and parameter estimation:

    delta    act(u, memory, dt, par): servo response to a series of commands, in place; compiled, stateful
    air      act(flow, *par): increments of wind and air density
    wrench   act(flow, *par): increments of coefficients, thrust, moments
    mass     act(flow, *par): mass, centre of gravity
    sensor   act(readings, *par): changed readings; `act` with negated parameters is the inverse

An onset (step, ramp, bump) scales the parameters outside the effect. To add an effect, add a file.
"""

import importlib.util
import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

SURFACES = ("aileron", "elevator", "rudder")
ALL_SURFACES = "all surfaces"
MEMORY = 32  # state variables of a servo
FOLDERS_ENV = "PARAUAV_EFFECTS"  # environment variable: further folders of effects, separated like PATH

INCREMENTS: dict[str, str] = {
    "w_n": "wind, the direction it blows to, north [m/s]",
    "w_e": "the same, east [m/s]",
    "w_d": "the same, down [m/s]",
    "rho": "air density, relative increment [-]",
    "thrust": "thrust, relative increment [-]",
    "lift": "lift coefficient, relative increment [-]",
    "C_L": "lift coefficient added [-]",
    "C_D": "drag coefficient added [-]",
    "C_Y": "side force coefficient added [-]",
    "C_l": "rolling moment coefficient added [-]",
    "C_l_p": "part of C_l that is proportional to p, as derivative [1/rad]",
    "C_m": "pitching moment coefficient added [-]",
    "C_n": "yawing moment coefficient added [-]",
    "L": "rolling moment added [N m]",
    "M": "pitching moment added [N m]",
    "N": "yawing moment added [N m]",
    "mass": "mass, relative increment [-]",
    "x_cg": "centre of gravity moved forward [m]",
    "y_cg": "centre of gravity moved right [m]",
}
"""Increments that `act` of an air, wrench or mass effect may return."""

READINGS = (
    *("v_n", "v_e", "v_d", "h", "phi", "theta", "psi", "p", "q", "r"),
    *("a_x", "a_y", "a_z", "Va", "baro"),
)
"""Readings that a sensor effect may change: NED velocity [m/s], height [m], attitude [rad], gyros [rad/s], specific
force FRD [m/s2], indicated airspeed [m/s], pressure height [m]; each (n,), with `t` (n,) [s]."""


class Stage(StrEnum):
    """Stage of the loop at which an effect acts."""

    DELTA = "delta"
    AIR = "air"
    WRENCH = "wrench"
    MASS = "mass"
    SENSOR = "sensor"


class Onset(StrEnum):
    """Time profile of an effect: constant, step, ramp or transient."""

    ALWAYS = "always"
    STEP = "step"
    RAMP = "ramp"
    BUMP = "bump"


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect; zero means no effect.

    Attributes:
        name: reported name, with its unit as a suffix
        unit, meaning: for display
        step: small observable change, for numerical derivatives
        low, high: physical limits
        nuisance: nuisance parameter, estimated with the others but no evidence, e.g. an unknown point of application
        least: minimum magnitude; a smaller value indicates another effect
    """

    name: str
    unit: str
    meaning: str
    step: float
    low: float
    high: float
    nuisance: bool = False
    least: float = 0.0


@dataclass(frozen=True)
class Body:
    """Airframe data for effects; the default is a unit body, with which parameters are relative values.

    Attributes:
        mass [kg], S [m2], b [m], c [m], D: propeller diameter [m]
        lag: time constant of the healthy servos [s]
    """

    mass: float = 1.0
    S: float = 1.0
    b: float = 1.0
    c: float = 1.0
    D: float = 1.0
    lag: float = 0.0

    @property
    def is_unit(self) -> bool:
        """Return whether mass and geometry are unknown."""
        return (self.mass, self.S, self.b, self.c, self.D) == (1.0, 1.0, 1.0, 1.0, 1.0)


@dataclass
class Flow:
    """State of air and aircraft as input of an effect: scalars or time series.

    Attributes:
        t: since the start of the flight [s]; h: above mean sea level, height: above the ground at the start [m]
        Va, alpha, beta: true airspeed [m/s] and flow angles [rad]; p q r: body rates [rad/s]
        rho: air density [kg/m3]; q_bar: dynamic pressure [Pa]
        T: thrust of the healthy engine [N]; throttle_time: integral of throttle [s]; delta_t: throttle [-]
        C_L: lift coefficient of the clean aircraft; C_m_elevator, C_n_rudder: moments of the deflected surfaces [-]
        body: airframe data
    """

    t: Any
    h: Any
    height: Any
    body: Body
    Va: Any = 0.0
    alpha: Any = 0.0
    beta: Any = 0.0
    p: Any = 0.0
    q: Any = 0.0
    r: Any = 0.0
    rho: Any = 1.225
    q_bar: Any = 0.0
    T: Any = 0.0
    throttle_time: Any = 0.0
    delta_t: Any = 0.0
    C_L: Any = 0.0
    C_m_elevator: Any = 0.0
    C_n_rudder: Any = 0.0


def _parameter_values(effect: "Effect", par: np.ndarray, body: Body) -> dict[str, float]:
    return {p.name: float(x) for p, x in zip(effect.parameters, par, strict=True)}


@dataclass(frozen=True)
class Effect:
    """One candidate for missing physics.

    Attributes:
        name: file name without suffix
        stage: stage of the loop at which it acts
        channel: affected part, one of air, actuator, roll, pitch, yaw, thrust, drag, lift, mass, airspeed, …
        equation, source: for display
        parameters: parameters in the order of `act`
        act: function of the stage, see the module docstring
        reported: `(effect, par, body)` to values by name with unit
        of_airframe: names of values that depend on mass, inertia or geometry
        onsets: possible time profiles
        targets: affected parts, e.g. surfaces; empty: the aircraft. Passed to `act` as `of=`, except at stage delta
        initial_guesses: start values of the search where the slope at zero is uninformative
        examples: three magnitudes, small to large
        confusable_with: effect -> distinguishing feature
        variance: it changes the variance of residuals, not their mean
        takes_lag: its first parameter adds to the healthy servo's lag, and the effect models both
    """

    name: str
    stage: Stage
    channel: str
    equation: str
    source: str
    parameters: tuple[Parameter, ...]
    act: Callable[..., Any]
    examples: tuple[tuple[float, ...], ...]
    reported: Callable[["Effect", np.ndarray, Body], dict[str, float]] = _parameter_values
    of_airframe: tuple[str, ...] = ()
    onsets: tuple[Onset, ...] = (Onset.ALWAYS, Onset.STEP)
    targets: tuple[str, ...] = ()
    initial_guesses: tuple[tuple[float, ...], ...] = ()
    confusable_with: Mapping[str, str] = field(default_factory=dict)
    variance: bool = False
    takes_lag: bool = False

    @property
    def n_parameters(self) -> int:
        """Return the number of parameters."""
        return len(self.parameters)

    @property
    def degrees_of_freedom(self) -> int:
        """Return the number of parameters without nuisance parameters."""
        return sum(not p.nuisance for p in self.parameters)

    def values(self, par: np.ndarray, body: Body) -> dict[str, float]:
        """Return the reported values by name with unit.

        Without an airframe, mass, moments of inertia, area and lengths count as 1: what depends on them has the suffix
        `_relative` instead of a unit, as `dCD_relative` = dCD S / m [m2/kg] and `dmass_relative`, a share of the mass.
        """
        values = self.reported(self, par, body)
        if not body.is_unit:
            return values
        return {_relative_name(name) if name in self.of_airframe else name: x for name, x in values.items()}


def _relative_name(name: str) -> str:
    """Return the name of a value without its unit: dmass_kg becomes dmass_relative."""
    return f"{name.removesuffix('_kg').removesuffix('_m')}_relative"


@cache
def catalogue(folders: str | None = None) -> dict[str, Effect]:
    """Return the effects by name: files of this package and of `folders`, by default those in $PARAUAV_EFFECTS.

    Raises:
        ValueError: when a file defines no EFFECT with the name of the file.
    """
    extra_folders = os.environ.get(FOLDERS_ENV, "") if folders is None else folders
    directories = [Path(__file__).parent, *map(Path, filter(None, extra_folders.split(os.pathsep)))]
    files = [
        path for directory in directories for path in sorted(directory.glob("*.py")) if not path.stem.startswith("_")
    ]
    return {path.stem: _import_effect(path) for path in files}


def _import_effect(path: Path) -> Effect:
    is_builtin = path.parent == Path(__file__).parent
    module = importlib.import_module(f"{__name__}.{path.stem}") if is_builtin else _load_plugin(path)
    effect = getattr(module, "EFFECT", None)
    if not isinstance(effect, Effect) or effect.name != path.stem:
        raise ValueError(f"{path.name}: found no EFFECT named {path.stem!r}, expected one; name it like the file")
    return effect


def _load_plugin(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"parauav_effect_{path.stem}", path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise ValueError(f"{path}: found {error!r} on import, expected an effect; correct the file") from None
    return module
