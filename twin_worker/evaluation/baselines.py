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

from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel
from twin_worker.prediction.closed_loop import fly_ahead
from twin_worker.prediction.constant_turn import constant_turn_prediction
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


BASELINES: dict[str, Callable[[BaselineInput], np.ndarray | None]] = {
    "cv": lambda now: constant_velocity(now.track, now.ahead),
    "ct": lambda now: constant_turn(now.track, now.ahead),
    "imm": lambda now: constant_turn_prediction(now.track, now.ahead),
    "route": _route_line(ROUTE_SPEED),
    "route_wind": _route_line(ROUTE_WIND),
    "dynamics": closed_loop_dynamics,
}
