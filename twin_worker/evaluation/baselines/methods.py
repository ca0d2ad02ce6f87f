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
from fleet.mission import route
from twin_worker.evaluation.baselines.route_line import Ride, line
from twin_worker.identification.fixed_wing.derivatives_model import Coupled
from twin_worker.prediction.closed_loop import fly_ahead
from twin_worker.prediction.kinematic import air_of
from twin_worker.prediction.multirotor.rollout import items_in_force
from twin_worker.prediction.turn_rate import turn_on
from twin_worker.telemetry.track import STEP, Track
from twin_worker.twin.state.state import Twin
from twin_worker.twin.state.vehicle_class import NO_WINGS

_VELOCITY_S = 0.3  # averaging time of the present velocity [s]
_TURN_S = 1.5  # window of the turn rate fit [s]
_OFF_S, _REJOIN_S = 6.0, 4.0  # time constants with which cross-track offset and speed decay [s]
_SPEED_UP_S = 4.0  # time constant of the approach to the commanded speed [s]
_SLOWEST = 1.0  # minimum speed along the route [m/s]
_LOOK_BACK_S = 62.0  # telemetry before a closed-loop prediction [s]


@dataclass(frozen=True)
class Now:
    """Input of a baseline method.

    Attributes:
        twin: telemetry so far, and the models identified from it
        track: recent positions and velocities, without gaps
        ahead: look-ahead from the end of `track`, rising, (k,) [s]
    """

    twin: Twin
    flown: Track
    ahead: np.ndarray

    @property
    def p(self) -> np.ndarray:
        """Return the newest position, NED, (3,) [m]."""
        return self.flown.p[-1]

    @property
    def v(self) -> np.ndarray:
        """Return the present velocity, NED, (3,) [m/s]."""
        return self.flown.v[-round(_VELOCITY_S / STEP) :].mean(axis=0)


def straight(now: Now) -> np.ndarray:
    """Predict at constant velocity, (k, 3) [m]."""
    return now.p + np.outer(now.ahead, now.v)


def turning(now: Now) -> np.ndarray:
    """Predict at constant turn rate and speed, (k, 3) [m]."""
    recent = now.flown.v[-round(_TURN_S / STEP) :]
    course = np.unwrap(np.arctan2(recent[:, 1], recent[:, 0]))
    rate = float(np.polyfit(STEP * np.arange(len(course)), course, 1)[0]) if len(course) > 3 else 0.0
    half = 0.5 * rate * now.ahead
    chord = np.hypot(*now.v[:2]) * now.ahead * np.sinc(half / np.pi)
    toward = np.arctan2(now.v[1], now.v[0]) + half
    return now.p + np.column_stack([chord * np.cos(toward), chord * np.sin(toward), now.ahead * now.v[2]])


def on_route(now: Now) -> np.ndarray | None:
    """Predict along the mission at the present ground speed, (k, 3) [m]; None without a mission."""
    return _ride(now, lambda points: np.full(len(points) - 1, np.hypot(*now.v[:2])))


def on_route_in_wind(now: Now) -> np.ndarray | None:
    """Predict along the mission at the commanded airspeed in the estimated wind, (k, 3) [m]; None without a mission."""
    if now.twin.vehicle in NO_WINGS:
        return _ride(now, lambda points: _level_speed(now, points))
    wind = now.twin.wind.wind if np.isfinite(now.twin.wind.t) else None
    w, V = air_of(now.flown, wind)
    params = now.twin.params.values if now.twin.params else {}
    par, absent = arduplane.parameters(params)
    scale = now.twin.wind.scale if wind is not None else 1.0

    def ground_speed(points: np.ndarray) -> np.ndarray:
        commanded = points[1:, 3]
        # a leg without commanded airspeed keeps the present one: after a jump back it is seldom the cruise parameter
        flown = commanded[0] <= 0 or "AIRSPEED_CRUISE" in absent
        cruise = V if flown else par[P.VA_CRUISE] * scale
        Va = np.where(commanded > 0, commanded * scale, cruise)
        way = np.diff(points[:, :2], axis=0)
        t = way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
        across = t[:, 0] * w[1] - t[:, 1] * w[0]
        return np.sqrt(np.maximum(Va**2 - across**2, 1.0)) + t @ w

    return _ride(now, ground_speed)


