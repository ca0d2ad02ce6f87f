"""One hop of learning: window, two-step identification, verification on data held out, the published model."""

import msgspec
import numpy as np

from fleet.contract import Message, Model, Outcome, State, Verdict
from fleet.window import Window
from twin_worker.identify import AXES, Axis, identify_axis
from twin_worker.kinds import NO_WINGS, QUADPLANE, compare_with_flight
from twin_worker.lacking import lacking
from twin_worker.lift import SETTLE_S, lifted
from twin_worker.memory import Believed, Twin
from twin_worker.predict import fly_ahead
from twin_worker.preprocess import DT
from twin_worker.verify import verify

LEAST_S = 30.0  # shortest stretch worth identifying [s]
WINDOW_S = 140.0  # longest stretch used [s]
SLOW = 6.0  # air-relative forward speed below which nothing flies on its wings [m/s]
_FREE_RUN_S = (2.0, 4.0, 2.0, 8.0)  # free-run length of the n-th try [s]
_KEEP = 4  # verified models kept to choose from
_NEW = 1.2  # a new model's only flight so far counts as a miss this much larger [-]
_SHARE = (1.0, 1.0, 0.6, 1.0)  # share of the window the n-th try uses


def learn(twin: Twin) -> list[Message]:
    """Identify and verify once; give the model with its verdict, or nothing while data are starved."""
    compare_with_flight(twin)
    window = _on_wings(twin, twin.window(WINDOW_S))
    why_not = _why_not(twin, window)
    if window is None or why_not is not None:
        if twin.axes is None and why_not is not None:
            twin.verdict, twin.state = why_not, State.WAITING
        return []
    twin.state = State.IDENTIFYING if twin.axes is None else twin.state
    held_n = int(np.clip(0.3 * len(window), 8.2 / DT, 20.0 / DT))
    try:
        axes = _identify(twin, window.part(0, len(window) - held_n))
    except (ValueError, np.linalg.LinAlgError) as error:
        twin.verdict = Verdict(outcome=Outcome.STARVED, sentence=f"{twin.name}: {error}", tries=twin.tries)
        return []
    verdict = verify(axes, window.part(len(window) - held_n, len(window)), twin.omega)
    verdict = msgspec.structs.replace(verdict, sentence=f"{twin.name}: {verdict.sentence}", tries=twin.tries)
    twin.verdict = _choose(twin, window, held_n, axes, verdict)
    if twin.verdict.outcome in (Outcome.VERIFIED, Outcome.WORSE_THAN_LAST):
        twin.tries = 0
    twin.model = _model(twin, twin.verdict, window)
    return [twin.model]


def _why_not(twin: Twin, window: Window | None) -> Verdict | None:
    """Say why there is nothing to identify yet; None where there is."""
    if twin.vehicle in NO_WINGS:
        sentence = f"{twin.name}: a {twin.vehicle} has no wings to identify; {twin.rotor}"
        return Verdict(outcome=Outcome.NOT_IDENTIFIABLE, sentence=sentence)
    have = 0.0 if window is None else float(window.ok.sum() * DT)
    if window is not None and have >= LEAST_S:
        return None
    where = " on its wings" if twin.vehicle == QUADPLANE else ""
    missing = lacking(twin.history) or "wait"
    sentence = f"{twin.name}: {have:.0f} s of whole data{where}, {LEAST_S:.0f} s are needed; {missing}"
    return Verdict(outcome=Outcome.STARVED, sentence=sentence)


def _identify(twin: Twin, known: Window) -> tuple[Axis, Axis]:
    """Identify both axes; every further try uses another free-run length or share of the window."""
    attempt = twin.tries % len(_SHARE)
    twin.tries += 1
    known = known.part(int(len(known) * (1 - _SHARE[attempt])), len(known))
    before = twin.axes or (None, None)
    lon, lat = (
        identify_axis(axis, known, _FREE_RUN_S[attempt], last)[1] for axis, last in zip(AXES, before, strict=True)
    )
    return lon, lat


def _choose(twin: Twin, window: Window, held_n: int, axes: tuple[Axis, Axis], verdict: Verdict) -> Verdict:
    """Fly every verified model in closed loop over the held-out data; the one that strays least is in force."""
    for known in twin.pool:
        known.flown(_hindcast(twin, window, held_n, known.axes))
    if verdict.outcome is Outcome.VERIFIED:
        miss = _hindcast(twin, window, held_n, axes)
        if np.isinf(miss):
            sentence = f"{verdict.sentence}; but on the route the twin leaves its envelope; trying again"
            verdict = msgspec.structs.replace(verdict, outcome=Outcome.DIVERGED, sentence=sentence)
        else:
            twin.pool.append(Believed(axes, verdict, float(window.t[-1]), _NEW * miss))
    twin.pool = sorted((known for known in twin.pool if not np.isinf(known.miss)), key=Believed.rank)[:_KEEP]
    if not twin.pool:
        return verdict
    best = twin.pool[0]
    twin.axes, twin.in_force = best.axes, best.verdict
    if verdict.outcome is Outcome.VERIFIED and best.axes is not axes:
        sentence = f"{verdict.sentence}; but an earlier model strays less on the route and stays in force"
        return msgspec.structs.replace(verdict, outcome=Outcome.WORSE_THAN_LAST, sentence=sentence)
    return verdict


def _hindcast(twin: Twin, window: Window, held_n: int, axes: tuple[Axis, Axis]) -> float:
    """Give the mean miss of a flight from the start of the held-out data [m]; inf: it diverges, nan: no route."""
    if twin.why_no_route():
        return np.nan
    start = len(window) - held_n
    ahead = np.arange(0.0, int(held_n * DT))
    flown = fly_ahead(twin.situation(window.part(0, start + 1)), axes, ahead)
    if flown.path is None:
        return np.inf if flown.diverged else np.nan
    rows = start + np.rint(ahead / DT).astype(int)
    return float(np.linalg.norm(flown.path - window.p[rows], axis=1).mean())


def _on_wings(twin: Twin, window: Window | None) -> Window | None:
    """Keep what was flown on wings: from the last row that was too slow for them or hung on rotors."""
    if window is None:
        return None
    slow = window.ok & (window.columns(("u",))[:, 0] < SLOW)
    start = _after(slow, 0)
    if twin.vehicle == QUADPLANE:
        hung = lifted(window.t, twin.history, twin.params.values if twin.params else {}, twin.modes)
        start = max(start, _after(slow | hung, int(SETTLE_S / DT)))
    return window.part(start, len(window)) if len(window) - start > 1 else None


def _after(those: np.ndarray, more: int) -> int:
    """Give the row after the last of those, and so many more; the first where there are none."""
    found = np.flatnonzero(those)
    return int(found[-1]) + 1 + more if len(found) else 0


def _model(twin: Twin, verdict: Verdict, window: Window) -> Model:
    """Publish the newest verdict with the model in force: a failed identification never shows its matrices."""
    lon, lat = twin.axes or (None, None)
    return Model(
        uav=twin.uav,
        t=float(window.t[-1]),
        method="paper",
        verdict=verdict,
        in_force=twin.in_force,
        longitudinal=lon.linear() if lon else None,
        lateral=lat.linear() if lat else None,
        window_t0=float(window.t[0]),
        window_s=window.seconds,
        interpolated=float(window.filled.mean()),
        wind_n=float(twin.wind.wind[0]),
        wind_e=float(twin.wind.wind[1]),
    )
