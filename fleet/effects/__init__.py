"""Effects: physics a simulation may lack, one candidate a file; all parameters zero means exactly nothing.

An effect acts at one stage of the loop, on numbers and on whole series alike, so the same function simulates it,
gives its signature and is fitted to a flight:

    delta    act(u, memory, dt, par): what the servo does to a series of commands, in place; compiled, keeps memory
    air      act(flow, *par): wind added, air density
    wrench   act(flow, *par): increments of coefficients, thrust, moments
    mass     act(flow, *par): mass, centre of gravity
    sensor   act(readings, *par): readings changed; `act` of minus the parameters undoes it

An onset (step, ramp, bump) multiplies the parameters and is no business of the effect. A newcomer adds a file.
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
MEMORY = 32  # numbers a servo may remember
FOLDERS = "PARAUAV_EFFECTS"  # more folders of effects, separated like PATH

INCREMENTS: dict[str, str] = {
    "w_n": "wind, the direction it blows to, north [m/s]",
    "w_e": "the same, east [m/s]",
    "w_d": "the same, down [m/s]",
    "rho": "air density, share added [-]",
    "thrust": "thrust, share added [-]",
    "lift": "lift coefficient, share added [-]",
    "C_L": "lift coefficient added [-]",
    "C_D": "drag coefficient added [-]",
    "C_Y": "side force coefficient added [-]",
    "C_l": "rolling moment coefficient added [-]",
    "C_m": "pitching moment coefficient added [-]",
    "C_n": "yawing moment coefficient added [-]",
    "L": "rolling moment added [N m]",
    "M": "pitching moment added [N m]",
    "N": "yawing moment added [N m]",
    "mass": "mass, share added [-]",
    "x_cg": "centre of gravity moved forward [m]",
    "y_cg": "centre of gravity moved right [m]",
}
"""What `act` of an air, wrench or mass effect may return."""

READINGS = (
    *("v_n", "v_e", "v_d", "h", "phi", "theta", "psi", "p", "q", "r"),
    *("a_x", "a_y", "a_z", "Va", "baro"),
)
"""What a sensor effect may change: NED velocity [m/s], height [m], attitude [rad], gyros [rad/s], specific force FRD
[m/s2], indicated airspeed [m/s], height by static pressure [m]; each (n,), beside `t` (n,) [s]."""


class Stage(StrEnum):
    """Where in the loop an effect acts."""

    DELTA = "delta"
    AIR = "air"
    WRENCH = "wrench"
    MASS = "mass"
    SENSOR = "sensor"


class Onset(StrEnum):
    """How an effect may come: from the start, at once, growing, or passing by."""

    ALWAYS = "always"
    STEP = "step"
    RAMP = "ramp"
    BUMP = "bump"


@dataclass(frozen=True)
class Parameter:
    """One number of an effect; zero means nothing.

    Attributes:
        name: as it is reported, with its unit as a suffix
        unit, meaning: for people
        step: a change that shows but is small, for slopes
        low, high: what is physically possible
        aside: it comes along with the others and is no evidence: where a force acts is seldom known
        least: what is smaller would be another effect
    """

    name: str
    unit: str
    meaning: str
    step: float
    low: float
    high: float
    aside: bool = False
    least: float = 0.0


@dataclass(frozen=True)
class Body:
    """What an effect may know of the aircraft; without a card a unit body, whose numbers mean shares.

    Attributes:
        mass [kg], S [m2], b [m], c [m], D: propeller diameter [m]
        lag: of the healthy servos [s]
    """

    mass: float = 1.0
    S: float = 1.0
    b: float = 1.0
    c: float = 1.0
    D: float = 1.0
    lag: float = 0.0


@dataclass
class Flow:
    """The air and the aircraft in it, as an effect sees them: numbers or series.

    Attributes:
        t: since the start of the flight [s]; h: above mean sea level, height: above the ground at the start [m]
        Va, alpha, beta: true airspeed [m/s] and flow angles [rad]; p q r: body rates [rad/s]
        rho: air density [kg/m3]; q_bar: dynamic pressure [Pa]
        T: thrust of the healthy engine [N]; used: throttle integrated over time [s]; delta_t: throttle [-]
        C_L: lift coefficient of the clean aircraft; pitch, yaw: its C_m by elevator and C_n by rudder [-]
        body: the aircraft
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
    used: Any = 0.0
    delta_t: Any = 0.0
    C_L: Any = 0.0
    pitch: Any = 0.0
    yaw: Any = 0.0


def _as_they_are(effect: "Effect", par: np.ndarray, body: Body) -> dict[str, float]:
    return {p.name: float(x) for p, x in zip(effect.parameters, par, strict=True)}


@dataclass(frozen=True)
class Effect:
    """One candidate for missing physics.

    Attributes:
        name: the file's
        stage: where it acts
        channel: where it lives, in a word: air, actuator, roll, pitch, yaw, thrust, drag, lift, mass, airspeed, …
        equation, source: for people
        parameters: its numbers
        act: see the stages above
        told: `(effect, par, body)` to the numbers people want, by name with unit
        onsets: how it may come
        of: what it may befall, e.g. one of the surfaces; empty: the aircraft. Passed to `act` as `of=`, not for delta
        starts: parameters to begin the search from where the slope at zero tells nothing
        examples: three magnitudes, small to large
        confused: effect -> what tells them apart
        variance: it shows in the scatter of residuals, not in their mean
        takes_lag: its first parameter adds to the healthy servo's lag, and it stands for both
    """

    name: str
    stage: Stage
    channel: str
    equation: str
    source: str
    parameters: tuple[Parameter, ...]
    act: Callable[..., Any]
    examples: tuple[tuple[float, ...], ...]
    told: Callable[["Effect", np.ndarray, Body], dict[str, float]] = _as_they_are
    onsets: tuple[Onset, ...] = (Onset.ALWAYS, Onset.STEP)
    of: tuple[str, ...] = ()
    starts: tuple[tuple[float, ...], ...] = ()
    confused: Mapping[str, str] = field(default_factory=dict)
    variance: bool = False
    takes_lag: bool = False

    @property
    def size(self) -> int:
        """Return the number of parameters."""
        return len(self.parameters)

    @property
    def price(self) -> int:
        """Return the number of parameters that are evidence."""
        return sum(not p.aside for p in self.parameters)


@cache
def catalogue(folders: str | None = None) -> dict[str, Effect]:
    """List the effects by name: the files beside this one, and those in `folders`, or those $PARAUAV_EFFECTS names.

    Raises:
        ValueError: when a file holds no EFFECT of its own name.
    """
    named = os.environ.get(FOLDERS, "") if folders is None else folders
    homes = [Path(__file__).parent, *map(Path, filter(None, named.split(os.pathsep)))]
    files = [path for home in homes for path in sorted(home.glob("*.py")) if not path.stem.startswith("_")]
    return {path.stem: _read(path) for path in files}


def _read(path: Path) -> Effect:
    own = path.parent == Path(__file__).parent
    module = importlib.import_module(f"{__name__}.{path.stem}") if own else _load(path)
    effect = getattr(module, "EFFECT", None)
    if not isinstance(effect, Effect) or effect.name != path.stem:
        raise ValueError(f"{path.name}: found no EFFECT named {path.stem!r}, expected one; name it as the file")
    return effect


def _load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"parauav_effect_{path.stem}", path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise ValueError(f"{path}: found {error!r} on reading it, expected an effect; mend the file") from None
    return module
