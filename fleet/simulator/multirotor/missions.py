"""Missions of simulated multirotors: take-off, waypoints, waits, a circle, speed changes, return and landing.

Item 0 is home on ArduPilot; PX4 has no such item, and waits where ArduCopter circles. A lap is flown two or three
times; after the landing the aircraft starts again.
"""

from collections.abc import Iterator
from math import atan2, cos, hypot, pi, radians, sin
from typing import NamedTuple

import msgspec
import numpy as np

from fleet.contract import Item
from fleet.frames import Origin, to_geodetic, wrap
from fleet.simulator.vehicle.missions import ABSOLUTE, DO_CHANGE_SPEED, DO_JUMP, LOITER_TIME, LOITER_TURNS, WAYPOINT
from fleet.simulator.vehicle.missions import mission_item as item

RETURN, LAND, TAKEOFF, DELAY = 20, 21, 22, 93
_LEGS = 8
_TURNS_DEG = (20, 45, 60, 90, 90, 120, 150)
_MAX_RANGE_M, _MIN_HEIGHT_M, _MAX_HEIGHT_M = 320.0, 25.0, 90.0  # from home
_HOME_RANGE_M = 250.0  # range of the homes of different aircraft around the common origin


class MultirotorMission(NamedTuple):
    """Mission of one aircraft."""

    items: tuple[Item, ...]
    home: Origin


def draw_mission(seed: int, autopilot: str, cruise: float, origin: Origin) -> MultirotorMission:
    """Draw the mission of one aircraft, and its home near a common origin.

    Args:
        seed: seed of all random draws
        autopilot: ardupilot or px4
        cruise: speed of the autopilot's parameters [m/s]
        origin: common origin
    """
    rng = np.random.default_rng((seed, 2))
    offset = np.array([*rng.uniform(-_HOME_RANGE_M, _HOME_RANGE_M, 2), 0.0])
    lat, lon, alt = to_geodetic(origin, offset)
    home, px4 = Origin(int(lat), int(lon), int(alt)), autopilot == "px4"
    height = float(rng.uniform(_MIN_HEIGHT_M, 50.0))
    items = [item(0, WAYPOINT, home, (0.0, 0.0, 0.0), frame=ABSOLUTE)]
    items.append(item(1, TAKEOFF, home, (0.0, 0.0, -height)))
    n = e = 0.0
    course = rng.uniform(-pi, pi)
    circle_at, wait_at, loiter_at, pause_at = (int(k) for k in rng.permutation(np.arange(1, _LEGS))[:4])
    for leg in range(_LEGS):
        course, (n, e) = _next_point(rng, course, (n, e))
        height = float(np.clip(height + rng.choice([0, 0, 0, -15, 15, 25]), _MIN_HEIGHT_M, _MAX_HEIGHT_M))
        point, seq = (n, e, -height), len(items)
        if leg == circle_at and not px4:
            radius = float(rng.choice([-1, 1]) * rng.choice([10, 15, 25]))
            items.append(item(seq, LOITER_TURNS, home, point, params=(float(rng.integers(1, 3)), 0.0, radius)))
        elif leg in (loiter_at, circle_at):
            items.append(item(seq, LOITER_TIME, home, point, params=(float(rng.integers(8, 20)), 0.0, 1.0)))
        else:
            hold = float(rng.integers(3, 9)) if leg == wait_at else 0.0
            items.append(item(seq, WAYPOINT, home, point, params=(hold,)))
        if leg == pause_at:
            items.append(item(len(items), DELAY, home, params=(float(rng.integers(4, 10)), -1.0, -1.0, -1.0)))
        if leg in (2, 5):
            speed = round(cruise * float(rng.choice([0.6, 0.8, 1.0, 1.25])), 1)
            items.append(item(len(items), DO_CHANGE_SPEED, home, params=(1.0, speed, -1.0)))
    items.append(item(len(items), DO_JUMP, home, params=(2.0, float(rng.integers(1, 3)))))
    items.append(item(len(items), RETURN, home))
    return MultirotorMission(tuple(_without_home(items)) if px4 else tuple(items), home)


def _next_point(
    rng: np.random.Generator, course: float, point: tuple[float, float]
) -> tuple[float, tuple[float, float]]:
    """Return course [rad] and end of the next leg [m]; far from home it turns back."""
    n, e = point
    course = wrap(course + radians(rng.choice(_TURNS_DEG)) * rng.choice([-1, 1]))
    length = float(rng.uniform(35.0, 140.0))
    if hypot(n + length * cos(course), e + length * sin(course)) > _MAX_RANGE_M:
        course = wrap(atan2(-e, -n) + rng.uniform(-0.5, 0.5))
    return course, (n + length * cos(course), e + length * sin(course))


def _without_home(items: list[Item]) -> Iterator[Item]:
    """Leave out item 0 and renumber, including the jump target."""
    for entry in items[1:]:
        first = entry.param1 - 1 if entry.command == DO_JUMP else entry.param1
        yield msgspec.structs.replace(entry, seq=entry.seq - 1, param1=first)
