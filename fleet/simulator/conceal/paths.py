"""Plan of a blind test: missions with more manoeuvres than usual, start and wind, test pilot inputs for excitation."""

from math import atan2, cos, exp, hypot, inf, log, pi, radians, sin
from typing import NamedTuple

import numpy as np

from fleet.contract import Item
from fleet.frames import Origin, wrap
from fleet.simulator.conceal.effects import HIDDEN, UNKNOWN, HiddenEffect, scaled_values
from fleet.simulator.faults.physics import Fault
from fleet.simulator.flight.uav import SimulatedUav
from fleet.simulator.vehicle.altered import instrumented_type
from fleet.simulator.vehicle.missions import (
    ABSOLUTE,
    DO_CHANGE_SPEED,
    DO_JUMP,
    LOITER_TURNS,
    WAYPOINT,
    StartState,
    mission_item,
)
from fleet.simulator.vehicle.types import AircraftType, FlightSetup, Pilot, Weather

EXAM_HOME = Origin(536_500_000, 80_500_000, 5_000)  # marshland by the sea [1e-7 deg, 1e-7 deg, mm]
"""Near sea level: the turbulence of JSBSim scales with the wind at 20 ft only below 1000 ft above sea level."""
_LEGS = 14
_SPEEDS = (0.90, 0.95, 1.0, 1.06, 1.12)  # of cruise
_TURNS_DEG = (30, 50, 70, 90, 110, 140)


class MissionLimits(NamedTuple):
    """Limits of the missions of one airframe."""

    cruise: float  # [m/s]
    leg: tuple[float, float]  # minimum and maximum length [m]
    max_range: float  # maximum distance of waypoints from home [m]
    height: tuple[float, float]  # minimum and maximum above home [m]
    slope: tuple[float, float]  # steepest climb and descent [-]
    circle: float  # radius [m]


MISSION_LIMITS = {
    "small": MissionLimits(23.0, (260.0, 520.0), 1_000.0, (80.0, 200.0), (0.075, 0.055), 95.0),
    "c172p": MissionLimits(48.0, (750.0, 1_500.0), 3_500.0, (110.0, 285.0), (0.042, 0.04), 450.0),
}


def draw_exam_mission(
    rng: np.random.Generator, airframe: str, steep: bool = False
) -> tuple[tuple[Item, ...], StartState]:
    """Draw a mission that turns both ways, climbs, descends and changes speed every other leg.

    Args:
        rng: random generator
        airframe: key of `MISSION_LIMITS`
        steep: climb and descend over the full height range, for effects that depend on height
    """
    limits = MISSION_LIMITS[airframe]
    waypoints = _random_walk(rng, limits, steep)
    items = [mission_item(0, WAYPOINT, EXAM_HOME, (0.0, 0.0, 0.0), frame=ABSOLUTE)]
    circle_at = int(rng.integers(5, 9))
    speed = 1.0
    for k, waypoint in enumerate(waypoints):
        if k % 2 == 0:
            speed = float(rng.choice([x for x in _SPEEDS if abs(x - speed) > 0.04]))
            params = (0.0, round(speed * limits.cruise, 1), -1.0)
            items.append(mission_item(len(items), DO_CHANGE_SPEED, EXAM_HOME, params=params))
        if k == circle_at:
            radius = float(rng.choice([-1, 1])) * limits.circle
            items.append(mission_item(len(items), LOITER_TURNS, EXAM_HOME, waypoint, params=(1.0, 0.0, radius)))
        else:
            items.append(mission_item(len(items), WAYPOINT, EXAM_HOME, waypoint))
    first = next(i.seq for i in items[1:] if i.command == WAYPOINT)
    items.append(mission_item(len(items), DO_JUMP, EXAM_HOME, params=(1.0, -1.0)))
    (n, e, d), (next_n, next_e, _) = waypoints[:2]
    course = wrap(atan2(next_e - e, next_n - n) + rng.uniform(-0.6, 0.6))  # roughly towards the second waypoint
    distance = 10.0 * limits.cruise
    p = np.array([n - distance * cos(course), e - distance * sin(course), d])
    return tuple(items), StartState(first, p, course)


