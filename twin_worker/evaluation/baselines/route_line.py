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
_CIRCLE_RADII = 1.3  # an aircraft within this many radii is on the circle [-]
_EXIT_TOLERANCE = 0.6  # a circle is left at once if the exit direction was passed by less than this [rad]
_CLIMB_RATE = 2.5  # climb while circling to an altitude [m/s]


@dataclass(frozen=True)
class LineInputs:
    """Inputs of the line besides the route.

    Attributes:
        position: of the aircraft, NED, (3,) [m]
        on_item: positions since the active item began, NED, oldest first, (n, 3) [m]
        speed: usual ground speed [m/s]
        params: autopilot parameters
        length: required length of the line [m]
    """

    position: np.ndarray
    on_item: np.ndarray
    speed: float
    params: np.ndarray
    length: float


def route_line(route: Route, inputs: LineInputs) -> np.ndarray:
    """Return the route from the point abeam the aircraft on, points every few metres, (n, 4)."""
    parts, remaining = [], inputs.length
    start = route.start if np.isfinite(route.start).all() else inputs.on_item[0]
    start = _nearest_point(start, route.legs[0, P_N : P_D + 1], inputs.position)
    for k, leg in enumerate(route.legs):
        next_target = route.legs[k + 1, P_N : P_N + 2] if k + 1 < len(route.legs) else None
        for part in _leg_points(leg, start, next_target, inputs, first=k == 0):
            parts.append(np.column_stack([part, np.full(len(part), leg[VA_C])]))
            remaining -= float(np.linalg.norm(np.diff(part[:, :2], axis=0), axis=1).sum())
        start = parts[-1][-1, :3]
        if remaining < 0:
            break
    return np.vstack(parts)


def _nearest_point(start: np.ndarray, end: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the point of a straight leg horizontally nearest to the aircraft, (3,) [m]."""
    vector = end - start
    share = (position[:2] - start[:2]) @ vector[:2] / max(float(vector[:2] @ vector[:2]), 1e-6)
    return start + np.clip(share, 0.0, 1.0) * vector


def _leg_points(
    leg: np.ndarray, start: np.ndarray, next_target: np.ndarray | None, inputs: LineInputs, *, first: bool
) -> Iterator[np.ndarray]:
    """Yield the points of one leg, (n, 3) each part: the straight part, then the circle."""
    target = leg[P_N : P_D + 1]
    if int(leg[KIND]) not in _CIRCLES:
        yield _straight_points(start, target, inputs.length)
        return
    signed_radius = leg[RADIUS] or inputs.params[P.LOITER_RAD]
    R, side = max(abs(signed_radius), 1.0), 1.0 if signed_radius >= 0 else -1.0
    start = inputs.position if first else start
    radial = start[:2] - target[:2]
    D, angle = hypot(*radial), atan2(radial[1], radial[0])
    if first and _CIRCLE_RADII * R > D:
        traversed_angle = _traversed_angle(inputs.on_item, target, _CIRCLE_RADII * R)
    else:
        traversed_angle = 0.0
        angle += side * acos(min(R / max(D, R), 1.0))
        edge = np.array([*(target[:2] + R * np.array([cos(angle), sin(angle)])), target[2]])
        yield _straight_points(start, edge, inputs.length)
    arc = max(_commanded_angle(leg, R, start, inputs) - traversed_angle, 0.0)
    if next_target is not None and int(leg[KIND]) != LOITER_UNLIMITED:
        arc += _angle_to_exit(angle + side * arc, target, next_target, (R, side))
    arc = min(arc, inputs.length / R + 2 * pi)
    sweep = angle + side * np.linspace(0.0, arc, int(arc * R / _STEP) + 2)
    yield target + R * np.column_stack([np.cos(sweep), np.sin(sweep), np.zeros(len(sweep))])


def _straight_points(start: np.ndarray, end: np.ndarray, max_length: float) -> np.ndarray:
    """Return points from start towards end, up to a maximum length, (n, 3) [m]."""
    length = hypot(*(end - start)[:2])
    share = min(max_length / max(length, 1e-6), 1.0)
    along = np.linspace(0.0, share, int(share * length / _STEP) + 2)[:, None]
    return start + along * (end - start)


def _traversed_angle(track: np.ndarray, centre: np.ndarray, max_radius: float) -> float:
    """Return the angle flown around a centre since the circle was reached [rad]."""
    radial = track[:, :2] - centre[:2]
    inside = np.hypot(*radial.T) < max_radius
    on_circle = radial[int(np.argmax(inside)) :] if inside.any() else radial[:0]
    around = np.unwrap(np.arctan2(on_circle[:, 1], on_circle[:, 0]))
    return float(abs(around[-1] - around[0])) if len(around) else 0.0


def _commanded_angle(leg: np.ndarray, R: float, start: np.ndarray, inputs: LineInputs) -> float:
    """Return the angle to circle according to the item: turns, time or altitude [rad]."""
    kind = int(leg[KIND])
    if kind == LOITER_TURNS:
        return 2 * pi * leg[TURNS]
    if kind == LOITER_TIME:
        return leg[TURNS] * inputs.speed / R
    if kind == LOITER_TO_ALT:
        return abs(leg[P_D] - start[2]) / _CLIMB_RATE * inputs.speed / R
    return inputs.length / R + 2 * pi  # unlimited


def _angle_to_exit(angle: float, centre: np.ndarray, next_target: np.ndarray, circle: tuple[float, float]) -> float:
    """Return the further angle to circle until the course points at the next target [rad]."""
    R, side = circle
    radial = next_target - centre[:2]
    exit_angle = atan2(radial[1], radial[0]) - side * acos(R / max(hypot(*radial), R))
    return max((((exit_angle - angle) * side) + _EXIT_TOLERANCE) % (2 * pi) - _EXIT_TOLERANCE, 0.0)
