"""Predict the route with every available method, and select the method used."""

import numpy as np

from fleet.window import Window
from twin_worker.confidence.calibration_table import law_of_growth
from twin_worker.confidence.tube_and_horizon import AHEAD
from twin_worker.identification.fixed_wing.plant import DYNAMICS, method
from twin_worker.numerics.interpolation import straight
from twin_worker.prediction.closed_loop import Flown, Situation, Start, fly_from, set_out
from twin_worker.prediction.fixed_wing import ensemble
from twin_worker.prediction.fixed_wing.point_mass_rollout import fly_hybrid
from twin_worker.twin.state.schedule import SOON, Work
from twin_worker.twin.state.state import Twin
from twin_worker.twin.state.vehicle_class import Flight, nothing

HYBRID, BOTH = "hybrid", "both"
_NEAR_S = 60.0  # look-ahead of the identified dynamics; beyond it the point-mass path continues [s]


def fly_route(twin: Twin, window: Window, ahead: np.ndarray) -> Flight:
    """Predict the route, or return the reason why this is not possible.

    Args:
        twin: source of the models; its method selection and ensemble are updated
        window: newest telemetry
        ahead: look-ahead times from the end of `window`, rising, (k,) [s]
    """
    now = twin.situation(window)
    start = set_out(now)
    if isinstance(start, Flown):
        return nothing(start.sentence, start.seq)
    t = float(window.t[-1])
    due = twin.contest.due(t)
    flown, why = paths(twin, (now, start), ahead, due)
    if not flown:
        return nothing(why or "no verified model yet", start.seq)
    if due and len(flown) > 1 and not twin.lost:
        twin.contest.keep(t, float(np.linalg.norm(start.good.v[-1])), ahead, flown)
    _spread(twin, (now, start))
    chosen = twin.contest.best(tuple(flown))
    sentence = " ".join(filter(None, (twin.contest.said(chosen), start.sentence)))
    return Flight(flown[chosen], chosen, start.law.law, start.seq, sentence, start.law)


def paths(
    twin: Twin, begin: tuple[Situation, Start], ahead: np.ndarray, due: bool
) -> tuple[dict[str, np.ndarray], str]:
    """Return the path of each method, NED (k, 3) [m], and the reason if another failed; `due`: run all methods."""
    found: dict[str, np.ndarray] = {}
    why = ""
    if twin.hybrid is not None and twin.method in (HYBRID, "auto"):
        flown = fly_hybrid(*begin, twin.hybrid, ahead)
        found, why = _kept(found, HYBRID, flown), flown.sentence
    wanted = not found or due or twin.contest.best((BOTH, HYBRID, DYNAMICS)) != HYBRID
    if twin.plant is not None and twin.method != HYBRID and wanted:
        near = ahead[: np.searchsorted(ahead, max(_NEAR_S, ahead[0]), side="right")] if found else ahead
        flown = fly_from(begin[1], twin.plant, near)
        why = why if found else flown.sentence
        if flown.path is not None:
            path = _lengthened(flown.path, found[HYBRID]) if found else flown.path
            found = {**found, method(twin.plant): path}
    if len(found) > 1:
        found[BOTH] = 0.5 * (found[HYBRID] + found[method(twin.plant)])  # type: ignore[arg-type]
    return found, why


def _kept(paths: dict[str, np.ndarray], name: str, flown: Flown) -> dict[str, np.ndarray]:
    return paths if flown.path is None else {**paths, name: flown.path}


def _lengthened(path: np.ndarray, further: np.ndarray) -> np.ndarray:
    """Continue `path`, (m, 3), with the increments of `continuation`, (k, 3)."""
    end = len(path)
    return np.vstack([path, further[end:] + (path[-1] - further[end - 1])])


def _spread(twin: Twin, begin: tuple[Situation, Start]) -> None:
    """Run the ensemble if it is due."""
    t = float(begin[1].good.t[-1])
    known = twin.spread_t <= t < twin.spread_t + SOON * twin.pace.ensemble and twin.instead is None
    twin.put_off = None
    if twin.hybrid is None or known:
        return
    if not twin.may(Work.ENSEMBLE):
        twin.put_off = t
        return
    _fly_ensemble(twin, begin, t)


def fly_put_off(twin: Twin, seconds: float) -> None:
    """Run the deferred ensemble from the current state; the schedule of the next one is unchanged.

    The ensemble waited for other work; its spread applies from the next prediction on.
    """
    due, twin.put_off = twin.put_off, None
    window = twin.window(seconds)
    if due is None or twin.hybrid is None or window is None or not window.ok[-1] or twin.why_no_route():
        return
    now = twin.situation(window)
    start = set_out(now)
    if not isinstance(start, Flown):
        _fly_ensemble(twin, (now, start), due)


def _fly_ensemble(twin: Twin, begin: tuple[Situation, Start], t: float) -> None:
    """Run the ensemble of time `t`; beyond its span the spread continues by the growth law."""
    assert twin.hybrid is not None
    ahead = AHEAD[: AHEAD.searchsorted(twin.pace.span, side="right")]
    rng = np.random.default_rng((twin.uav, int(t)))
    found = ensemble.spread(*begin, twin.hybrid, ahead, rng, members=twin.pace.members)
    if found is not None and len(ahead) < len(AHEAD):
        law = law_of_growth(HYBRID, AHEAD[len(ahead) - 1 :])
        found = np.vstack([found, found[-1] * law[1:] / law[0]])
    twin.spread, twin.spread_t = found, t


def in_force(twin: Twin, method: str, ahead: np.ndarray) -> np.ndarray | None:
    """Return the spread of the newest ensemble at some look-aheads, (k, 3) [m]; None if it does not apply to `method`.

    Args:
        twin: source of the ensemble
        method: of the prediction
        ahead: rising; beyond the ensemble's end the spread stays constant (k,) [s]
    """
    if twin.spread is None or method not in (HYBRID, BOTH, DYNAMICS):
        return None
    return straight(ahead, AHEAD, twin.spread)
