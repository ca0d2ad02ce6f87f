"""Route ahead as a line of points: straight legs, circles with their tangents, sharp corners.

Columns of a point: north, east, down [m], commanded airspeed [m/s], 0 for cruise. The line is purely geometric, as
drawn by a ground station: no guidance, bank angle or energy.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import acos, atan2, cos, hypot, pi, sin

import numpy as np

from fleet.autopilots.arduplane import params as P
from fleet.mission import (
    KIND,
    LOITER_TIME,
    LOITER_TO_ALT,
    LOITER_TURNS,
    LOITER_UNLIMITED,
    P_D,
    P_N,
    RADIUS,
    TURNS,
    VA_C,
    Route,
)

_CIRCLES = (LOITER_TURNS, LOITER_UNLIMITED, LOITER_TIME, LOITER_TO_ALT)
_STEP = 5.0  # between points [m]
_ON_CIRCLE = 1.3  # an aircraft within this many radii is on the circle [-]
_LATE = 0.6  # a circle is left at once if the exit direction was passed by less than this [rad]
_CLIMB = 2.5  # climb while circling to an altitude [m/s]


@dataclass(frozen=True)
class Ride:
    """Inputs of the line besides the route.

    Attributes:
        position: of the aircraft, NED, (3,) [m]
        on_item: positions since the active item began, NED, oldest first, (n, 3) [m]
        speed: usual ground speed [m/s]
        params: autopilot parameters
        length: required length of the line [m]
    """

    p: np.ndarray
    past: np.ndarray
    speed: float
    par: np.ndarray
    length: float


def line(way: Route, ride: Ride) -> np.ndarray:
    """Return the route from the point abeam the aircraft on, points every few metres, (n, 4)."""
    parts, left = [], ride.length
    at = way.start if np.isfinite(way.start).all() else ride.past[0]
    at = _abreast(at, way.legs[0, P_N : P_D + 1], ride.p)
    for k, leg in enumerate(way.legs):
        after = way.legs[k + 1, P_N : P_N + 2] if k + 1 < len(way.legs) else None
        for part in _leg(leg, at, after, ride, first=k == 0):
            parts.append(np.column_stack([part, np.full(len(part), leg[VA_C])]))
            left -= float(np.linalg.norm(np.diff(part[:, :2], axis=0), axis=1).sum())
        at = parts[-1][-1, :3]
        if left < 0:
            break
    return np.vstack(parts)


def _abreast(start: np.ndarray, end: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return the point of a straight leg horizontally nearest to the aircraft, (3,) [m]."""
    way = end - start
    share = (p[:2] - start[:2]) @ way[:2] / max(float(way[:2] @ way[:2]), 1e-6)
    return start + np.clip(share, 0.0, 1.0) * way


def _leg(leg: np.ndarray, at: np.ndarray, after: np.ndarray | None, ride: Ride, *, first: bool) -> Iterator[np.ndarray]:
    """Yield the points of one leg, (n, 3) each part: the straight part, then the circle."""
    target = leg[P_N : P_D + 1]
    if int(leg[KIND]) not in _CIRCLES:
        yield _straight(at, target, ride.length)
        return
    wanted = leg[RADIUS] or ride.par[P.LOITER_RAD]
    R, side = max(abs(wanted), 1.0), 1.0 if wanted >= 0 else -1.0
    at = ride.p if first else at
    out = at[:2] - target[:2]
    D, angle = hypot(*out), atan2(out[1], out[0])
    if first and _ON_CIRCLE * R > D:
        done = _swept(ride.past, target, _ON_CIRCLE * R)
    else:
        done = 0.0
        angle += side * acos(min(R / max(D, R), 1.0))
        edge = np.array([*(target[:2] + R * np.array([cos(angle), sin(angle)])), target[2]])
        yield _straight(at, edge, ride.length)
    arc = max(_arc(leg, R, at, ride) - done, 0.0)
    if after is not None and int(leg[KIND]) != LOITER_UNLIMITED:
        arc += _to_tangent(angle + side * arc, target, after, (R, side))
    arc = min(arc, ride.length / R + 2 * pi)
    sweep = angle + side * np.linspace(0.0, arc, int(arc * R / _STEP) + 2)
    yield target + R * np.column_stack([np.cos(sweep), np.sin(sweep), np.zeros(len(sweep))])


def _straight(start: np.ndarray, end: np.ndarray, longest: float) -> np.ndarray:
    """Return points from start towards end, up to a maximum length, (n, 3) [m]."""
    length = hypot(*(end - start)[:2])
    share = min(longest / max(length, 1e-6), 1.0)
    along = np.linspace(0.0, share, int(share * length / _STEP) + 2)[:, None]
    return start + along * (end - start)


def _swept(past: np.ndarray, centre: np.ndarray, within: float) -> float:
    """Return the angle flown around a centre since the circle was reached [rad]."""
    out = past[:, :2] - centre[:2]
    near = np.hypot(*out.T) < within
    on = out[int(np.argmax(near)) :] if near.any() else out[:0]
    around = np.unwrap(np.arctan2(on[:, 1], on[:, 0]))
    return float(abs(around[-1] - around[0])) if len(around) else 0.0


def _arc(leg: np.ndarray, R: float, at: np.ndarray, ride: Ride) -> float:
    """Return the angle to circle according to the item: turns, time or altitude [rad]."""
    kind = int(leg[KIND])
    if kind == LOITER_TURNS:
        return 2 * pi * leg[TURNS]
    if kind == LOITER_TIME:
        return leg[TURNS] * ride.speed / R
    if kind == LOITER_TO_ALT:
        return abs(leg[P_D] - at[2]) / _CLIMB * ride.speed / R
    return ride.length / R + 2 * pi  # unlimited


def _to_tangent(angle: float, centre: np.ndarray, after: np.ndarray, circle: tuple[float, float]) -> float:
    """Return the further angle to circle until the course points at the next target [rad]."""
    R, side = circle
    out = after - centre[:2]
    leave = atan2(out[1], out[0]) - side * acos(R / max(hypot(*out), R))
    return max((((leave - angle) * side) + _LATE) % (2 * pi) - _LATE, 0.0)
