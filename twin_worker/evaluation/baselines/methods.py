"""Baseline methods for comparison, with the same telemetry and no later data.

cv          constant velocity
ct          constant turn rate and constant speed
imm         interacting multiple model of straight flight and turns
route       the mission at the present ground speed
route_wind  the mission at the commanded airspeed in the estimated wind, rejoined smoothly
paper       two linear axes, identified and refined, in closed loop with the controller twin (a separate twin)
dynamics    the identified derivatives model in closed loop with the controller twin, independent of model selection
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fleet.autopilots import arduplane
from fleet.autopilots.arduplane import params as P
from fleet.mission import unroll_route
from twin_worker.evaluation.baselines.route_line import LineInputs, route_line
from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel
from twin_worker.prediction.closed_loop import fly_ahead
from twin_worker.prediction.kinematic import wind_and_airspeed
from twin_worker.prediction.method_selection import constant_turn_prediction
from twin_worker.prediction.multirotor.rollout import items_in_force
from twin_worker.telemetry.track import STEP, Track
from twin_worker.twin.state.state import Twin
from twin_worker.twin.state.vehicle_class import WINGLESS

_VELOCITY_S = 0.3  # averaging time of the present velocity [s]
_TURN_S = 1.5  # window of the turn rate fit [s]
_OFFSET_S, _REJOIN_S = 6.0, 4.0  # time constants with which cross-track offset and speed decay [s]
_ACCELERATION_S = 4.0  # time constant of the approach to the commanded speed [s]
_MIN_SPEED = 1.0  # minimum speed along the route [m/s]
_HISTORY_S = 62.0  # telemetry before a closed-loop prediction [s]


@dataclass(frozen=True)
class BaselineInput:
    """Input of a baseline method.

    Attributes:
        twin: telemetry so far, and the models identified from it
        track: recent positions and velocities, without gaps
        ahead: look-ahead from the end of `track`, rising, (k,) [s]
    """

    twin: Twin
    track: Track
    ahead: np.ndarray

    @property
    def position(self) -> np.ndarray:
        """Return the newest position, NED, (3,) [m]."""
        return self.track.p[-1]

    @property
    def velocity(self) -> np.ndarray:
        """Return the present velocity, NED, (3,) [m/s]."""
        return self.track.v[-round(_VELOCITY_S / STEP) :].mean(axis=0)


def constant_velocity(inputs: BaselineInput) -> np.ndarray:
    """Predict at constant velocity, (k, 3) [m]."""
    return inputs.position + np.outer(inputs.ahead, inputs.velocity)


def constant_turn(inputs: BaselineInput) -> np.ndarray:
    """Predict at constant turn rate and speed, (k, 3) [m]."""
    recent = inputs.track.v[-round(_TURN_S / STEP) :]
    course = np.unwrap(np.arctan2(recent[:, 1], recent[:, 0]))
    rate = float(np.polyfit(STEP * np.arange(len(course)), course, 1)[0]) if len(course) > 3 else 0.0
    half = 0.5 * rate * inputs.ahead
    chord = np.hypot(*inputs.velocity[:2]) * inputs.ahead * np.sinc(half / np.pi)
    direction = np.arctan2(inputs.velocity[1], inputs.velocity[0]) + half
    return inputs.position + np.column_stack(
        [chord * np.cos(direction), chord * np.sin(direction), inputs.ahead * inputs.velocity[2]]
    )


def route_at_ground_speed(inputs: BaselineInput) -> np.ndarray | None:
    """Predict along the mission at the present ground speed, (k, 3) [m]; None without a mission."""
    return _follow_route(inputs, lambda points: np.full(len(points) - 1, np.hypot(*inputs.velocity[:2])))


def route_in_wind(inputs: BaselineInput) -> np.ndarray | None:
    """Predict along the mission at the commanded airspeed in the estimated wind, (k, 3) [m]; None without a mission."""
    if inputs.twin.vehicle in WINGLESS:
        return _follow_route(inputs, lambda points: _multirotor_speed(inputs, points))
    wind = inputs.twin.environment.wind.wind if np.isfinite(inputs.twin.environment.wind.t) else None
    wind_ne, airspeed = wind_and_airspeed(inputs.track, wind)
    params = inputs.twin.onboard.params.values if inputs.twin.onboard.params else {}
    values, absent = arduplane.parameters(params)
    scale = inputs.twin.environment.wind.scale if wind is not None else 1.0

    def ground_speed(points: np.ndarray) -> np.ndarray:
        commanded = points[1:, 3]
        # a leg without commanded airspeed keeps the present one: after a jump back it is seldom the cruise parameter
        keep_speed = commanded[0] <= 0 or "AIRSPEED_CRUISE" in absent
        cruise = airspeed if keep_speed else values[P.VA_CRUISE] * scale
        Va = np.where(commanded > 0, commanded * scale, cruise)
        legs = np.diff(points[:, :2], axis=0)
        direction = legs / np.maximum(np.linalg.norm(legs, axis=1, keepdims=True), 1e-9)
        cross_wind = direction[:, 0] * wind_ne[1] - direction[:, 1] * wind_ne[0]
        return np.sqrt(np.maximum(Va**2 - cross_wind**2, 1.0)) + direction @ wind_ne

    return _follow_route(inputs, ground_speed)


def _multirotor_speed(inputs: BaselineInput, points: np.ndarray) -> np.ndarray:
    """Return the speed of a multirotor: as commanded, else the present speed."""
    return np.where(points[1:, 3] > 0, points[1:, 3], np.hypot(*inputs.velocity[:2]))


def _follow_route(inputs: BaselineInput, ground_speed: Callable[[np.ndarray], np.ndarray]) -> np.ndarray | None:
    """Predict along the route at the ground speed of each point, from the present position and velocity.

    Speed starts at the along-track component of the velocity and approaches the commanded speed with time constant
    `_ACCELERATION_S`, which models the time lost in a turn onto the route; cross-track position and velocity decay.
    """
    points = _route_points(inputs)
    if points is None:
        return None
    step = np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1)
    points, step = points[np.concatenate([[True], step > 1e-6])], step[step > 1e-6]
    if not len(step):
        return None
    speed = np.maximum(ground_speed(points), _MIN_SPEED)
    length, time = (np.concatenate([[0.0], np.cumsum(part)]) for part in (step, step / speed))
    ahead, direction = np.maximum(inputs.ahead, 0.0), (points[1, :3] - points[0, :3]) / step[0]
    lag = (speed[0] - inputs.velocity[:2] @ direction[:2]) * _ACCELERATION_S * (1 - np.exp(-ahead / _ACCELERATION_S))
    progress = np.maximum(np.interp(ahead, time, length) - lag, 0.0)
    path = np.column_stack([np.interp(progress, length, column) for column in points[:, :3].T])
    offset, drift = inputs.position - points[0, :3], inputs.velocity - (inputs.velocity[:2] @ direction[:2]) * direction
    residual = np.outer(np.exp(-ahead / _OFFSET_S), offset)
    return path + residual + np.outer(ahead * np.exp(-ahead / _REJOIN_S), drift + offset / _OFFSET_S)


def _route_points(inputs: BaselineInput) -> np.ndarray | None:
    """Return the route ahead as points; None without a route or without a known active item."""
    twin = inputs.twin
    if twin.no_route_reason() or twin.onboard.mission is None or twin.telemetry.origin is None:
        return None
    seq = items_in_force(inputs.track.t, twin.telemetry.history.rows("leg"), twin.onboard.mission)
    if not np.isfinite(seq[-1]):
        return None
    params = twin.onboard.params.values if twin.onboard.params else {}
    first = twin.first_item
    remaining = unroll_route(
        twin.onboard.mission.items, seq=int(seq[-1]), origin=twin.telemetry.origin, params=params, first=first
    )
    if not len(remaining.legs):
        return None
    other_item = np.flatnonzero(seq != seq[-1])
    on_item = inputs.track.p[int(other_item[-1]) + 1 if len(other_item) else 0 :]
    speed = max(float(np.mean(np.hypot(*inputs.track.v[-200:, :2].T))), _MIN_SPEED)
    length = (2.0 * speed + 10.0) * max(float(inputs.ahead[-1]), 1.0)
    return route_line(remaining, LineInputs(inputs.position, on_item, speed, arduplane.parameters(params)[0], length))


def closed_loop_dynamics(inputs: BaselineInput) -> np.ndarray | None:
    """Predict with the identified derivatives model in closed loop, (k, 3) [m]; None without model or route."""
    twin = inputs.twin
    window = twin.window(_HISTORY_S)
    if (
        not isinstance(twin.models.active_model, DerivativesModel)
        or window is None
        or not window.ok[-1]
        or twin.no_route_reason()
    ):
        return None
    ahead = inputs.ahead + (inputs.track.t[-1] - window.t[-1])
    return fly_ahead(twin.situation(window), twin.models.active_model, np.maximum(ahead, 0.0)).path


BASELINES: dict[str, Callable[[BaselineInput], np.ndarray | None]] = {
    "cv": constant_velocity,
    "ct": constant_turn,
    "imm": lambda now: constant_turn_prediction(now.track, now.ahead),
    "route": route_at_ground_speed,
    "route_wind": route_in_wind,
    "dynamics": closed_loop_dynamics,
}
