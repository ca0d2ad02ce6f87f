"""Update the point-mass model of one aircraft: identify it, and activate it if its hold-out error is low."""

import numpy as np

from fleet.window import Window
from twin_worker.identification.fixed_wing.plant import PAPER
from twin_worker.identification.fixed_wing.point_mass_model import FIT_WINDOW_S, MIN_FIT_S, identify
from twin_worker.prediction.autopilot_identification import REPLAY_INTERVAL_S, identify_autopilot
from twin_worker.prediction.closed_loop import fly_from, synchronise_controller
from twin_worker.prediction.fixed_wing.point_mass_rollout import fly_point_mass
from twin_worker.prediction.replay_window import Rollout
from twin_worker.twin.state.state import Twin

IDENTIFY_PERIOD_S = 5.0  # between identifications [s]
_HOLD_OUT_S = 20.0  # newest flight, held out [s]
_REPLACE_AFTER_S = 60.0  # flight after a fault onset before the model adapted by a diagnosis is replaced [s]
_CHECK_PERIOD_S = 10.0  # between checks on held-out flight [s]
_MAX_ERROR = 0.10  # final error over path length below which the model predicts, and below that of the active one [-]


def update_point_mass(twin: Twin) -> None:
    """Identify the point-mass model if it is due; `twin.models.point_mass` is None until its error is low enough.

    Low enough is an error below the limit, or below that of the active model over the same flight.
    """
    newest = twin.telemetry.history.newest
    if twin.no_route_reason() or not twin.models.point_mass_timer.due(newest, IDENTIFY_PERIOD_S):
        return
    window = twin.window(FIT_WINDOW_S + _HOLD_OUT_S)
    replay_t = twin.environment.autopilot.replay_t
    if window is not None and not replay_t <= newest < replay_t + REPLAY_INTERVAL_S:
        identify_autopilot(twin.environment.autopilot, twin.autopilot, twin.situation(window))
    flight = window and window.part(int(np.searchsorted(window.t, twin.identification.data_from)), len(window))
    min_s = MIN_FIT_S + _HOLD_OUT_S if twin.models.active_effect is None else _REPLACE_AFTER_S
    if window is None or flight is None or flight.ok.sum() < min_s / window.dt + 1 or twin.config.method == PAPER:
        return
    twin.models.point_mass_timer.restart(newest)
    if twin.models.holdout_timer.due(newest, _CHECK_PERIOD_S):
        twin.models.holdout_timer.restart(newest)
        twin.models.update_holdout_errors(*_holdout_errors(twin, flight))
    warm_start = twin.models.point_mass_warm_start
    model = identify(flight, twin.telemetry.history, twin.environment.wind.scale, warm_start)
    twin.models.store_point_mass(model, verified=twin.models.point_mass_is_better_than(_MAX_ERROR))


def _holdout_errors(twin: Twin, window: Window) -> tuple[float, float]:
    """Return the final errors over held-out flight, divided by its path length [-]: of the point mass and of the
    active model; nan: not known.
    """
    n_held_out = int(_HOLD_OUT_S / window.dt)
    training = window.part(0, len(window) - n_held_out)
    if training.ok.sum() * window.dt < MIN_FIT_S:
        return float("nan"), float("nan")
    situation = twin.situation(training)
    initial = synchronise_controller(situation)
    if isinstance(initial, Rollout):
        return float("nan"), float("nan")
    model = identify(training, twin.telemetry.history, twin.environment.wind.scale, twin.models.point_mass_warm_start)
    ahead = np.array([0.0, _HOLD_OUT_S])
    path_length = float(np.linalg.norm(np.diff(window.p[-n_held_out:], axis=0), axis=1).sum())

    def error_of(rollout: Rollout) -> float:
        if rollout.path is None:
            return 1.0
        return float(np.linalg.norm(rollout.path[-1] - window.p[-1])) / max(path_length, 1.0)

    error = error_of(fly_point_mass(situation, initial, model, ahead))
    active = twin.models.active_model
    if active is None or error < _MAX_ERROR:  # then the active model does not matter
        return error, float("nan")
    return error, error_of(fly_from(initial, active, ahead))