def _level_speed(now: Now, points: np.ndarray) -> np.ndarray:
    """Return the speed of a multirotor: as commanded, else the present speed."""
    return np.where(points[1:, 3] > 0, points[1:, 3], np.hypot(*now.v[:2]))


def _ride(now: Now, ground_speed: Callable[[np.ndarray], np.ndarray]) -> np.ndarray | None:
    """Predict along the route at the ground speed of each point, from the present position and velocity.

    Speed starts at the along-track component of the velocity and approaches the commanded speed with time constant
    `_ACCELERATION_S`, which models the time lost in a turn onto the route; cross-track position and velocity decay.
    """
    points = _line(now)
    if points is None:
        return None
    step = np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1)
    points, step = points[np.concatenate([[True], step > 1e-6])], step[step > 1e-6]
    if not len(step):
        return None
    speed = np.maximum(ground_speed(points), _SLOWEST)
    s, t = (np.concatenate([[0.0], np.cumsum(part)]) for part in (step, step / speed))
    ahead, way = np.maximum(now.ahead, 0.0), (points[1, :3] - points[0, :3]) / step[0]
    late = (speed[0] - now.v[:2] @ way[:2]) * _SPEED_UP_S * (1 - np.exp(-ahead / _SPEED_UP_S))
    at = np.maximum(np.interp(ahead, t, s) - late, 0.0)
    path = np.column_stack([np.interp(at, s, column) for column in points[:, :3].T])
    off, drift = now.p - points[0, :3], now.v - (now.v[:2] @ way[:2]) * way
    rest = np.outer(np.exp(-ahead / _OFF_S), off)
    return path + rest + np.outer(ahead * np.exp(-ahead / _REJOIN_S), drift + off / _OFF_S)


def _line(now: Now) -> np.ndarray | None:
    """Return the route ahead as points; None without a route or without a known active item."""
    twin = now.twin
    if twin.why_no_route() or twin.mission is None or twin.origin is None:
        return None
    seq = items_in_force(now.flown.t, twin.history.rows("leg"), twin.mission)
    if not np.isfinite(seq[-1]):
        return None
    params = twin.params.values if twin.params else {}
    first = twin.first_item
    way = route(twin.mission.items, seq=int(seq[-1]), origin=twin.origin, params=params, first=first)
    if not len(way.legs):
        return None
    other = np.flatnonzero(seq != seq[-1])
    past = now.flown.p[int(other[-1]) + 1 if len(other) else 0 :]
    speed = max(float(np.mean(np.hypot(*now.flown.v[-200:, :2].T))), _SLOWEST)
    length = (2.0 * speed + 10.0) * max(float(now.ahead[-1]), 1.0)
    return line(way, Ride(now.p, past, speed, arduplane.parameters(params)[0], length))


def coupled(now: Now) -> np.ndarray | None:
    """Predict with the identified derivatives model in closed loop, (k, 3) [m]; None without model or route."""
    twin = now.twin
    window = twin.window(_LOOK_BACK_S)
    if not isinstance(twin.plant, Coupled) or window is None or not window.ok[-1] or twin.why_no_route():
        return None
    ahead = now.ahead + (now.flown.t[-1] - window.t[-1])
    return fly_ahead(twin.situation(window), twin.plant, np.maximum(ahead, 0.0)).path


BASELINES: dict[str, Callable[[Now], np.ndarray | None]] = {
    "cv": straight,
    "ct": turning,
    "imm": lambda now: turn_on(now.flown, now.ahead),
    "route": on_route,
    "route_wind": on_route_in_wind,
    "dynamics": coupled,
}