def _random_walk(rng: np.random.Generator, limits: MissionLimits, steep: bool) -> list[tuple[float, float, float]]:
    """Draw waypoints, NED from home [m]; most turns alternate in direction."""
    bearing = rng.uniform(-pi, pi)
    n, e = 0.4 * limits.max_range * cos(bearing), 0.4 * limits.max_range * sin(bearing)
    h, course, side = rng.uniform(*limits.height), rng.uniform(-pi, pi), float(rng.choice([-1, 1]))
    waypoints = []
    for k in range(_LEGS):
        side *= -1 if rng.random() < 0.65 else 1
        turn, length = side * radians(float(rng.choice(_TURNS_DEG))), rng.uniform(*limits.leg)
        if hypot(n + length * cos(course + turn), e + length * sin(course + turn)) > limits.max_range:
            turn = float(np.clip(wrap(atan2(-e, -n) - course), -2.4, 2.4)) + rng.uniform(-0.2, 0.2)
        course = wrap(course + turn)
        n, e = n + length * cos(course), e + length * sin(course)
        climb, sink = limits.slope[0] * length, limits.slope[1] * length
        middle = sum(limits.height) / 2
        climbs = (k // 2) % 2 == 0 if steep else (h < middle) == (rng.random() < 0.7)
        slope_fraction = 1.0 if steep else rng.choice([0.0, 0.6, 1.0])
        h = float(np.clip(h + slope_fraction * (climb if climbs else -sink), *limits.height))
        waypoints.append((n, e, -h))
    return waypoints


_AMPLITUDES = {  # aileron, elevator, rudder, throttle, fractions of full travel
    "c172p": (0.07, 0.05, 0.2, 0.15),
    "small": (0.06, 0.05, 0.12, 0.12),
}
_N_SINES = 9  # sines of each input
_SURFACE_HZ, _THROTTLE_HZ = (0.12, 1.6), (0.02, 0.25)


def multisine(rng: np.random.Generator, airframe: str, strength: float) -> Pilot:
    """Draw test pilot inputs: different frequencies on each input, so that they do not correlate.

    Source: Morelli & Klein 2016, Aircraft System Identification, ch. 9 (orthogonal multisines), with random phases.
    """
    waves = []
    for i, amplitude in enumerate(_AMPLITUDES[airframe]):
        low, high = _THROTTLE_HZ if i == 3 else _SURFACE_HZ
        hertz = low * (high / low) ** ((np.arange(_N_SINES) + i / 4 + 0.1 * rng.random(_N_SINES)) / _N_SINES)
        waves.append((strength * amplitude * np.sqrt(2 / _N_SINES), 2 * pi * hertz, rng.uniform(-pi, pi, _N_SINES)))

    def pilot(t: float) -> tuple[float, float, float, float]:
        a, e, r, thrust = (float(scale * np.sin(omega * t + phase).sum()) for scale, omega, phase in waves)
        return a, e, r, thrust

    return pilot


SETTLE_S = 20.0  # simulated before the recording starts
NOMINAL_S, EXAMINED_S = 210.0, 200.0
NOMINAL_EXCITATION = (1.0, 0.8, 0.4, 0.0, 0.0)  # amplitude of the test pilot inputs on the nominal flights
_ONSET_S, _TRANSIENT_START_S = (50.0, 110.0), (45.0, 140.0)
_BASELINE_SETTINGS = {"propulsion/engine/propeller-sense": 0.0, "conceal/slipstream": 0.0}  # but as a hidden effect
_EXTRA_PARAMS = {"c172p": {"KFF_RDDRMIX": 0.3}, "small": {}}  # otherwise its rudder hardly moves
_STEEP_SHARE = 0.35  # fraction of flights over the full height range


class FlightJob(NamedTuple):
    """Requirements for one flight."""

    name: str  # file name without suffix
    airframe: str
    role: str
    effects: tuple[str, ...]  # names in `effects`
    number: int  # index in the blind test
    excitation: float = 0.0
    smallest: float = 1.0  # share of the usual magnitudes


class PlannedFlight(NamedTuple):
    """One flight with all random draws."""

    job: FlightJob
    seed: int  # of the blind test: draws the aircraft
    flight_seed: int  # draws everything else
    hidden_faults: tuple[Fault, ...]
    steep: bool
    seconds: float
    w20_mps: float = 1.5  # wind at 20 ft for turbulence: light

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
    if job.smallest < 1.0:
        shares = np.random.default_rng((flight_seed, 23)).uniform(log(job.smallest), 0.0, len(hidden_faults))
        hidden_faults = tuple(
            fault._replace(values=scaled_values(fault.name, fault.values, exp(share)))
            for fault, share in zip(hidden_faults, shares.tolist(), strict=True)
        )
    steep = "wind_shear" in job.effects or bool(rng.random() < _STEEP_SHARE)
    seconds = NOMINAL_S if job.role == "nominal" else EXAMINED_S
    return PlannedFlight(job, seed, flight_seed, hidden_faults, steep, seconds)


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
