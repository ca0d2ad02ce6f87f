"""Missions of a blind test, with more manoeuvres than usual, and test pilot inputs for excitation."""

from math import atan2, cos, hypot, pi, radians, sin
from typing import NamedTuple

import numpy as np

from fleet.contract import Item
from fleet.frames import Origin, wrap
from fleet.simulator.vehicle.missions import (
    ABSOLUTE,
    DO_CHANGE_SPEED,
    DO_JUMP,
    LOITER_TURNS,
    WAYPOINT,
    StartState,
    mission_item,
)
from fleet.simulator.vehicle.types import Pilot

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
            items.append(
                mission_item(
                    len(items), DO_CHANGE_SPEED, EXAM_HOME, params=(0.0, round(speed * limits.cruise, 1), -1.0)
                )
            )
        if k == circle_at:
            radius = float(rng.choice([-1, 1])) * limits.circle
            items.append(mission_item(len(items), LOITER_TURNS, EXAM_HOME, waypoint, params=(1.0, 0.0, radius)))
        else:
            items.append(mission_item(len(items), WAYPOINT, EXAM_HOME, waypoint))
    first = next(i.seq for i in items[1:] if i.command == WAYPOINT)
    items.append(mission_item(len(items), DO_JUMP, EXAM_HOME, params=(1.0, -1.0)))
    return tuple(items), _start_before(rng, waypoints[0], waypoints[1], limits, first)


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


def _start_before(
    rng: np.random.Generator,
    waypoint: tuple[float, ...],
    next_waypoint: tuple[float, ...],
    limits: MissionLimits,
    seq: int,
) -> StartState:
    """Return a start state before the first waypoint, roughly in the direction of the second."""
    course = wrap(atan2(next_waypoint[1] - waypoint[1], next_waypoint[0] - waypoint[0]) + rng.uniform(-0.6, 0.6))
    distance = 10.0 * limits.cruise
    return StartState(
        seq, np.array([waypoint[0] - distance * cos(course), waypoint[1] - distance * sin(course), waypoint[2]]), course
    )


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
