"""Identification step: window, identification, verification on held-out data, model selection, publication."""

import msgspec
import numpy as np

from fleet.contract import Message, Outcome, State, Verdict
from fleet.frames import G
from fleet.process.sanitise import below
from fleet.window import Window
from twin_worker.identification.fixed_wing import derivatives_model
from twin_worker.identification.fixed_wing.plant import PAPER, Plant
from twin_worker.identification.linear.linear_model import AXES, identify_axis
from twin_worker.telemetry.hover_detection import SETTLE_S, lifted
from twin_worker.telemetry.requirements import lacking
from twin_worker.telemetry.resample import DT
from twin_worker.twin.state.state import Twin
from twin_worker.twin.state.vehicle_class import NO_WINGS, QUADPLANE, WINGS, compare_with_flight
from twin_worker.twin.steps.model_message import model_message
from twin_worker.twin.steps.model_selection import choose
from twin_worker.twin.steps.point_mass_step import renew
from twin_worker.validation.held_out import Unseen
from twin_worker.validation.verify import told, verify

LEAST_S = 30.0  # shortest window for identification [s]
SLOW = 6.0  # forward airspeed below which no flight on wings is possible [m/s]
_LENGTH = 17.0  # window length in U0 / g: faster aircraft have slower modes [-]
_STRETCH_S = 35.0, 95.0  # limits of the window length [s]
_PAPER_S = 120.0  # window length of `--method paper` [s]
_HELD_S = 8.2, 20.0, 40.2  # hold-out length: minimum; maximum of `--method paper`; maximum [s]
_HELD_SHARE = 0.3, 0.5  # held-out share of the window: `--method paper`, others [-]
_FREE_RUN_S = (2.0, 4.0, 2.0, 8.0)  # free-run length of the n-th attempt of `--method paper` [s]
_SHARE = (1.0, 1.0, 0.6, 1.0)  # share of the window used by the n-th attempt [-]
_RUN_S, _RUN_EVERY_S = 20.0, 5.0  # free runs for the forecast shrinkage: length, period [s]
_AFRESH_S = 4.0  # between identifications without a warm start [s]
_TELL_S = 5.0  # between published models without a changed outcome [s]


def learn(twin: Twin) -> list[Message]:
    """Identify and verify once; return the model with its verdict if it is due, nothing if data are insufficient."""
    compare_with_flight(twin)
    if twin.vehicle in WINGS:
        renew(twin)
    window = _on_wings(twin, twin.window(_stretch_s(twin) + _held_most(twin)))
    why_not = _why_not(twin, window)
    if window is None or why_not is not None:
        if twin.plant is None and why_not is not None:
            twin.verdict, twin.state = why_not, State.WAITING
        return []
    twin.state = State.IDENTIFYING if twin.plant is None else twin.state
    known = len(window) - int(np.clip(_HELD_SHARE[twin.method != PAPER] * len(window), *_held_limits(twin)))
    try:
        plant = _identify(twin, window.part(0, known))
    except (ValueError, np.linalg.LinAlgError) as error:
        twin.verdict = Verdict(outcome=Outcome.STARVED, sentence=f"{twin.name}: {error}", tries=twin.tries)
        return []
    verdict = verify(plant, window, known, twin.omega, twin.plant if twin.method != PAPER else None)
    verdict = msgspec.structs.replace(verdict, sentence=f"{twin.name}: {verdict.sentence}", tries=twin.tries)
    verdict = choose(twin, window, known, plant, verdict)
    if verdict.outcome is Outcome.VERIFIED and isinstance(plant, derivatives_model.Coupled):
        twin.last = plant
    news = _changed(verdict, twin.verdict) or window.t[-1] - twin.told_t >= _TELL_S
    twin.verdict = verdict
    if verdict.outcome in (Outcome.VERIFIED, Outcome.WORSE_THAN_LAST, Outcome.NOT_IDENTIFIABLE):
        twin.tries = 0
    if not news:
        return []
    twin.told_t = float(window.t[-1])
    twin.verdict = told(verdict, plant, window, known)
    lesson = Unseen(plant, window, known).lesson(_RUN_S, _RUN_EVERY_S)
    if lesson is not None:
        twin.earned.learn(*lesson, window.dt)
    twin.model = model_message(twin, window)
    return [twin.model]


