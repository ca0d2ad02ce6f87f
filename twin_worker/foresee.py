"""One prediction: the route flown by the best twin the aircraft has, else a turn-rate guess; tube and horizon."""

from dataclasses import replace

import msgspec
import numpy as np

from fleet.contract import Array, Message, Prediction, State
from twin_worker.fly_route import fly_route
from twin_worker.horizon import AHEAD, QUANTILE, Made
from twin_worker.imm import STEP, imm
from twin_worker.kinds import Flight, fly_kind, hangs, nothing, seen
from twin_worker.memory import Twin
from twin_worker.track import STEP as TRACK_STEP
from twin_worker.track import Track

_LOOK_BACK_S = 62.0  # telemetry a prediction starts from [s]
_COAST_S = 120.0  # the twin flies on alone for as long; then its last prediction ages [s]
_STALE_S = 3.0  # positions older than other telemetry by more say nothing of now [s]
_IMM_LAW = "none: turn rate only"


def foresee(twin: Twin, now: float) -> list[Message]:
    """Predict from the newest telemetry, as of data time `now`; nothing while there is too little."""
    assert twin.origin is not None
    coast = max(now - twin.history.newest, 0.0) if twin.lost else 0.0
    ahead = AHEAD + round(coast)
    flown = seen(twin, _LOOK_BACK_S)
    if coast > _COAST_S or flown is None or not flown.ok[-1] or twin.history.newest - flown.t[-1] > _STALE_S:
        return []
    made, t0 = _best(twin, flown, ahead)
    if made.path is None or not np.isfinite(made.path).all():
        return []
    prediction = _trusted(twin, made.path, ahead, t0, made.method)
    said = " ".join(part for part in (f"link lost {coast:.0f} s ago" if twin.lost else "", made.sentence) if part)
    t = t0 + float(ahead[0])
    twin.prediction = msgspec.structs.replace(prediction, t=t, seq=made.seq, sentence=said, coast_s=coast, law=made.law)
    if not twin.lost:
        speed = float(np.linalg.norm(flown.v[-1]))
        twin.record.keep(Made(t0, made.method, made.path, twin.prediction.tube.numpy().astype(float), speed))
    return [twin.prediction]


def _best(twin: Twin, flown: Track, ahead: np.ndarray) -> tuple[Flight, float]:
    """Fly the identified model, else the law of its kind, else turn on; give the flight and when it starts."""
    window = twin.window(_LOOK_BACK_S)
    whole = window is not None and bool(window.ok[-1])
    why = twin.verdict.sentence
    if (twin.plant is not None or twin.hybrid is not None) and not hangs(twin):
        first = nothing(twin.why_no_route() or "telemetry is broken: the model has nothing to start from")
        if window is not None and whole and not twin.why_no_route():
            first = fly_route(twin, window, ahead)
        if _good(first):
            twin.state = _state(twin, State.PREDICTING)
            sentence = " ".join(filter(None, (_strange_law(twin), first.sentence)))
            return replace(first, sentence=sentence), float(window.t[-1])  # type: ignore[union-attr]
        why = first.sentence
    second = fly_kind(twin, flown, ahead)
    if _good(second):
        twin.state = _state(twin, State.PREDICTING)
        said = second.sentence if hangs(twin) else f"{second.sentence}; {why}"
        return replace(second, sentence=said), float(flown.t[-1])
    twin.state = _state(twin, State.VERIFIED if twin.plant else State.IDENTIFYING if whole else State.WAITING)
    parts = dict.fromkeys(part for part in (why, second.sentence, flown.sentence, "turn rate only") if part)
    path = _imm_path(flown, ahead)
    return Flight(path, "imm", _IMM_LAW, second.seq if path is None else -1, "; ".join(parts)), float(flown.t[-1])


def _good(flight: Flight) -> bool:
    return flight.path is not None and bool(np.isfinite(flight.path).all())


def _strange_law(twin: Twin) -> str:
    """Say where the controller twin is not the autopilot's own."""
    autopilot = twin.status.autopilot if twin.status else "unknown"
    return "" if autopilot == "ardupilot" else f"autopilot {autopilot} is flown by ArduPlane's law, not its own"


def _imm_path(flown: Track, ahead: np.ndarray) -> np.ndarray | None:
    every = round(STEP / TRACK_STEP)
    whole = flown.whole()
    rows = slice((len(whole) - 1) % every, None, every)
    p, v = whole.p[rows][-24:], whole.v[rows][-24:]
    return imm(p, v, ahead) if len(p) >= 4 else None


def _state(twin: Twin, otherwise: State) -> State:
    return State.LINK_LOST if twin.lost else otherwise


def _trusted(twin: Twin, path: np.ndarray, ahead: np.ndarray, t: float, method: str) -> Prediction:
    """Wrap the path in its tube and say up to when the 90 % error stays below 10 % of the path."""
    tube = twin.record.tube(method, np.arange(0.0, ahead[-1] + 1.0))[-len(ahead) :]
    horizon, open_end = twin.record.horizon(method)
    held, n = twin.record.held
    assert twin.origin is not None
    return Prediction(
        uav=twin.uav,
        t=t,
        state=twin.state,
        method=method,
        origin=(twin.origin.lat_e7, twin.origin.lon_e7, twin.origin.alt_mm),
        ahead=Array.of(AHEAD),
        path=Array.of(path),
        tube=Array.of(tube),
        quantile=QUANTILE,
        horizon_s=max(horizon - float(ahead[0]), 0.0),
        horizon_open=bool(open_end and not ahead[0]),
        held=held,
        held_n=n,
    )
