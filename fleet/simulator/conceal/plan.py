"""One planned flight of a blind test, determined by its seeds."""

from math import inf, pi
from typing import NamedTuple

import numpy as np

from fleet.simulator.conceal.effects import HIDDEN, UNKNOWN, Hidden
from fleet.simulator.conceal.paths import FIELD, multisine, plan
from fleet.simulator.faults.fault import Fault
from fleet.simulator.flight.uav import PretendUav
from fleet.simulator.vehicle.altered import altered
from fleet.simulator.vehicle.situation import Situation, Weather
from fleet.simulator.vehicle.types import Type

SETTLE_S = 20.0  # simulated before the recording starts
NOMINAL_S, EXAMINED_S = 210.0, 200.0
EXCITED = (1.0, 0.8, 0.4, 0.0, 0.0)  # amplitude of the test pilot inputs on the nominal flights
_ONSET_S, _PASSES_S = (50.0, 110.0), (45.0, 140.0)
_QUIET = {"propulsion/engine/propeller-sense": 0.0, "conceal/slipstream": 0.0}  # zero except as a hidden effect
_MORE = {"c172p": {"KFF_RDDRMIX": 0.3}, "small": {}}  # otherwise its rudder hardly moves
_W20_MPS = 1.5  # light turbulence
_STEEP = 0.35  # fraction of flights over the full height range


class Job(NamedTuple):
    """Requirements for one flight."""

    name: str  # file name without suffix
    airframe: str
    role: str
    wanted: tuple[str, ...]  # effects
    number: int  # index in the blind test
    excited: float = 0.0


class Planned(NamedTuple):
    """One flight with all random draws."""

    job: Job
    seed: int  # of the blind test: draws the aircraft
    flight: int  # draws everything else
    hidden: tuple[Fault, ...]
    steep: bool
    w20_mps: float
    seconds: float

    def uav(self, faults: tuple[Fault, ...]) -> PretendUav:
        """Create the aircraft with `faults`: all hidden faults, some or none."""
        rng = np.random.default_rng((self.flight, 20))
        airframe = self.job.airframe
        way = plan(rng, airframe, self.steep)
        pilot = multisine(rng, airframe, self.job.excited) if self.job.excited else None
        situation = Situation(self.flight, quiet(airframe), way, self._weather(rng), pilot, examined=True)
        more = _MORE[airframe]
        return PretendUav(0, self.seed, origin=FIELD, aircraft=airframe, more=more, faults=faults, situation=situation)

    def _weather(self, rng: np.random.Generator) -> Weather:
        """Draw the wind; none for the Cessna, where it has little effect."""
        mean, towards = rng.uniform(1.0, 5.0), rng.uniform(-pi, pi)
        mean = 0.0 if self.job.airframe == "c172p" else float(mean)
        return Weather(mean, float(towards), exponent=0.0, drift=0.5, w20_mps=self.w20_mps)


def quiet(airframe: str) -> Type:
    """Return the instrumented type with all hidden effects disabled."""
    kind = altered(airframe)
    return kind._replace(settings=_QUIET) if kind.shipped else kind


def draw(job: Job, seed: int, attempt: int) -> Planned:
    """Draw a flight; each attempt gives a different one."""
    flight = int(np.random.SeedSequence((seed, job.number, attempt)).generate_state(1)[0])
    rng = np.random.default_rng((flight, 21))
    hidden = tuple(_fault(rng, name, job.airframe) for name in job.wanted)
    steep = "wind_shear" in job.wanted or bool(rng.random() < _STEEP)
    seconds = NOMINAL_S if job.role == "nominal" else EXAMINED_S
    return Planned(job, seed, flight, hidden, steep, _W20_MPS, seconds)


def _fault(rng: np.random.Generator, name: str, airframe: str) -> Fault:
    what = (HIDDEN | UNKNOWN)[name]
    values = what.draw(rng, airframe == "small")
    of = str(rng.choice(what.of))
    t0, ramp_s, t1 = _times(rng, what, steps=name == "wind_steady" and airframe == "small")
    return Fault(name, of, {key: float(value) for key, value in values.items()}, t0, ramp_s, t1)


def _times(rng: np.random.Generator, what: Hidden, steps: bool) -> tuple[float, float, float]:
    """Draw onset, ramp or edge duration, and end [s since simulation start]; `force_step` selects a step."""
    comes = "step" if steps else str(rng.choice(what.comes))
    onset = SETTLE_S + float(rng.uniform(*_ONSET_S))
    if comes == "pass":
        t0, lasts = SETTLE_S + float(rng.uniform(*_PASSES_S)), float(rng.uniform(8.0, 25.0))
        return t0, float(rng.choice([lasts / 2, lasts / 2, 0.2 * lasts])), t0 + lasts
    if comes == "ramp":
        return onset - 10.0, float(rng.uniform(50.0, 70.0)), inf
    return (onset, 0.0, inf) if comes == "step" else (0.0, 0.0, inf)
