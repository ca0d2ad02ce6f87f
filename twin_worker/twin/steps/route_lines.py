"""Simple methods: the route at the present ground speed or at the commanded airspeed in wind, and kinematics alone.

They use neither model nor controller. Method selection scores them beside the closed-loop predictions, so that no
prediction is worse than the simple way for long; `fleet assess` uses them as baselines.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import acos, atan2, cos, hypot, pi, sin

import numpy as np

from fleet.autopilots import arduplane
from fleet.autopilots.arduplane import params as P
from fleet.mission import (
    CONSTANT_BANK,
    GLIDE,
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
    route_items,
)
from twin_worker.prediction.kinematic import wind_and_airspeed
from twin_worker.prediction.multirotor.rollout import items_in_force
from twin_worker.prediction.route_cache import cached_route
from twin_worker.telemetry.track import STEP, Track
from twin_worker.twin.state.routes import present_route
from twin_worker.twin.state.state import Twin

ROUTE_SPEED, ROUTE_WIND = "route_speed", "route_wind"
CONSTANT_TURN, CONSTANT_VELOCITY = "constant_turn", "constant_velocity"
LAW, KINEMATIC_LAW = "none: route line", "none: turn rate only"
SIMPLE_METHODS = {ROUTE_WIND: LAW, ROUTE_SPEED: LAW, CONSTANT_TURN: KINEMATIC_LAW, CONSTANT_VELOCITY: KINEMATIC_LAW}
"""Law of each simple method."""
_CIRCLES = (LOITER_TURNS, LOITER_UNLIMITED, LOITER_TIME, LOITER_TO_ALT)
_STEP = 5.0  # between points [m]
_CIRCLE_RADII = 1.3  # an aircraft within this many radii is on the circle [-]
_EXIT_TOLERANCE = 0.6  # a circle is left at once if the exit direction was passed by less than this [rad]
_CLIMB_RATE = 2.5  # climb while circling to an altitude [m/s]
_TURN_S = 1.5  # window of the turn rate fit [s]
_VELOCITY_S = 0.3  # averaging time of the present velocity [s]
_OFFSET_S, _REJOIN_S = 6.0, 4.0  # time constants with which cross-track offset and speed decay [s]
_ACCELERATION_S = 4.0  # time constant of the approach to the commanded speed [s]
_MIN_SPEED = 1.0  # minimum speed along the route [m/s]


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
    arc = min(arc, 2.0 * inputs.length / R)  # more is not flown
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


def present_velocity(track: Track) -> np.ndarray:
    """Return the velocity at the end of a track, averaged over a few rows, NED, (3,) [m/s]."""
    return track.v[-round(_VELOCITY_S / STEP) :].mean(axis=0)


def constant_velocity(track: Track, ahead: np.ndarray) -> np.ndarray:
    """Predict at constant velocity from the end of a track, NED, (k, 3) [m]; ahead: look-ahead, (k,) [s]."""
    return track.p[-1] + np.outer(ahead, present_velocity(track))


def constant_turn(track: Track, ahead: np.ndarray) -> np.ndarray:
    """Predict at constant turn rate and speed from the end of a track, NED, (k, 3) [m]; ahead: (k,) [s]."""
    velocity = present_velocity(track)
    recent = track.v[-round(_TURN_S / STEP) :]
    course = np.unwrap(np.arctan2(recent[:, 1], recent[:, 0]))
    rate = float(np.polyfit(STEP * np.arange(len(course)), course, 1)[0]) if len(course) > 3 else 0.0
    half = 0.5 * rate * ahead
    chord = np.hypot(*velocity[:2]) * ahead * np.sinc(half / np.pi)
    direction = np.arctan2(velocity[1], velocity[0]) + half
    return track.p[-1] + np.column_stack([chord * np.cos(direction), chord * np.sin(direction), ahead * velocity[2]])


def simple_paths(twin: Twin, track: Track, ahead: np.ndarray) -> dict[str, np.ndarray]:
    """Return the path of each simple method, NED, (k, 3) [m]; arguments as for `route_lines`."""
    by_method = route_lines(twin, track, ahead)
    return by_method | {
        CONSTANT_TURN: constant_turn(track, ahead),
        CONSTANT_VELOCITY: constant_velocity(track, ahead),
    }


def route_lines(twin: Twin, track: Track, ahead: np.ndarray) -> dict[str, np.ndarray]:
    """Return the path along each route line by method, NED, (k, 3) [m]; empty without a route or an active item.

    Args:
        twin: source of mission, parameters and wind
        track: recent positions and velocities, without gaps
        ahead: look-ahead from the end of `track`, rising, (k,) [s]
    """
    points = _route_points(twin, track, float(ahead[-1]))
    if points is None:
        return {}
    speed = float(np.hypot(*present_velocity(track)[:2]))
    by_method = {
        ROUTE_SPEED: np.full(len(points) - 1, speed),
        ROUTE_WIND: _commanded_ground_speed(twin, track, points),
    }
    return {name: _follow(track, ahead, points, ground_speed) for name, ground_speed in by_method.items()}


def _commanded_ground_speed(twin: Twin, track: Track, points: np.ndarray) -> np.ndarray:
    """Return the ground speed at the commanded airspeed in the estimated wind on each step between points, (n,) [m/s].

    A multirotor is commanded a ground speed. A leg without commanded speed keeps the present one.
    """
    commanded = points[1:, 3]
    if twin.vehicle_class.is_rotorcraft:
        return np.where(commanded > 0, commanded, np.hypot(*present_velocity(track)[:2]))
    wind = twin.environment.wind.wind if np.isfinite(twin.environment.wind.t) else None
    wind_ne, airspeed = wind_and_airspeed(track, wind)
    values, absent = arduplane.parameters(twin.received_params)
    scale = twin.environment.wind.scale if wind is not None else 1.0
    # a leg without commanded airspeed keeps the present one: after a jump back it is seldom the cruise parameter
    keep_speed = commanded[0] <= 0 or "AIRSPEED_CRUISE" in absent
    cruise = airspeed if keep_speed else values[P.VA_CRUISE] * scale
    Va = np.where(commanded > 0, commanded * scale, cruise)
    legs = np.diff(points[:, :2], axis=0)
    direction = legs / np.maximum(np.linalg.norm(legs, axis=1, keepdims=True), 1e-9)
    cross_wind = direction[:, 0] * wind_ne[1] - direction[:, 1] * wind_ne[0]
    return np.sqrt(np.maximum(Va**2 - cross_wind**2, 1.0)) + direction @ wind_ne


def _follow(track: Track, ahead: np.ndarray, points: np.ndarray, ground_speed: np.ndarray) -> np.ndarray:
    """Predict along the points at a ground speed on each step, from the present position and velocity, (k, 3) [m].

    Speed starts at the along-track component of the velocity and approaches the commanded speed with time constant
    `_ACCELERATION_S`, which models the time lost in a turn onto the route; cross-track position and velocity decay.
    """
    position, velocity = track.p[-1], present_velocity(track)
    step = np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1)
    speed = np.maximum(ground_speed, _MIN_SPEED)
    length, time = (np.concatenate([[0.0], np.cumsum(part)]) for part in (step, step / speed))
    ahead, direction = np.maximum(ahead, 0.0), (points[1, :3] - points[0, :3]) / step[0]
    lag = (speed[0] - velocity[:2] @ direction[:2]) * _ACCELERATION_S * (1 - np.exp(-ahead / _ACCELERATION_S))
    progress = np.maximum(np.interp(ahead, time, length) - lag, 0.0)
    path = np.column_stack([np.interp(progress, length, column) for column in points[:, :3].T])
    offset, drift = position - points[0, :3], velocity - (velocity[:2] @ direction[:2]) * direction
    residual = np.outer(np.exp(-ahead / _OFFSET_S), offset)
    return path + residual + np.outer(ahead * np.exp(-ahead / _REJOIN_S), drift + offset / _OFFSET_S)


def _route_points(twin: Twin, track: Track, seconds: float) -> np.ndarray | None:
    """Return the route ahead as distinct points with commanded speed, (n, 4); None without route or active item."""
    if twin.no_route_reason() or twin.telemetry.origin is None:
        return None
    params = twin.received_params
    seq, remaining = np.zeros(len(track.t)), present_route(twin)
    if remaining is None:
        if twin.onboard.mission is None:
            return None
        seq = items_in_force(track.t, twin.telemetry.history.rows_since("leg"), twin.onboard.mission)
        if not np.isfinite(seq[-1]):
            return None
        items, jumps = route_items(twin.onboard.mission), twin.onboard.jumps_taken
        remaining = cached_route(items, int(seq[-1]), twin.telemetry.origin, params, twin.first_item, jumps=jumps)
    if not len(remaining.legs) or int(remaining.legs[0, KIND]) in (CONSTANT_BANK, GLIDE):
        return None
    other_item = np.flatnonzero(seq != seq[-1])
    on_item = track.p[int(other_item[-1]) + 1 if len(other_item) else 0 :]
    speed = max(float(np.mean(np.hypot(*track.v[-200:, :2].T))), _MIN_SPEED)
    length = (2.0 * speed + 10.0) * max(seconds, 1.0)
    points = route_line(remaining, LineInputs(track.p[-1], on_item, speed, arduplane.parameters(params)[0], length))
    distinct = np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1) > 1e-6
    points = points[np.concatenate([[True], distinct])]
    return points if len(points) > 1 else None
