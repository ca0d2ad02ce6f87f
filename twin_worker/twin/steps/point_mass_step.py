"""Update the point-mass model of one aircraft: identify it, and activate it if its hold-out error is low."""

import numpy as np

from fleet.window import Window
from twin_worker.identification.fixed_wing.plant import PAPER
from twin_worker.identification.fixed_wing.point_mass_model import LEAST_S, SEEN_S, identify
from twin_worker.prediction.autopilot_identification import EVERY_S as LEARN_S
from twin_worker.prediction.autopilot_identification import learn_law
from twin_worker.prediction.closed_loop import Flown, set_out
from twin_worker.prediction.fixed_wing.point_mass_rollout import fly_hybrid
from twin_worker.twin.state.state import Twin

EVERY_S = 5.0  # between identifications [s]
_HELD_S = 20.0  # newest flight, held out [s]
_AFRESH_S = 60.0  # flight after a fault onset before the model adapted by a diagnosis is replaced [s]
_CHECK_S = 10.0  # between checks on held-out flight [s]
_MOST = 0.10  # maximum final error over path length for an active model [-]
_NEWS = 0.3  # weight of the newest check


def renew(twin: Twin) -> None:
    """Identify the point-mass model if it is due; `twin.hybrid` is None until its error is low enough."""
    newest = twin.history.newest
    if twin.why_no_route() or twin.hybrid_t <= newest < twin.hybrid_t + EVERY_S:
        return
    window = twin.window(SEEN_S + _HELD_S)
    if window is not None and not twin.learnt.t <= newest < twin.learnt.t + LEARN_S:
        learn_law(twin.learnt, twin.autopilot, twin.situation(window))
    good = window and _whole(window, twin.learn_from)
    least = LEAST_S + _HELD_S if twin.extended is None else _AFRESH_S
    if window is None or good is None or len(good) < least / window.dt + 1 or twin.method == PAPER:
        return
    twin.hybrid_t = newest
    if not twin.checked_t <= newest < twin.checked_t + _CHECK_S:
        twin.checked_t = newest
        strayed = _strays(twin, good)
        if np.isfinite(strayed):
            before = twin.strays if np.isfinite(twin.strays) else strayed
            twin.strays = before + _NEWS * (strayed - before)
    twin.near_hybrid = identify(good, twin.history, twin.wind.scale, twin.near_hybrid)
    twin.hybrid = twin.near_hybrid if twin.strays < _MOST else None


def _whole(window: Window, since: float) -> Window:
    """Return the last part of the window without gaps, from `since` on [s since 1970]."""
    bad = np.flatnonzero(~(window.ok & (window.t >= since)))
    return window.part(int(bad[-1]) + 1 if len(bad) else 0, len(window))


def _strays(twin: Twin, good: Window) -> float:
    """Return the final error of a rollout over held-out flight, divided by its path length [-]."""
    held = int(_HELD_S / good.dt)
    known = good.part(0, len(good) - held)
    now = twin.situation(known)
    start = set_out(now)
    if isinstance(start, Flown):
        return float("nan")
    found = identify(known, twin.history, twin.wind.scale, twin.near_hybrid)
    flown = fly_hybrid(now, start, found, np.array([0.0, _HELD_S]))
    if flown.path is None:
        return 1.0
    way = float(np.linalg.norm(np.diff(good.p[-held:], axis=0), axis=1).sum())
    return float(np.linalg.norm(flown.path[-1] - good.p[-1])) / max(way, 1.0)
