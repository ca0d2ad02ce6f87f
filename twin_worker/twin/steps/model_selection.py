"""Select the active model: the verified model with the lowest closed-loop error on held-out data."""

import msgspec
import numpy as np

from fleet.contract import Outcome, Verdict
from fleet.window import Window
from twin_worker.identification.fixed_wing.plant import Plant
from twin_worker.prediction.closed_loop import InitialCondition, Rollout, fly_from, synchronise_controller
from twin_worker.twin.state.models import VerifiedModel
from twin_worker.twin.state.state import Twin

SELECTION_PERIOD_S = 6.0  # between closed-loop runs of the same models [s]
_HINDCAST_S = 20.0  # length of the closed-loop run over the newest data [s]
_MAX_MODELS = 3  # number of verified models kept
_NEW_MODEL_FACTOR = 1.2  # factor on the error of a new model, which has only one run so far [-]


def select_model(twin: Twin, window: Window, n_train: int, plant: Plant, verdict: Verdict) -> Verdict:
    """Run every verified model in closed loop over the newest data and activate the one with the lowest error.

    Args:
        twin: its list of verified models is updated
        window: flight; rows from `n_train` on are held out
        n_train: first held-out row
        plant: newest model
        verdict: open-loop verdict of `plant`
    Returns:
        the verdict, changed if the closed-loop result contradicts it
    """
    if twin.models.verified_models and window.t[-1] - twin.models.scored.last < SELECTION_PERIOD_S:
        return verdict
    twin.models.scored.restart(float(window.t[-1]))
    start = max(n_train, len(window) - 1 - int(_HINDCAST_S / window.dt))
    initial = synchronise_controller(twin.situation(window.part(0, start + 1))) if not twin.no_route_reason() else None
    for model in twin.models.verified_models:
        model.update_error(hindcast_error(initial, window, start, model.plant))
    if verdict.outcome is Outcome.VERIFIED:
        verdict = _add_verified(twin, window, plant, verdict, hindcast_error(initial, window, start, plant))
    best = twin.models.select(_MAX_MODELS)
    if best is None:
        return verdict
    if verdict.outcome is Outcome.VERIFIED and best.plant is not plant:
        sentence = f"{verdict.sentence}; but an earlier model has a lower closed-loop error and stays active"
        return msgspec.structs.replace(verdict, outcome=Outcome.WORSE_THAN_LAST, sentence=sentence)
    return verdict


def _add_verified(twin: Twin, window: Window, plant: Plant, verdict: Verdict, error: float) -> Verdict:
    """Add a verified model, unless its closed-loop run on the route diverges."""
    if np.isinf(error):
        sentence = f"{verdict.sentence}; but the closed-loop run leaves the flight envelope; identification is repeated"
        return msgspec.structs.replace(verdict, outcome=Outcome.DIVERGED, sentence=sentence)
    twin.models.add(VerifiedModel(plant, verdict, float(window.t[-1]), _NEW_MODEL_FACTOR * error))
    return verdict


def hindcast_error(initial: InitialCondition | Rollout | None, window: Window, start: int, plant: Plant) -> float:
    """Return the mean closed-loop position error from row `start` to the end [m]; inf: diverged, nan: no route."""
    if not isinstance(initial, InitialCondition):
        return np.nan
    ahead = np.arange(0.0, int((len(window) - 1 - start) * window.dt) + 1.0)
    rollout = fly_from(initial, plant, ahead)
    if rollout.path is None:
        return np.inf
    rows = start + np.rint(ahead / window.dt).astype(int)
    return float(np.linalg.norm(rollout.path - window.p[rows], axis=1).mean())
