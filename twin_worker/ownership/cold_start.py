"""Start a twin without a snapshot: from the last minutes of telemetry and the last published model."""

import msgspec
import numpy as np

from fleet.contract import Array, Model, Outcome, Prediction, State
from fleet.physics.wrench import N_PAR, NAMES
from twin_worker.identification.fixed_wing.derivatives_model import Coupled
from twin_worker.identification.fixed_wing.derivatives_prior import prior
from twin_worker.twin.state.state import Believed, Twin
from twin_worker.twin.steps.extrapolate import LATEST_S

_TRIM = np.array([0.0, 0.0, 0.0, 0.5])  # trim inputs, as none are published


def revive(twin: Twin, model: Model) -> bool:
    """Restore a published model of another worker in a new twin; return whether this was possible.

    The message contains neither the point-mass model nor the prior. The complete covariance counts as information from
    the model's own window, so that no data count twice when that window is identified again.
    """
    plant = _coupled(twin, model)
    if plant is None or model.in_force is None or model.in_force.outcome is not Outcome.VERIFIED:
        return False
    said = f"{model.in_force.sentence}; taken over from another worker"
    verdict = msgspec.structs.replace(model.in_force, sentence=said)
    twin.plant = twin.last = plant
    twin.verdict = twin.in_force = verdict
    twin.pool = [Believed(plant, verdict, model.t, float("nan"))]
    twin.state, twin.model = State.VERIFIED, model
    twin.wind.blow(model.t, np.array([model.wind_n, model.wind_e, 0.0]))
    return True


def wait(twin: Twin, share: float, *, fly: bool, learn: bool) -> None:
    """Delay the first work of a twin by a share of its period, so that many takeovers are spread over time.

    Args:
        twin: twin with past messages ingested
        phase: share of a period, 0..1
        has_prediction: a prediction can be propagated meanwhile; otherwise the first rollout runs at once
        has_model: a model exists; otherwise the first identification runs at once
    """
    newest, pace = twin.history.newest, twin.pace
    twin.predict_t = newest - (1.0 - share) * pace.predict if fly else -np.inf
    twin.identify_t = newest - (1.0 - share) * pace.identify if learn else -np.inf


def go_on(twin: Twin, made: Prediction) -> bool:
    """Propagate the last published prediction of another worker until the twin has its own; return whether it is valid.

    The twin adopts the origin of the local frame. The path can be up to one period old; the tube is widened.
    """
    try:
        ahead, tube = made.ahead.numpy(), made.tube.numpy()
        shapes = [(each.dtype, each.numpy().shape) for each in (made.ahead, made.path, made.tube)]
    except (ValueError, TypeError):
        return False
    n = len(ahead) if ahead.ndim else 0
    if n < 2 or shapes != [("<f4", (n,)), *[("<f4", (n, 3))] * 2]:
        return False
    age = min(twin.pace.predict, LATEST_S)
    later = np.column_stack([np.interp(ahead + age, ahead, half) for half in tube.T])
    made = msgspec.structs.replace(
        made,
        tube=Array.of(np.maximum(tube, later)),
        horizon_s=max(made.horizon_s - age, 0.0),
        sentence=f"{made.sentence}; continued from another worker",
    )
    twin.origin, twin.prediction, twin.base, twin.predict_t = made.ned_origin(), made, made, made.t
    return True


def _coupled(twin: Twin, model: Model) -> Coupled | None:
    """Return the derivatives model of a message; None if it has none or an invalid one."""
    told = model.derivatives
    if told is None or told.names != NAMES or told.prior != twin.airframe.name:
        return None
    try:
        par, covariance = told.value.numpy().astype(float), told.covariance.numpy().astype(float)
        precision = np.linalg.inv(covariance)
    except (ValueError, np.linalg.LinAlgError):
        return None
    at = np.array([told.U0, told.W0])
    whole = par.shape == (N_PAR,) and precision.shape == (N_PAR, N_PAR) and told.U0 > 0
    if not whole or not all(np.isfinite(each).all() for each in (par, precision, at)):
        return None
    mean, sigma = prior(twin.airframe, at, _TRIM, np.array([model.wind_n, model.wind_e]))
    firm = np.diag(sigma**-2.0)
    begin = told.window_t0
    return Coupled(
        par, at, precision, mean, firm, np.ones(9), (mean, firm), begin, begin + max(told.window_s, 1.0), steps=0
    )
