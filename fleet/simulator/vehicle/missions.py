"""Missions for simulated aircraft: random routes around a common home, with turns, climbs, loiters and speed changes.

Items are MAVLink mission items; the last is an endless DO_JUMP to the first waypoint. Item 0 is home. PX4 has no such
item, and loiters for a time where ArduPlane counts turns.
"""

from collections.abc import Iterator
from math import atan2, cos, hypot, pi, radians, sin
from typing import NamedTuple

import msgspec
import numpy as np

from fleet.contract import Item
from fleet.frames import Origin, to_geodetic, wrap

HOME = Origin(474_000_000, 85_000_000, 450_000)  # over open country [1e-7 deg, 1e-7 deg, mm]
WAYPOINT, LOITER_TURNS, LOITER_TIME, DO_JUMP, DO_CHANGE_SPEED = 16, 18, 19, 177, 178
ABSOLUTE, RELATIVE_ALT = 0, 3
MAX_RANGE_M = 1_300.0  # maximum distance of waypoints from home
LEGS = 10
TURNS_DEG = (25, 45, 60, 75, 90, 90, 110, 130, 150)
MIN_HEIGHT_M, MAX_HEIGHT_M = 80.0, 200.0  # above home


class MissionGeometry(NamedTuple):
    """Geometry of the missions of an aircraft type."""

    scale: float = 1.0  # factor of horizontal lengths
    circle: float = 1.0  # factor of radii
    height: float = 1.0  # factor of heights above home
    climb: float = 0.08  # maximum climb slope [-]
    sink: float = 0.055  # maximum descent slope at idle [-]


SMALL_GEOMETRY = MissionGeometry()


class StartState(NamedTuple):
    """State of an aircraft at simulation start."""

    seq: int  # current mission item
    p: np.ndarray  # position, NED from home, (3,) [m]
    psi: float  # heading, along the leg [rad]


class _WaypointWalk:
    """A random walk of waypoints, NED from home."""

    def __init__(self, rng: np.random.Generator, geometry: MissionGeometry):
        self._rng, self._geometry = rng, geometry
        self.course = rng.uniform(-pi, pi)
        radius = rng.uniform(200, 700) * geometry.scale
        bearing = rng.uniform(-pi, pi)
        self.n, self.e = radius * cos(bearing), radius * sin(bearing)
        self.h = rng.uniform(100, 180) * geometry.height

    def advance(self, turn: float, length: float, climb: float) -> None:
        """Turn by `turn` [rad], fly `length` [m], climb by `climb` [m]; beyond the maximum distance turn home."""
        n, e = self.n + length * cos(self.course + turn), self.e + length * sin(self.course + turn)
        if hypot(n, e) > MAX_RANGE_M * self._geometry.scale:
            home_turn = wrap(atan2(-self.e, -self.n) - self.course)
            turn = float(np.clip(home_turn, -2.4, 2.4)) + self._rng.uniform(-0.3, 0.3)
        self.course = wrap(self.course + turn)
        self.n += length * cos(self.course)
        self.e += length * sin(self.course)
        low, high = MIN_HEIGHT_M * self._geometry.height, MAX_HEIGHT_M * self._geometry.height
        self.h = float(np.clip(self.h + climb, low, high))

    def position(self) -> tuple[float, float, float]:
        """Return the current position, NED from home [m]."""
        return self.n, self.e, -self.h


def _draw_turn(rng: np.random.Generator, min_deg: float = 0.0) -> float:
    """Draw a turn, left or right [rad]."""
    return radians(rng.choice([t for t in TURNS_DEG if t >= min_deg])) * rng.choice([-1, 1])


def draw_mission(
    seed: int,
    cruise: float,
    origin: Origin = HOME,
    geometry: MissionGeometry = SMALL_GEOMETRY,
    autopilot: str = "ardupilot",
) -> tuple[tuple[Item, ...], StartState]:
    """Draw the endless mission of one aircraft and its start state before a turn.

    Args:
        seed: seed of all random draws
        cruise: mean of the commanded airspeeds [m/s]
        origin: home
        geometry: mission geometry of the aircraft type
        autopilot: ardupilot or px4, which interpret some items differently
    """
    rng = np.random.default_rng((seed, 2))
    walk, px4 = _WaypointWalk(rng, geometry), autopilot == "px4"
    items = [mission_item(0, WAYPOINT, origin, (0.0, 0.0, 0.0), frame=ABSOLUTE)]
    loiter_at = int(rng.integers(3, LEGS))
    previous = walk.position()
    for leg in range(LEGS):
        turn = _draw_turn(rng, min_deg=60) if leg == 2 else _draw_turn(rng)
        length = rng.uniform(350, 750) * geometry.scale
        slope = float(rng.choice([0, 0, geometry.climb, -geometry.sink, geometry.climb, -geometry.sink]))
        climb = slope * rng.uniform(0.5, 1.0) * length
        walk.advance(turn, length, climb)
        if leg == 1:
            start = _start_before_turn(rng, (previous, walk.position()), len(items), geometry.scale)
        if leg == loiter_at:
            radius = float(rng.choice([-1, 1])) * rng.uniform(80, 120) * geometry.circle
            turn_s = round(2 * pi * abs(radius) / cruise)
            command, params = (LOITER_TIME, (turn_s, 1.0, radius)) if px4 else (LOITER_TURNS, (1.0, 0.0, radius))
            items.append(mission_item(len(items), command, origin, walk.position(), params=params))
        else:
            items.append(mission_item(len(items), WAYPOINT, origin, walk.position()))
        if leg in (3, 7):
            speed = cruise * float(rng.choice([0.9, 1.0, 1.12]))
            items.append(mission_item(len(items), DO_CHANGE_SPEED, origin, params=(0.0, round(speed, 1), -1.0)))
        previous = walk.position()
    items.append(mission_item(len(items), DO_JUMP, origin, params=(1.0, -1.0)))
    return (tuple(_renumber_from_zero(items[1:])), start._replace(seq=start.seq - 1)) if px4 else (tuple(items), start)


