"""THE loop of one aircraft: `advance(twin, messages, now) -> results`. Data time only: no bus, no thread, no wall clock."""

from collections.abc import Iterable
from dataclasses import dataclass, field

import msgspec
import numpy as np

from fleet.airframe import ServoMap, servo_map
from fleet.autopilots import arduplane
from fleet.contract import (
    Alert,
    AlertKind,
    Array,
    FleetRow,
    Link,
    Message,
    Mission,
    Model,
    Outcome,
    Params,
    Prediction,
    Sample,
    State,
    Status,
    Verdict,
)
from fleet.frames import Origin, to_ned
from fleet.window import Window
from twin_worker.history import History
from twin_worker.horizon import AHEAD, LIMIT, QUANTILE, Made, Record, path_length
from twin_worker.identify import AXES, Axis, identify_axis
from twin_worker.imm import STEP, imm
from twin_worker.predict import Onboard, fly_ahead
from twin_worker.preprocess import DT, preprocess
from twin_worker.verify import OMEGA, verify
from twin_worker.wind import WindFilter

LEAST_S = 30.0  # shortest stretch worth identifying [s]
WINDOW_S = 140.0  # longest stretch used [s]
HOP_S = 4.0  # between identifications [s]
PREDICT_S = 1.0  # between predictions [s]
SLOW = 6.0  # air-relative forward speed below which nothing flies on its wings [m/s]
LOST_S = 3.0  # without a sample: link lost [s]
ROUTE_MODES = ("AUTO", "MISSION", "AUTO.MISSION")
_FREE_RUN_S = (4.0, 2.0, 4.0, 8.0)  # free-run length of the n-th try [s]
_SHARE = (1.0, 1.0, 0.6, 1.0)  # share of the window the n-th try uses


@dataclass
class Twin:
    """One aircraft's twin: what was heard of it, the model in force, and how past predictions fared."""

    uav: int
    omega: float = OMEGA
    history: History = field(default_factory=History)
    wind: WindFilter = field(default_factory=WindFilter)
    record: Record = field(default_factory=Record)
    origin: Origin | None = None
    status: Status | None = None
    mission: Mission | None = None
    params: Params | None = None
    servos: ServoMap = field(default_factory=lambda: servo_map({}))
    axes: tuple[Axis, Axis] | None = None
    verdict: Verdict = Verdict(outcome=Outcome.STARVED, sentence="no samples yet")
    prediction: Prediction | None = None
    state: State = State.WAITING
    tries: int = 0
    since: float = -np.inf  # last change of mode, mission or parameters
    first_t: float = np.nan
    wind_t: float = -np.inf
    identify_t: float = -np.inf
    predict_t: float = -np.inf
    score_t: float = -np.inf
    lost: bool = False
    bad: int = 0

    @property
    def name(self) -> str:
        """Give the name sentences use, e.g. uav-7."""
        return f"uav-{self.uav}"


def advance(twin: Twin, messages: Iterable[Message], now: float) -> list[Message]:
    """Take what was heard, and identify, verify, predict and score whatever is due at data time `now`.

    Args:
        twin: the aircraft's twin, changed in place
        messages: Sample, Status, Mission, Params in the order they were heard
        now: data time [s since 1970]
    Returns:
        Model, Prediction and Alert messages to publish
    """
    for message in messages:
        _hear(twin, message)
    if twin.origin is None or not np.isfinite(twin.history.newest):
        return []
    results = _watch_link(twin, now)
    _blow(twin)
    if now - twin.score_t >= 1.0:
        twin.score_t = now
        _score(twin)
    if not twin.lost and now - twin.identify_t >= HOP_S:
        twin.identify_t = now
        results += _identify(twin)
    if now - twin.predict_t >= PREDICT_S:
        twin.predict_t = now
        results += _predict(twin, now)
    return results


# -- hearing -----------------------------------------------------------------------------------------------------------


def _hear(twin: Twin, message: Message) -> None:
    if isinstance(message, Sample):
        twin.bad += twin.history.add(message)
        if twin.origin is None and message.position is not None:
            lat, lon, alt = (int(value) for value in message.position.x.numpy()[0])
            twin.origin, twin.first_t = Origin(lat, lon, alt), message.t
    elif isinstance(message, Status):
        _hear_status(twin, message)
    elif isinstance(message, Mission):
        if twin.mission is None or twin.mission.items != message.items:
            _event(twin, message.t)
        twin.mission = message
    elif isinstance(message, Params):
        if twin.params is None or _control_changed(twin.params, message):
            _event(twin, message.t)
        twin.params, twin.servos = message, servo_map(message.values)


def _control_changed(before: Params, after: Params) -> bool:
    """Tell whether any parameter of the controller twin changed, not just arrived."""
    return any(before.values.get(n, v) != v for n, v in after.values.items() if n in arduplane.DEFAULTS)


