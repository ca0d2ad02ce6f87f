"""Baseline methods for comparison, with the same telemetry and no later data.

cv          constant velocity
ct          constant turn rate and constant speed
imm         interacting multiple model of straight flight and turns, by filterpy
route       the mission at the present ground speed
route_wind  the mission at the commanded airspeed in the estimated wind, rejoined smoothly
paper       two linear axes, identified and refined, in closed loop with the controller twin (a separate twin)
dynamics    the identified derivatives model in closed loop with the controller twin, independent of model selection
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from filterpy.kalman import IMMEstimator, KalmanFilter

from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel
from twin_worker.numerics.interpolation import interpolate_rows
from twin_worker.prediction.closed_loop import fly_ahead
from twin_worker.prediction.constant_turn import STEP, imm, recent_rows, turn_models
from twin_worker.telemetry.track import Track
from twin_worker.twin.state.state import Twin
from twin_worker.twin.steps.route_lines import (
    ROUTE_SPEED,
    ROUTE_WIND,
    constant_turn,
    constant_velocity,
    present_velocity,
    route_lines,
)

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
        return present_velocity(self.track)


def _route_line(method: str) -> Callable[[BaselineInput], np.ndarray | None]:
    """Return the baseline of one route line; it predicts None without a mission."""
    return lambda inputs: route_lines(inputs.twin, inputs.track, inputs.ahead).get(method)


def closed_loop_dynamics(inputs: BaselineInput) -> np.ndarray | None:
    """Predict with the identified derivatives model in closed loop, (k, 3) [m]; None without model or route."""
    twin = inputs.twin
    window, model = twin.window(_HISTORY_S), twin.models.active_model
    if not isinstance(model, DerivativesModel) or window is None or not window.ok[-1] or twin.no_route_reason():
        return None
    ahead = inputs.ahead + (inputs.track.t[-1] - window.t[-1])
    return fly_ahead(twin.situation(window), model, np.maximum(ahead, 0.0)).path


def filterpy_prediction(track: Track, ahead: np.ndarray) -> np.ndarray | None:
    """Predict as `constant_turn_prediction`, with the filter of filterpy, (k, 3) [m]; None with less than four rows."""
    p, v = recent_rows(track)
    if len(p) < 4:
        return None
    path, steps = imm(p, v, ahead), int(np.ceil(ahead[-1] / STEP))
    path[:, :2] = interpolate_rows(ahead, STEP * np.arange(steps + 1), filterpy_path(p, v, steps))
    return path


def filterpy_path(p: np.ndarray, v: np.ndarray, steps: int) -> np.ndarray:
    """Return the mean north and east position now and after each step of `STEP`, (steps + 1, 2) [m].

    Args:
        p: recent positions every `STEP` seconds, NED, newest last, (n, 3) [m]
        v: recent velocities over ground, NED, (n, 3) [m/s]
        steps: of the prediction
    """
    rows = np.column_stack([p[:, 0], v[:, 0], p[:, 1], v[:, 1]])
    transition, start_probability, R, models = turn_models()
    filters = [KalmanFilter(dim_x=4, dim_z=4) for _ in models]
    for one, (F, Q) in zip(filters, models, strict=True):
        one.F, one.Q, one.H, one.R, one.P, one.x = F, Q, np.eye(4), R, np.eye(4), rows[0].copy()
    estimator = IMMEstimator(filters, start_probability, transition)
    for row in rows[1:]:
        estimator.predict()
        estimator.update(row)
    mu, x = estimator.mu, np.stack([one.x for one in filters])
    out = [mu @ x]
    for _ in range(steps):  # `predict` alone would not propagate the probabilities
        mixed = mu @ transition
        x = np.stack([one.F @ ((transition[:, j] * mu) @ x / mixed[j]) for j, one in enumerate(filters)])
        mu = mixed
        out.append(mu @ x)
    return np.array(out)[:, [0, 2]]


BASELINES: dict[str, Callable[[BaselineInput], np.ndarray | None]] = {
    "cv": lambda now: constant_velocity(now.track, now.ahead),
    "ct": lambda now: constant_turn(now.track, now.ahead),
    "imm": lambda now: filterpy_prediction(now.track, now.ahead),
    "route": _route_line(ROUTE_SPEED),
    "route_wind": _route_line(ROUTE_WIND),
    "dynamics": closed_loop_dynamics,
}
