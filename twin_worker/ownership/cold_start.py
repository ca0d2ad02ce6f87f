"""A cold takeover: a twin that was never handed over begins with the last minutes and the last published model."""

import msgspec
import numpy as np

from fleet.contract import Array, Model, Outcome, Prediction, State
from fleet.physics.wrench import N_PAR, NAMES
from twin_worker.identification.fixed_wing.derivatives_model import Coupled
from twin_worker.identification.fixed_wing.derivatives_prior import prior
from twin_worker.twin.state.state import Believed, Twin
from twin_worker.twin.steps.extrapolate import LATEST_S

_TRIM = np.array([0.0, 0.0, 0.0, 0.5])  # inputs that nothing is known of


def revive(twin: Twin, model: Model) -> bool:
    """Let a fresh twin believe a model that another worker published; tell whether it can.

    The model comes without the hybrid and without what held its parameters: its whole covariance counts as told by the
    data of its own stretch, so that no datum is counted twice when that stretch is identified again.
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
    """Let the first work of its own wait for a share of its period, so that many taken over at once take turns.

    Args:
        twin: that has heard what was said before
        share: of a period, 0..1
        fly: it has a prediction to renew meanwhile; otherwise it flies ahead at once
        learn: it has a model meanwhile; otherwise it learns at once
    """
    newest, pace = twin.history.newest, twin.pace
    twin.predict_t = newest - (1.0 - share) * pace.predict if fly else -np.inf
    twin.identify_t = newest - (1.0 - share) * pace.identify if learn else -np.inf


def go_on(twin: Twin, made: Prediction) -> bool:
    """Let a fresh twin renew the last prediction another worker published, until it has flown one of its own.

    It keeps the origin of the local frame, too. Its path may have been flown up to one period before: the tube is as
    wide as it would be so much later, where that is wider.
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
        sentence=f"{made.sentence}; the last of another worker, renewed",
    )
    twin.origin, twin.prediction, twin.base, twin.predict_t = made.ned_origin(), made, made, made.t
    return True


def _coupled(twin: Twin, model: Model) -> Coupled | None:
    """Return the coupled model of a message; None where it has none, or one that cannot be."""
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