def _hear_status(twin: Twin, status: Status) -> None:
    before = twin.status
    twin.status = status
    if before is None:
        return
    if status.clock_jumps != before.clock_jumps:
        twin.history.clear()
        twin.wind.t = -np.inf
        _event(twin, status.t)
    elif status.mode != before.mode:
        _event(twin, status.t)


def _event(twin: Twin, t: float) -> None:
    """Invalidate the running prediction: mode, mission, parameters or clock changed."""
    twin.since = t
    twin.predict_t = -np.inf
    twin.record.forget()


# -- link, wind, score -------------------------------------------------------------------------------------------------


def _watch_link(twin: Twin, now: float) -> list[Message]:
    silent = now - twin.history.newest
    lost = silent > LOST_S or (twin.status is not None and twin.status.link is Link.LOST and silent > 1.0)
    if lost == twin.lost:
        return []
    twin.lost = lost
    twin.predict_t = -np.inf
    sentence = f"{twin.name}: no sample for {silent:.1f} s; the twin flies on alone" if lost else f"{twin.name}: link back"
    return [Alert(uav=twin.uav, t=now, kind=AlertKind.LINK_LOST, active=lost, sentence=sentence)]


def _blow(twin: Twin) -> None:
    """Feed the wind filter once a second, five rows a second."""
    if twin.history.newest - twin.wind_t < 1.0:
        return
    since = max(twin.wind_t, twin.history.newest - 10.0)
    t_v, v = twin.history.rows("velocity", since)
    t_air, air = twin.history.rows("air", since - 1.0)
    t_att, attitude = twin.history.rows("attitude", since - 1.0)
    if not (len(t_air) and len(t_att)):
        return
    for k in range(len(t_v)):
        if t_v[k] - twin.wind_t < 0.199:
            continue
        i, j = np.searchsorted(t_air, t_v[k]) - 1, np.searchsorted(t_att, t_v[k]) - 1
        if i >= 0 and j >= 0 and t_v[k] - t_air[i] < 0.5 and t_v[k] - t_att[j] < 0.5:
            twin.wind_t = float(t_v[k])
            twin.wind.update(twin.wind_t, v[k], float(air[i, 0]), float(attitude[j, 2]))


def _score(twin: Twin) -> None:
    if not twin.record.waiting or twin.history.newest < twin.record.waiting[0].t + AHEAD[-1]:
        return
    assert twin.origin is not None
    t, position = twin.history.rows("position")
    twin.record.answer(t, to_ned(twin.origin, *position.T))


# -- identify and verify -----------------------------------------------------------------------------------------------


def _window(twin: Twin, seconds: float) -> Window | None:
    assert twin.origin is not None
    return preprocess(
        twin.history, twin.origin, twin.servos, twin.wind.wind, until=twin.history.newest, seconds=seconds
    )


def _identify(twin: Twin) -> list[Message]:
    window = _airborne(_window(twin, WINDOW_S))
    have = 0.0 if window is None else float(window.ok.sum() * DT)
    if window is None or have < LEAST_S:
        if twin.axes is None:
            sentence = f"{twin.name}: {have:.0f} s of whole data, {LEAST_S:.0f} s are needed; {_missing(twin)}"
            twin.verdict, twin.state = Verdict(outcome=Outcome.STARVED, sentence=sentence), State.WAITING
        return []
    twin.state = State.IDENTIFYING if twin.axes is None else twin.state
    held_n = int(np.clip(0.3 * len(window), 8.2 / DT, 20.0 / DT))
    known, held_out = window.part(0, len(window) - held_n), window.part(len(window) - held_n, len(window))
    attempt = twin.tries % len(_SHARE)
    known = known.part(int(len(known) * (1 - _SHARE[attempt])), len(known))
    twin.tries += 1
    last = twin.axes or (None, None)
    try:
        axes = tuple(
            identify_axis(axis, known, _FREE_RUN_S[attempt], before)[1]
            for axis, before in zip(AXES, last, strict=True)
        )
    except (ValueError, np.linalg.LinAlgError) as error:
        twin.verdict = Verdict(outcome=Outcome.STARVED, sentence=f"{twin.name}: {error}", tries=twin.tries)
        return []
    verdict = verify(twin.name, axes, held_out, twin.axes, tries=twin.tries, omega=twin.omega)  # type: ignore[arg-type]
    if verdict.outcome is Outcome.VERIFIED:
        twin.axes, twin.tries = axes, 0  # type: ignore[assignment]
    twin.verdict = verdict
    return [_model(twin, axes, verdict, window)]  # type: ignore[arg-type]


def _airborne(window: Window | None) -> Window | None:
    """Keep what was flown: from the last row that was too slow to fly."""
    if window is None:
        return None
    slow = np.flatnonzero(window.ok & (window.columns(("u",))[:, 0] < SLOW))
    start = int(slow[-1]) + 1 if len(slow) else 0
    return window.part(start, len(window)) if len(window) - start > 1 else None


def _missing(twin: Twin) -> str:
    """Say which kinds of row have not come at all."""
    none = [kind for kind in ("attitude", "velocity", "position", "servo", "air") if not len(twin.history.rows(kind)[0])]
    return f"no {', '.join(none)} rows yet" if none else "wait"


