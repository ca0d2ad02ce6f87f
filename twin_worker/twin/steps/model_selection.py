"""Which verified model is in force: the one that strays least when it flies what was held out in closed loop."""

import msgspec
import numpy as np

from fleet.contract import Outcome, Verdict
from fleet.window import Window
from twin_worker.identification.fixed_wing.plant import Plant
from twin_worker.prediction.closed_loop import Flown, Start, fly_from, set_out
from twin_worker.twin.state.state import Believed, Twin

FLY_S = 6.0  # between flights of the same models [s]
_FLIGHT_S = 20.0  # of the newest data flown [s]
_KEEP = 3  # verified models kept to choose from
_NEW = 1.2  # a new model's only flight so far counts as a miss this much larger [-]


def choose(twin: Twin, window: Window, known: int, plant: Plant, verdict: Verdict) -> Verdict:
    """Fly every verified model in closed loop over the newest data; the one that strays least is in force.

    Args:
        twin: whose pool of models is renewed
        window: flight; rows from `known` on `plant` has not seen
        known: first of them
        plant: the newest model
        verdict: on it, open loop
    Returns:
        the verdict, changed where the closed loop says otherwise
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
        sentence = f"{verdict.sentence}; but an earlier model strays less on the route and stays in force"
        return msgspec.structs.replace(verdict, outcome=Outcome.WORSE_THAN_LAST, sentence=sentence)
    return verdict


def _join(twin: Twin, window: Window, plant: Plant, verdict: Verdict, miss: float) -> Verdict:
    """Take a verified model into the pool, unless it cannot fly the route."""
    if np.isinf(miss):
        sentence = f"{verdict.sentence}; but on the route the twin leaves its envelope; trying again"
        return msgspec.structs.replace(verdict, outcome=Outcome.DIVERGED, sentence=sentence)
    twin.pool.append(Believed(plant, verdict, float(window.t[-1]), _NEW * miss))
    return verdict


def hindcast(begin: Start | Flown | None, window: Window, start: int, plant: Plant) -> float:
    """Return the mean miss of a flight from row `start` to the end [m]; inf: it diverges, nan: no route to fly."""
    if not isinstance(begin, Start):
        return np.nan
    ahead = np.arange(0.0, int((len(window) - 1 - start) * window.dt) + 1.0)
    flown = fly_from(begin, plant, ahead)
    if flown.path is None:
        return np.inf
    rows = start + np.rint(ahead / window.dt).astype(int)
    return float(np.linalg.norm(flown.path - window.p[rows], axis=1).mean())
