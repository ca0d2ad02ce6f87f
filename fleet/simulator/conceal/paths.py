"""Missions of a blind test, with more manoeuvres than usual, and test pilot inputs for excitation."""

from math import atan2, cos, hypot, pi, radians, sin
from typing import NamedTuple

import numpy as np

from fleet.contract import Item
from fleet.frames import Origin, wrap
from fleet.simulator.vehicle.missions import ABSOLUTE, DO_CHANGE_SPEED, DO_JUMP, LOITER_TURNS, WAYPOINT, Start, item
from fleet.simulator.vehicle.situation import Pilot

FIELD = Origin(536_500_000, 80_500_000, 5_000)  # marshland by the sea [1e-7 deg, 1e-7 deg, mm]
"""Near sea level: the turbulence of JSBSim scales with the wind at 20 ft only below 1000 ft above sea level."""
_LEGS = 14
_SPEEDS = (0.90, 0.95, 1.0, 1.06, 1.12)  # of cruise
_TURNS_DEG = (30, 50, 70, 90, 110, 140)


class Ground(NamedTuple):
    """Limits of the missions of one airframe."""

    cruise: float  # [m/s]
    leg: tuple[float, float]  # minimum and maximum length [m]
    reach: float  # maximum distance of waypoints from home [m]
    height: tuple[float, float]  # minimum and maximum above home [m]
    slope: tuple[float, float]  # steepest climb and descent [-]
    circle: float  # radius [m]


GROUNDS = {
    "small": Ground(23.0, (260.0, 520.0), 1_000.0, (80.0, 200.0), (0.075, 0.055), 95.0),
    "c172p": Ground(48.0, (750.0, 1_500.0), 3_500.0, (110.0, 285.0), (0.042, 0.04), 450.0),
}


def plan(rng: np.random.Generator, airframe: str, steep: bool = False) -> tuple[tuple[Item, ...], Start]:
    """Draw a mission that turns both ways, climbs, descends and changes speed every other leg.

    Args:
        rng: random generator
        airframe: key of `MISSION_LIMITS`
        steep: climb and descend over the full height range, for effects that depend on height
    """
    ground = GROUNDS[airframe]
    spots = _walk(rng, ground, steep)
    items = [item(0, WAYPOINT, FIELD, (0.0, 0.0, 0.0), frame=ABSOLUTE)]
    circle_at = int(rng.integers(5, 9))
    speed = 1.0
    for k, spot in enumerate(spots):
        if k % 2 == 0:
            speed = float(rng.choice([x for x in _SPEEDS if abs(x - speed) > 0.04]))
            items.append(item(len(items), DO_CHANGE_SPEED, FIELD, params=(0.0, round(speed * ground.cruise, 1), -1.0)))
        if k == circle_at:
            radius = float(rng.choice([-1, 1])) * ground.circle
            items.append(item(len(items), LOITER_TURNS, FIELD, spot, params=(1.0, 0.0, radius)))
        else:
            items.append(item(len(items), WAYPOINT, FIELD, spot))
    first = next(i.seq for i in items[1:] if i.command == WAYPOINT)
    items.append(item(len(items), DO_JUMP, FIELD, params=(1.0, -1.0)))
    return tuple(items), _before(rng, spots[0], spots[1], ground, first)


def _walk(rng: np.random.Generator, ground: Ground, steep: bool) -> list[tuple[float, float, float]]:
    """Draw waypoints, NED from home [m]; most turns alternate in direction."""
    bearing = rng.uniform(-pi, pi)
    n, e = 0.4 * ground.reach * cos(bearing), 0.4 * ground.reach * sin(bearing)
    h, course, side = rng.uniform(*ground.height), rng.uniform(-pi, pi), float(rng.choice([-1, 1]))
    spots = []
    for k in range(_LEGS):
        side *= -1 if rng.random() < 0.65 else 1
        turn, length = side * radians(float(rng.choice(_TURNS_DEG))), rng.uniform(*ground.leg)
        if hypot(n + length * cos(course + turn), e + length * sin(course + turn)) > ground.reach:
            turn = float(np.clip(wrap(atan2(-e, -n) - course), -2.4, 2.4)) + rng.uniform(-0.2, 0.2)
        course = wrap(course + turn)
        n, e = n + length * cos(course), e + length * sin(course)
        climb, sink = ground.slope[0] * length, ground.slope[1] * length
        middle = sum(ground.height) / 2
        up = (k // 2) % 2 == 0 if steep else (h < middle) == (rng.random() < 0.7)
        effort = 1.0 if steep else rng.choice([0.0, 0.6, 1.0])
        h = float(np.clip(h + effort * (climb if up else -sink), *ground.height))
        spots.append((n, e, -h))
    return spots


def _before(
    rng: np.random.Generator, spot: tuple[float, ...], then: tuple[float, ...], ground: Ground, seq: int
) -> Start:
    """Return a start state before the first waypoint, roughly in the direction of the second."""
    course = wrap(atan2(then[1] - spot[1], then[0] - spot[0]) + rng.uniform(-0.6, 0.6))
    back = 10.0 * ground.cruise
    return Start(seq, np.array([spot[0] - back * cos(course), spot[1] - back * sin(course), spot[2]]), course)


_AMPLITUDES = {  # aileron, elevator, rudder, throttle, fractions of full travel
    "c172p": (0.07, 0.05, 0.2, 0.15),
    "small": (0.06, 0.05, 0.12, 0.12),
}
_LINES = 9  # sines of each input
_SURFACE_HZ, _THROTTLE_HZ = (0.12, 1.6), (0.02, 0.25)


def multisine(rng: np.random.Generator, airframe: str, strength: float) -> Pilot:
    """Draw test pilot inputs: different frequencies on each input, so that they do not correlate.

    Source: Morelli & Klein 2016, Aircraft System Identification, ch. 9 (orthogonal multisines), with random phases.
    """
    waves = []
    for i, amplitude in enumerate(_AMPLITUDES[airframe]):
        low, high = _THROTTLE_HZ if i == 3 else _SURFACE_HZ
        hertz = low * (high / low) ** ((np.arange(_LINES) + i / 4 + 0.1 * rng.random(_LINES)) / _LINES)
        waves.append((strength * amplitude * np.sqrt(2 / _LINES), 2 * pi * hertz, rng.uniform(-pi, pi, _LINES)))

    def pilot(t: float) -> tuple[float, float, float, float]:
        a, e, r, thrust = (float(scale * np.sin(omega * t + phase).sum()) for scale, omega, phase in waves)
        return a, e, r, thrust

    return pilot