_PAPER_LEGS = (1, 1, 1, 0, 0, -1, -1, -1, 0)  # height change of the paper's legs: climb, level, descent [-]
_PAPER_LEG_M, _PAPER_HEIGHT_M = (250.0, 350.0), 95.0  # length of a leg; height of the low level legs above home


def paper_mission(
    seed: int, origin: Origin = HOME, geometry: MissionGeometry = SMALL_GEOMETRY
) -> tuple[tuple[Item, ...], StartState]:
    """Draw the mission of the paper's figure 6: climb, level flight, turns and descent in one endless lap.

    Three legs climb, two are level, three descend and one is level, at constant airspeed; a turn joins any two.

    Args:
        seed: seed of all random draws
        origin: home
        geometry: mission geometry of the aircraft type
    """
    rng = np.random.default_rng((seed, 12))
    side, course = float(rng.choice([-1, 1])), rng.uniform(-pi, pi)
    turns = rng.dirichlet(np.full(len(_PAPER_LEGS), 12.0)) * 2 * pi  # sum up to one lap
    lengths = rng.uniform(*_PAPER_LEG_M, len(_PAPER_LEGS)) * geometry.scale
    courses = course + side * np.cumsum(turns)
    steps = lengths * np.array([np.cos(courses), np.sin(courses)])
    steps -= steps.mean(axis=1, keepdims=True)  # the lap is closed
    corners = np.cumsum(steps, axis=1) + np.array([[rng.uniform(-300, 300)], [rng.uniform(-300, 300)]]) * geometry.scale
    slope = rng.uniform(0.8, 1.0) * min(geometry.climb, geometry.sink)
    climbs = slope * np.hypot(*steps) * np.array(_PAPER_LEGS)
    climbs[climbs < 0] *= -climbs[climbs > 0].sum() / climbs[climbs < 0].sum()  # and level with its start
    heights = _PAPER_HEIGHT_M * geometry.height + np.cumsum(climbs)
    items = [mission_item(0, WAYPOINT, origin, (0.0, 0.0, 0.0), frame=ABSOLUTE)]
    for (north, east), height in zip(corners.T, heights, strict=True):
        corner = float(north), float(east), -float(height)
        items.append(mission_item(len(items), WAYPOINT, origin, corner))
    items.append(mission_item(len(items), DO_JUMP, origin, params=(1.0, -1.0)))
    start = np.array([corners[0, -1], corners[1, -1], -float(heights[-1])])
    return tuple(items), StartState(1, start, float(courses[0]))


def _renumber_from_zero(items: list[Item]) -> Iterator[Item]:
    """Renumber items from zero, including the jump target."""
    for entry in items:
        first = entry.param1 - 1 if entry.command == DO_JUMP else entry.param1
        yield msgspec.structs.replace(entry, seq=entry.seq - 1, param1=first)


def _start_before_turn(rng: np.random.Generator, leg: tuple[tuple, tuple], seq: int, scale: float) -> StartState:
    """Return a start state on the leg, about ten seconds before the next turn."""
    p, q = np.array(leg[0]), np.array(leg[1])
    length = hypot(q[0] - p[0], q[1] - p[1])
    fraction = 1 - rng.uniform(120, 280) * scale / max(length, 300.0 * scale)
    return StartState(seq, p + (q - p) * max(fraction, 0.05), atan2(q[1] - p[1], q[0] - p[0]))


def mission_item(
    seq: int,
    command: int,
    origin: Origin,
    ned: tuple[float, float, float] | None = None,
    *,
    params: tuple[float, ...] = (),
    frame: int = RELATIVE_ALT,
) -> Item:
    """Create one item; commands without a position have zero coordinates."""
    lat, lon, alt_mm = to_geodetic(origin, np.array(ned)) if ned is not None else (0, 0, 0)
    alt = 0.0 if ned is None else alt_mm * 1e-3 - (origin.alt_mm * 1e-3 if frame == RELATIVE_ALT else 0.0)
    p = (*params, 0.0, 0.0, 0.0, 0.0)
    item = Item(seq=seq, command=command, frame=frame, param1=p[0], param2=p[1], param3=p[2], param4=p[3])
    return msgspec.structs.replace(item, lat_e7=int(lat), lon_e7=int(lon), alt_m=round(float(alt), 2))
