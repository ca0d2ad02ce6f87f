"""Select the active model: the verified model with the lowest closed-loop error on held-out data."""

import msgspec
import numpy as np

from fleet.contract import Outcome, Verdict
from fleet.window import Window
from twin_worker.identification.fixed_wing.plant import Plant
from twin_worker.prediction.closed_loop import Flown, Start, fly_from, set_out
from twin_worker.twin.state.state import Believed, Twin

FLY_S = 6.0  # between closed-loop runs of the same models [s]
_FLIGHT_S = 20.0  # length of the closed-loop run over the newest data [s]
_KEEP = 3  # number of verified models kept
_NEW = 1.2  # factor on the error of a new model, which has only one run so far [-]


def choose(twin: Twin, window: Window, known: int, plant: Plant, verdict: Verdict) -> Verdict:
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
    if twin.pool and window.t[-1] - twin.flown_t < FLY_S:
        return verdict
    twin.flown_t = float(window.t[-1])
    start = max(known, len(window) - 1 - int(_FLIGHT_S / window.dt))
    begin = set_out(twin.situation(window.part(0, start + 1))) if not twin.why_no_route() else None
    for one in twin.pool:
        one.flown(hindcast(begin, window, start, one.plant))
    if verdict.outcome is Outcome.VERIFIED:
        verdict = _join(twin, window, plant, verdict, hindcast(begin, window, start, plant))
    twin.pool = sorted((one for one in twin.pool if not np.isinf(one.miss)), key=Believed.rank)[:_KEEP]
    if not twin.pool:
        return verdict
    best = twin.pool[0]
    twin.plant, twin.in_force = best.plant, best.verdict
    if verdict.outcome is Outcome.VERIFIED and best.plant is not plant:
        sentence = f"{verdict.sentence}; but an earlier model has a lower closed-loop error and stays active"
        return msgspec.structs.replace(verdict, outcome=Outcome.WORSE_THAN_LAST, sentence=sentence)
    return verdict


def _join(twin: Twin, window: Window, plant: Plant, verdict: Verdict, miss: float) -> Verdict:
    """Add a verified model, unless its closed-loop run on the route diverges."""
    if np.isinf(miss):
        sentence = f"{verdict.sentence}; but the closed-loop run leaves the flight envelope; identification is repeated"
        return msgspec.structs.replace(verdict, outcome=Outcome.DIVERGED, sentence=sentence)
    twin.pool.append(Believed(plant, verdict, float(window.t[-1]), _NEW * miss))
    return verdict


def hindcast(begin: Start | Flown | None, window: Window, start: int, plant: Plant) -> float:
    """Return the mean closed-loop position error from row `start` to the end [m]; inf: diverged, nan: no route."""
    if not isinstance(begin, Start):
        return np.nan
    ahead = np.arange(0.0, int((len(window) - 1 - start) * window.dt) + 1.0)
    flown = fly_from(begin, plant, ahead)
    if flown.path is None:
        return np.inf
    rows = start + np.rint(ahead / window.dt).astype(int)
    return float(np.linalg.norm(flown.path - window.p[rows], axis=1).mean())
