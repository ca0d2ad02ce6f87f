"""One planned flight of a blind test, determined by its seeds."""

from math import inf, pi
from typing import NamedTuple

import numpy as np

from fleet.simulator.conceal.effects import HIDDEN, UNKNOWN, HiddenEffect
from fleet.simulator.conceal.paths import EXAM_HOME, draw_exam_mission, multisine
from fleet.simulator.faults.physics import Fault
from fleet.simulator.flight.uav import SimulatedUav
from fleet.simulator.vehicle.altered import instrumented_type
from fleet.simulator.vehicle.types import AircraftType, FlightSetup, Weather

SETTLE_S = 20.0  # simulated before the recording starts
NOMINAL_S, EXAMINED_S = 210.0, 200.0
NOMINAL_EXCITATION = (1.0, 0.8, 0.4, 0.0, 0.0)  # amplitude of the test pilot inputs on the nominal flights
_ONSET_S, _TRANSIENT_START_S = (50.0, 110.0), (45.0, 140.0)
_BASELINE_SETTINGS = {
    "propulsion/engine/propeller-sense": 0.0,
    "conceal/slipstream": 0.0,
}  # zero except as a hidden effect
_EXTRA_PARAMS = {"c172p": {"KFF_RDDRMIX": 0.3}, "small": {}}  # otherwise its rudder hardly moves
_W20_MPS = 1.5  # light turbulence
_STEEP_SHARE = 0.35  # fraction of flights over the full height range


class FlightJob(NamedTuple):
    """Requirements for one flight."""

    name: str  # file name without suffix
    airframe: str
    role: str
    effects: tuple[str, ...]  # effects
    number: int  # index in the blind test
    excitation: float = 0.0


class PlannedFlight(NamedTuple):
    """One flight with all random draws."""

    job: FlightJob
    seed: int  # of the blind test: draws the aircraft
    flight_seed: int  # draws everything else
    hidden_faults: tuple[Fault, ...]
    steep: bool
    w20_mps: float
    seconds: float

    def build_uav(self, faults: tuple[Fault, ...]) -> SimulatedUav:
        """Create the aircraft with `faults`: all hidden faults, some or none."""
        rng = np.random.default_rng((self.flight_seed, 20))
        airframe = self.job.airframe
        mission = draw_exam_mission(rng, airframe, self.steep)
        pilot = multisine(rng, airframe, self.job.excitation) if self.job.excitation else None
        setup = FlightSetup(
            self.flight_seed, baseline_type(airframe), mission, self._draw_weather(rng), pilot, is_exam=True
        )
        extra_params = _EXTRA_PARAMS[airframe]
        return SimulatedUav(
            0, self.seed, origin=EXAM_HOME, aircraft=airframe, extra_params=extra_params, faults=faults, setup=setup
        )

    def _draw_weather(self, rng: np.random.Generator) -> Weather:
        """Draw the wind; none for the Cessna, where it has little effect."""
        mean, towards = rng.uniform(1.0, 5.0), rng.uniform(-pi, pi)
        mean = 0.0 if self.job.airframe == "c172p" else float(mean)
        return Weather(mean, float(towards), exponent=0.0, drift=0.5, w20_mps=self.w20_mps)


def baseline_type(airframe: str) -> AircraftType:
    """Return the instrumented type with all hidden effects disabled."""
    kind = instrumented_type(airframe)
    return kind._replace(settings=_BASELINE_SETTINGS) if kind.from_jsbsim else kind


def draw_flight(job: FlightJob, seed: int, attempt: int) -> PlannedFlight:
    """Draw a flight; each attempt gives a different one."""
    flight_seed = int(np.random.SeedSequence((seed, job.number, attempt)).generate_state(1)[0])
    rng = np.random.default_rng((flight_seed, 21))
    hidden_faults = tuple(_draw_fault(rng, name, job.airframe) for name in job.effects)
    steep = "wind_shear" in job.effects or bool(rng.random() < _STEEP_SHARE)
    seconds = NOMINAL_S if job.role == "nominal" else EXAMINED_S
    return PlannedFlight(job, seed, flight_seed, hidden_faults, steep, _W20_MPS, seconds)


def _draw_fault(rng: np.random.Generator, name: str, airframe: str) -> Fault:
    effect = (HIDDEN | UNKNOWN)[name]
    values = effect.draw(rng, airframe == "small")
    part = str(rng.choice(effect.parts))
    t0, ramp_s, t1 = _draw_times(rng, effect, force_step=name == "wind_steady" and airframe == "small")
    return Fault(name, part, {key: float(value) for key, value in values.items()}, t0, ramp_s, t1)


def _draw_times(rng: np.random.Generator, effect: HiddenEffect, force_step: bool) -> tuple[float, float, float]:
    """Draw onset, ramp or edge duration, and end [s since simulation start]; `force_step` selects a step."""
    profile = "step" if force_step else str(rng.choice(effect.profiles))
    onset = SETTLE_S + float(rng.uniform(*_ONSET_S))
    if profile == "pass":
        t0, duration = SETTLE_S + float(rng.uniform(*_TRANSIENT_START_S)), float(rng.uniform(8.0, 25.0))
        return t0, float(rng.choice([duration / 2, duration / 2, 0.2 * duration])), t0 + duration
    if profile == "ramp":
        return onset - 10.0, float(rng.uniform(50.0, 70.0)), inf
    return (onset, 0.0, inf) if profile == "step" else (0.0, 0.0, inf)