def _changed(now: Verdict, before: Verdict) -> bool:
    """Return whether the outcome changed; alternation between two valid outcomes does not count."""
    sound = (Outcome.VERIFIED, Outcome.WORSE_THAN_LAST)
    return now.outcome is not before.outcome and not (now.outcome in sound and before.outcome in sound)


def _stretch_s(twin: Twin) -> float:
    if twin.method == PAPER:
        return _PAPER_S
    speed = float(twin.near.at[0]) if twin.near else 0.0
    return float(np.clip(_LENGTH * speed / G, *_STRETCH_S))


def _held_most(twin: Twin) -> float:
    return _HELD_S[1 + (twin.method != PAPER)]


def _held_limits(twin: Twin) -> tuple[float, float]:
    return _HELD_S[0] / DT, _held_most(twin) / DT


def _why_not(twin: Twin, window: Window | None) -> Verdict | None:
    """Return a verdict with the reason if identification is not possible yet; None otherwise."""
    if twin.vehicle in NO_WINGS:
        sentence = f"{twin.name}: a {twin.vehicle} has no wings to identify; {twin.rotor}"
        return Verdict(outcome=Outcome.NOT_IDENTIFIABLE, sentence=sentence)
    have = 0.0 if window is None else float(window.ok.sum() * DT)
    if window is not None and have >= LEAST_S:
        return None
    where = " on its wings" if twin.vehicle == QUADPLANE else ""
    missing = lacking(twin.history) or "wait"
    sentence = f"{twin.name}: {below(have, LEAST_S)} s of complete data{where}, {LEAST_S:.0f} s are needed; {missing}"
    return Verdict(outcome=Outcome.STARVED, sentence=sentence)


def _identify(twin: Twin, known: Window) -> Plant:
    """Identify the aircraft; each further attempt uses another initial value or another share of the window."""
    attempt, now = twin.tries % len(_SHARE), float(known.t[-1])
    if twin.method != PAPER and twin.afresh_t <= now < twin.afresh_t + _AFRESH_S:
        attempt = 0  # a cold start on nearly the same window would return the same result
    else:
        twin.tries += 1
    known = known.part(int(len(known) * (1 - _SHARE[attempt])), len(known))
    if twin.method != PAPER:
        near = twin.near if attempt == 0 and twin.near and twin.near.t1 > known.t[0] else None
        twin.afresh_t = now if near is None else twin.afresh_t
        twin.near = derivatives_model.identify(known, twin.wind.wind, twin.airframe, twin.last, near)
        return twin.near
    before = twin.plant if isinstance(twin.plant, tuple) else (None, None)
    lon, lat = (
        identify_axis(axis, known, _FREE_RUN_S[attempt], last)[1] for axis, last in zip(AXES, before, strict=True)
    )
    return lon, lat


def _on_wings(twin: Twin, window: Window | None) -> Window | None:
    """Return the rows flown on wings: all after the last row that was too slow or hovering."""
    if window is None:
        return None
    slow = window.ok & (window.columns(("u",))[:, 0] < SLOW)
    start = max(_after(slow, 0), int(np.searchsorted(window.t, twin.learn_from)))
    if twin.vehicle == QUADPLANE:
        hung = lifted(window.t, twin.history, twin.params.values if twin.params else {}, twin.modes)
        start = max(start, _after(slow | hung, int(SETTLE_S / DT)))
    return window.part(start, len(window)) if len(window) - start > 1 else None


def _after(those: np.ndarray, more: int) -> int:
    """Return the index `margin` rows after the last true row of `mask`; 0 if there is none."""
    found = np.flatnonzero(those)
    return int(found[-1]) + 1 + more if len(found) else 0