def _model(twin: Twin, axes: tuple[Axis, Axis], verdict: Verdict, window: Window) -> Model:
    sound = all(np.isfinite(axis.D).all() for axis in axes)
    return Model(
        uav=twin.uav,
        t=float(window.t[-1]),
        method="paper",
        verdict=verdict,
        longitudinal=axes[0].linear() if sound else None,
        lateral=axes[1].linear() if sound else None,
        window_t0=float(window.t[0]),
        window_s=window.seconds,
        interpolated=float(window.filled.mean()),
        wind_n=float(twin.wind.wind[0]),
        wind_e=float(twin.wind.wind[1]),
    )


# -- predict -----------------------------------------------------------------------------------------------------------


def _predict(twin: Twin, now: float) -> list[Message]:
    assert twin.origin is not None
    coast = max(now - twin.history.newest, 0.0) if twin.lost else 0.0
    window = _window(twin, 62.0)
    if window is None or not window.ok[-1]:
        return []
    t0 = float(window.t[-1])
    ahead = AHEAD + round(coast)
    path, method, seq, sentence = _route_path(twin, window, ahead)
    if path is None:
        path, method = _imm_path(window, ahead), "imm"
    if path is None or not np.isfinite(path).all():
        return []
    twin.state = _state(twin, method)
    prediction = _trusted(twin, path, ahead, window, method)
    said = " ".join(part for part in (f"link lost {coast:.0f} s ago" if twin.lost else "", sentence) if part)
    law = arduplane.LAW if method == "paper" else "none: turn rate only"
    twin.prediction = msgspec.structs.replace(prediction, t=t0 + float(ahead[0]), seq=seq, sentence=said, coast_s=coast, law=law)
    if not twin.lost:
        speed = float(np.hypot(*window.v[-1, :2]))
        twin.record.keep(Made(t0, method, path, twin.prediction.tube.numpy().astype(float), speed))
    return [twin.prediction]


def _route_path(twin: Twin, window: Window, ahead: np.ndarray) -> tuple[np.ndarray | None, str, int, str]:
    """Fly the route where mode, mission and a verified model allow; else say why not."""
    mode = twin.status.mode if twin.status else ""
    if twin.axes is None:
        return None, "", -1, twin.verdict.sentence
    if mode not in ROUTE_MODES:
        return None, "", -1, f"mode {mode or 'unknown'} follows no mission: turn rate only"
    if twin.mission is None or not twin.mission.items:
        return None, "", -1, "no mission on board: turn rate only"
    params = twin.params.values if twin.params else {}
    assert twin.origin is not None
    flown = fly_ahead(
        window, twin.history, Onboard(twin.mission.items, params, twin.since), twin.axes, twin.wind, twin.origin, ahead
    )
    return flown.path, "paper", flown.seq, flown.sentence


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


def _trusted(twin: Twin, path: np.ndarray, ahead: np.ndarray, window: Window, method: str) -> Prediction:
    """Wrap the path in its tube and say up to when the 90 % error stays below 10 % of the path."""
    tube, distance = twin.record.tube(method, np.arange(0.0, ahead[-1] + 1.0))
    tube, distance = tube[-len(ahead) :], distance[-len(ahead) :]
    speed = float(np.hypot(*window.v[-1, :2]))
    start = speed * ahead[0]
    length = np.maximum(path_length(path, speed) + start, 2.0 * max(speed, 1.0))
    over = np.flatnonzero(distance / length > LIMIT)
    over = over[over > 0] if len(over) and not ahead[0] else over
    horizon = float(AHEAD[over[0] - 1] if len(over) and over[0] else AHEAD[-1] if not len(over) else 0.0)
    held, n = twin.record.held
    assert twin.origin is not None
    return Prediction(
        uav=twin.uav,
        t=float(window.t[-1]),
        state=twin.state,
        method=method,
        origin=tuple(twin.origin),
        ahead=Array.of(AHEAD),
        path=Array.of(path),
        tube=Array.of(tube),
        quantile=QUANTILE,
        horizon_s=horizon,
        horizon_open=not len(over),
        held=held,
        held_n=n,
    )


def fleet_row(twin: Twin, now: float, **claim: object) -> FleetRow:
    """Give the aircraft's line of the fleet table; `now` is data time, `claim` names worker and epoch."""
    t10, censored, n = twin.record.t10
    made = twin.prediction
    return FleetRow(
        uav=twin.uav,
        state=twin.state,
        verdict=twin.verdict.sentence,
        fit=twin.verdict.fit,
        horizon_s=made.horizon_s if made else 0.0,
        sample_age_s=max(now - twin.history.newest, 0.0) if np.isfinite(twin.history.newest) else None,
        prediction_age_s=max(now - made.t, 0.0) if made else None,
        t10_s=t10,
        t10_censored=censored,
        t10_n=n,
        **claim,  # type: ignore[arg-type]
    )
