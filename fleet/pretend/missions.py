"""Missions for pretend aircraft: each its own walk round a common home, with turns, climbs, loiters and speed changes.

Items are as MAVLink knows them; item 0 is home; the last is a DO_JUMP back to the first waypoint, for ever.
"""

from math import atan2, cos, hypot, pi, radians, sin
from typing import NamedTuple

import numpy as np

from fleet.contract import Item
from fleet.frames import Origin, to_geodetic, wrap

HOME = Origin(474_000_000, 85_000_000, 450_000)  # over open country [1e-7 deg, 1e-7 deg, mm]
WAYPOINT, LOITER_TURNS, DO_JUMP, DO_CHANGE_SPEED = 16, 18, 177, 178
ABSOLUTE, RELATIVE_ALT = 0, 3
REACH_M = 1_300.0  # waypoints stay this near to home
LEGS = 10
TURNS_DEG = (25, 45, 60, 75, 90, 90, 110, 130, 150)
LOW_M, HIGH_M = 80.0, 200.0  # above home
CLIMB, SINK = 0.08, 0.055  # steepest slopes: what the motor lifts, what an idling motor sinks [-]


class Start(NamedTuple):
    """Where an aircraft is found when the world begins."""

    seq: int  # mission item it flies to
    p: np.ndarray  # position, NED from home, (3,) [m]
    psi: float  # heading, along the leg [rad]


class _Walk:
    """A random walk of waypoints, NED from home."""

    def __init__(self, rng: np.random.Generator):
        self._rng = rng
        self.course = rng.uniform(-pi, pi)
        radius = rng.uniform(200, 700)
        bearing = rng.uniform(-pi, pi)
        self.n, self.e = radius * cos(bearing), radius * sin(bearing)
        self.h = rng.uniform(100, 180)

    def advance(self, turn: float, length: float, climb: float) -> None:
        """Turn by `turn` [rad], fly `length` [m], climb by `climb` [m]; turn homewards when too far out."""
        if hypot(self.n + length * cos(self.course + turn), self.e + length * sin(self.course + turn)) > REACH_M:
            home = wrap(atan2(-self.e, -self.n) - self.course)
            turn = float(np.clip(home, -2.4, 2.4)) + self._rng.uniform(-0.3, 0.3)
        self.course = wrap(self.course + turn)
        self.n += length * cos(self.course)
        self.e += length * sin(self.course)
        self.h = float(np.clip(self.h + climb, LOW_M, HIGH_M))

    def spot(self) -> tuple[float, float, float]:
        """Give the current spot, NED from home [m]."""
        return self.n, self.e, -self.h


def _turn(rng: np.random.Generator, at_least: float = 0.0) -> float:
    """Draw a turn, left or right [rad]."""
    return radians(rng.choice([t for t in TURNS_DEG if t >= at_least])) * rng.choice([-1, 1])


def mission(seed: int, cruise: float, origin: Origin = HOME) -> tuple[tuple[Item, ...], Start]:
    """Make one aircraft's endless mission and the place it is found at, in front of a turn.

    Args:
        seed: draws everything
        cruise: airspeed the speed changes are about [m/s]
        origin: home
    """
    rng = np.random.default_rng((seed, 2))
    walk = _Walk(rng)
    items = [_item(0, WAYPOINT, origin, (0.0, 0.0, 0.0), frame=ABSOLUTE)]
    loiter_at = int(rng.integers(3, LEGS))
    before = walk.spot()
    for leg in range(LEGS):
        turn = _turn(rng, at_least=60) if leg == 2 else _turn(rng)
        length = rng.uniform(350, 750)
        climb = float(rng.choice([0, 0, CLIMB, -SINK, CLIMB, -SINK])) * rng.uniform(0.5, 1.0) * length
        walk.advance(turn, length, climb)
        if leg == 1:
            start = _before_turn(rng, before, walk.spot(), len(items))
        if leg == loiter_at:
            radius = float(rng.choice([-1, 1])) * rng.uniform(80, 120)
            items.append(_item(len(items), LOITER_TURNS, origin, walk.spot(), params=(1.0, 0.0, radius)))
        else:
            items.append(_item(len(items), WAYPOINT, origin, walk.spot()))
        if leg in (3, 7):
            speed = cruise * float(rng.choice([0.9, 1.0, 1.12]))
            items.append(_item(len(items), DO_CHANGE_SPEED, origin, params=(0.0, round(speed, 1), -1.0)))
        before = walk.spot()
    items.append(_item(len(items), DO_JUMP, origin, params=(1.0, -1.0)))
    return tuple(items), start


def _before_turn(rng: np.random.Generator, a: tuple, b: tuple, seq: int) -> Start:
    """Stand on the leg a -> b, so near to b that the next turn begins within about ten seconds."""
    p, q = np.array(a), np.array(b)
    length = hypot(q[0] - p[0], q[1] - p[1])
    share = 1 - rng.uniform(120, 280) / max(length, 300.0)
    return Start(seq, p + (q - p) * max(share, 0.05), atan2(q[1] - p[1], q[0] - p[0]))


def _item(
    seq: int,
    command: int,
    origin: Origin,
    ned: tuple[float, float, float] | None = None,
    *,
    params: tuple[float, ...] = (),
    frame: int = RELATIVE_ALT,
) -> Item:
    """Make one item; commands without a place keep zero coordinates."""
    lat, lon, alt_mm = to_geodetic(origin, np.array(ned)) if ned is not None else (0, 0, 0)
    alt = 0.0 if ned is None else alt_mm * 1e-3 - (origin.alt_mm * 1e-3 if frame == RELATIVE_ALT else 0.0)
    p = (*params, 0.0, 0.0, 0.0, 0.0)
    return Item(
        seq=seq,
        command=command,
        frame=frame,
        param1=p[0],
        param2=p[1],
        param3=p[2],
        param4=p[3],
        lat_e7=int(lat),
        lon_e7=int(lon),
        alt_m=round(float(alt), 2),
    )
