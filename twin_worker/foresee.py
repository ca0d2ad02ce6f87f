"""One prediction: the route flown by the twin where earned, else a turn-rate guess; tube and horizon around it."""

import msgspec
import numpy as np

from fleet.autopilots import arduplane
from fleet.contract import Array, Message, Prediction, State
from fleet.window import Window
from twin_worker.horizon import AHEAD, QUANTILE, Made
from twin_worker.imm import STEP, imm
from twin_worker.memory import Twin
from twin_worker.predict import fly_ahead

_LOOK_BACK_S = 62.0  # telemetry a prediction starts from [s]
_COAST_S = 120.0  # the twin flies on alone for as long; then its last prediction ages [s]


def foresee(twin: Twin, now: float) -> list[Message]:
    """Predict from the newest telemetry, as of data time `now`; nothing while there is too little."""
    assert twin.origin is not None
    coast = max(now - twin.history.newest, 0.0) if twin.lost else 0.0
    window = twin.window(_LOOK_BACK_S)
    if window is None or not window.ok[-1] or coast > _COAST_S:
        return []
    t0 = float(window.t[-1])
    ahead = AHEAD + round(coast)
    path, method, seq, sentence = _route_path(twin, window, ahead)
    if path is None:
        path, method = _imm_path(window, ahead), "imm"
    if path is None or not np.isfinite(path).all():
        return []
    twin.state = _state(twin, method)
    prediction = _trusted(twin, path, ahead, t0, method)
    said = " ".join(part for part in (f"link lost {coast:.0f} s ago" if twin.lost else "", sentence) if part)
    law = arduplane.LAW if method == "paper" else "none: turn rate only"
    t = t0 + float(ahead[0])
    twin.prediction = msgspec.structs.replace(prediction, t=t, seq=seq, sentence=said, coast_s=coast, law=law)
    if not twin.lost:
        speed = float(np.hypot(*window.v[-1, :2]))
        twin.record.keep(Made(t0, method, path, twin.prediction.tube.numpy().astype(float), speed))
    return [twin.prediction]


def _route_path(twin: Twin, window: Window, ahead: np.ndarray) -> tuple[np.ndarray | None, str, int, str]:
    """Fly the route where mode, mission and a verified model allow; else say why not."""
    if twin.axes is None:
        return None, "", -1, twin.verdict.sentence
    if why := twin.why_no_route():
        return None, "", -1, why
    flown = fly_ahead(twin.situation(window), twin.axes, ahead)
    return flown.path, "paper", flown.seq, " ".join(filter(None, (_strange_law(twin), flown.sentence)))


def _strange_law(twin: Twin) -> str:
    """Say where the controller twin is not the autopilot's own."""
    autopilot = twin.status.autopilot if twin.status else "unknown"
    return "" if autopilot == "ardupilot" else f"autopilot {autopilot} is flown by ArduPlane's law, not its own"


def _imm_path(window: Window, ahead: np.ndarray) -> np.ndarray | None:
    every = int(STEP / window.dt)
    rows = slice((len(window) - 1) % every, None, every)
    ok = window.ok[rows]
    start = int(np.flatnonzero(~ok)[-1]) + 1 if not ok.all() else 0
    p, v = window.p[rows][start:][-24:], window.v[rows][start:][-24:]
    return imm(p, v, ahead) if len(p) >= 4 else None


def _state(twin: Twin, method: str) -> State:
    if twin.lost:
        return State.LINK_LOST
    if method == "paper":
        return State.PREDICTING
    return State.IDENTIFYING if twin.axes is None else State.VERIFIED


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
