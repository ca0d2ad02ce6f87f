"""Detect events in the messages of a UAV.

`detect_events(state, message)` is a pure function: it returns the next state and the events of this message.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from fleet.contract import (
    Alert,
    AlertKey,
    AlertKind,
    DiagnosisOutcome,
    Event,
    Item,
    Link,
    Mismatch,
    Mission,
    Model,
    Outcome,
    Prediction,
    Status,
    Verdict,
)
from viewer.store.inbox import SampleSubset
from viewer.theme.events import LATEST, MAX_ALERTS, EventKind, TimelineEvent, clip

# MAV_CMD. Source: MAVLink common.xml.
WAYPOINT, LOITER_UNLIM, LOITER_TURNS, LOITER_TIME, RTL, LAND, TAKEOFF, LOITER_TO_ALT = 16, 17, 18, 19, 20, 21, 22, 31
SPLINE, VTOL_TAKEOFF, VTOL_LAND, DO_JUMP = 82, 84, 85, 177

ITEM_NAMES = {
    WAYPOINT: "waypoint",
    LOITER_UNLIM: "loiter",
    LOITER_TURNS: "loiter turns",
    LOITER_TIME: "loiter for a time",
    RTL: "return",
    LAND: "land",
    TAKEOFF: "take-off",
    LOITER_TO_ALT: "loiter to altitude",
    SPLINE: "spline waypoint",
    VTOL_TAKEOFF: "VTOL take-off",
    VTOL_LAND: "VTOL landing",
    DO_JUMP: "jump",
}


MAX_TEXT = 200  # characters kept of a received text
QUIET_S = 2.5  # without a gateway status for this long, link alerts of the worker count [s]
MAX_CAUSES = 8  # names accepted of one mismatch
MAX_STEPS = 20  # mission item changes accepted of one sample
UNVERIFIED_S = 12.0  # failing verifications for this long are an event: about three verdicts [s]
ACCEPTED = (
    Outcome.VERIFIED,
    Outcome.PLAUSIBLE,
    Outcome.WORSE_THAN_LAST,
)  # confirm a new or active model


class DetectorState(NamedTuple):
    """Latest values of one UAV whose change is an event."""

    mode: str = ""
    armed: bool = False
    lost: bool | None = None  # None: link never up, so it cannot be lost
    status_t: float = -np.inf  # time of the last gateway status [s since 1970]
    sentence: str = ""
    items: tuple[Item, ...] = ()
    seq: int = -1
    verdict: str | None = None  # last reported: none (no model), sound or doubted; None before any
    accepted_t: float = -np.inf  # time of the last accepted verification [s since 1970]
    raised: frozenset[AlertKey] = frozenset()  # active alerts, by `Alert.about`
    mismatch: tuple[str, ...] = ()  # outcome and names of the last reported mismatch
    prediction_event_t: float = 0.0  # time of the last event in predictions [s since 1970]


Detection = tuple[DetectorState, list[TimelineEvent]]


def detect_events(state: DetectorState, message: Any) -> Detection:
    """Compare a message with the state; return the next state and the events in order.

    Raises:
        ValueError: when rows of a sample have a wrong shape; the gateway must resend.
    """
    if (detector := _DETECTORS.get(type(message))) is None:
        return state, []
    state, events = detector(state, message)
    return state, [event for event in events if 0 < event.t < LATEST]


def _status(state: DetectorState, status: Status) -> Detection:
    lost = status.link is Link.LOST
    if state.lost is None and not lost:
        state = state._replace(lost=False)
    state, events = _link(state, status.t, lost) if state.lost is not None else (state, [])
    if status.mode and status.mode != state.mode:
        events.append(TimelineEvent(status.t, EventKind.MODE, clip(status.mode, MAX_TEXT)))
    if status.armed != state.armed:
        kind = EventKind.ARMED if status.armed else EventKind.DISARMED
        events.append(TimelineEvent(status.t, kind, kind.value))
    sentence = "" if lost else status.sentence  # while lost, the sentence only counts seconds
    if sentence and sentence != state.sentence:
        events.append(TimelineEvent(status.t, EventKind.WARNING, _without_uav_prefix(sentence, status.uav)))
    mode = status.mode or state.mode
    return state._replace(mode=mode, armed=status.armed, sentence=sentence, status_t=status.t), events


def _link(state: DetectorState, t: float, lost: bool) -> Detection:
    if lost == bool(state.lost):
        return state, []
    kind, text = (EventKind.LINK_LOST, "link lost") if lost else (EventKind.LINK_RESTORED, "link back")
    return state._replace(lost=lost), [TimelineEvent(t, kind, text)]


def _alert(state: DetectorState, alert: Alert) -> Detection:
    if alert.kind is AlertKind.LINK_LOST:  # a worker may lag behind the gateway
        return _link(state, alert.t, alert.active) if alert.t > state.status_t + QUIET_S else (state, [])
    if alert.active == (alert.about in state.raised):
        return state, []
    name = alert.kind.value.replace("_", " ") + (f" with uav-{alert.other}" if alert.other >= 0 else "")
    if not alert.active:
        state = state._replace(raised=state.raised - {alert.about})
        return state, [TimelineEvent(alert.t, EventKind.CLEARED, f"{name} cleared")]
    if len(state.raised) >= MAX_ALERTS:
        return state, []
    text = _without_uav_prefix(alert.sentence, alert.uav) or name
    return state._replace(raised=state.raised | {alert.about}), [TimelineEvent(alert.t, EventKind.ALERT, text)]


def _mismatch(state: DetectorState, mismatch: Mismatch) -> Detection:
    """Detect a change of outcome or names of a mismatch; a suspected mismatch is no event."""
    reported = mismatch.outcome in (DiagnosisOutcome.NAMED, DiagnosisOutcome.UNKNOWN)
    names = (mismatch.outcome.value, *(cause.name for cause in mismatch.causes[:MAX_CAUSES])) if reported else ()
    if names == state.mismatch:
        return state, []
    state = state._replace(mismatch=names)
    if not reported:
        return state, [TimelineEvent(mismatch.t, EventKind.CLEARED, "mismatch cleared")]
    text = _without_uav_prefix(mismatch.sentence, mismatch.uav) or "mismatch"
    return state, [TimelineEvent(mismatch.t, EventKind.MISMATCH, text)]


def _mission(state: DetectorState, mission: Mission) -> Detection:
    if len(mission.items) < 2 or not mission.complete:  # a single item is home
        return state, []
    if state.items and _plan(mission.items) == _plan(state.items):
        return state._replace(items=mission.items), []
    text = f"{'new mission' if state.items else 'mission'} on board, {len(mission.items)} items"
    return state._replace(items=mission.items), [TimelineEvent(mission.t, EventKind.MISSION, text)]


def _plan(items: tuple[Item, ...]) -> list[tuple[int, int, int, str]]:
    """Return the fields that identify a mission: no home, no fields that depend on the link or the log."""
    return [(item.command, item.lat_e7, item.lon_e7, f"{item.alt_m:.1f}") for item in items[1:]]


def _sample(state: DetectorState, sample: SampleSubset) -> Detection:
    if sample.leg is None:
        return state, []
    t, x = sample.leg.t.numpy(), sample.leg.x.numpy()
    if x.ndim != 2 or x.shape[1] != 1 or t.shape != (len(x),):
        raise ValueError(f"uav-{sample.uav}: leg rows have shape {x.shape}, expected (n, 1) and n times; resend")
    valid = np.isfinite(x[:, 0]) & (np.abs(x[:, 0]) < 1e6)
    t, seqs = t[valid], x[valid, 0].astype(int)
    steps = np.flatnonzero(np.diff(seqs, prepend=state.seq))[-MAX_STEPS:]
    if not len(steps):
        return state, []
    changes = [(float(t[k]), int(seqs[k])) for k in steps if seqs[k] > 0]
    events = [TimelineEvent(at, EventKind.ITEM, _item(state.items, seq)) for at, seq in changes]
    return state._replace(seq=int(seqs[-1])), events


def _item(items: tuple[Item, ...], seq: int) -> str:
    """Describe a mission item; without the mission by its number only."""
    command = next((item.command for item in items if item.seq == seq), None)
    return f"item {seq}" if command is None else f"item {seq}: {ITEM_NAMES.get(command, f'command {command}')}"


def _model(state: DetectorState, model: Model) -> Detection:
    """Detect the first accepted model, persistent verification failure, and recovery.

    Verdicts arrive every few seconds and alternate near a threshold: only a lasting change is an event.
    """
    newest, before = model.verdict, state.verdict
    accepted_t = model.t if before is None or newest.outcome in ACCEPTED else state.accepted_t
    state = state._replace(accepted_t=accepted_t)
    if model.active_verdict is None:
        status, event = "none", TimelineEvent(model.t, EventKind.NO_MODEL, f"no model yet: {_outcome(newest)}")
    elif before in (None, "none"):
        summary = _without_uav_prefix(model.active_verdict.sentence, model.uav)
        word = "plausible" if model.active_verdict.outcome is Outcome.PLAUSIBLE else "verified"
        text = f"model {word}: {summary}"
        status, event = "accepted", TimelineEvent(model.t, EventKind.VERIFIED, text)
    elif newest.outcome in ACCEPTED:
        status, event = "accepted", TimelineEvent(model.t, EventKind.ACCEPTED, "model accepted again")
    elif model.t - accepted_t >= UNVERIFIED_S:
        text = f"no verification for {UNVERIFIED_S:.0f} s ({_outcome(newest)}); an earlier model stays active"
        status, event = "unverified", TimelineEvent(model.t, EventKind.UNVERIFIED, text)
    else:
        return state, []
    return (state, []) if status == before else (state._replace(verdict=status), [event])


_PREDICTION_EVENTS = {  # events in predictions; other messages report modes, missions and the link sooner
    Event.TARGET: EventKind.MODE,
    Event.PARAMETERS: EventKind.PARAMETERS,
    Event.TAKE_OFF: EventKind.TAKE_OFF,
    Event.LANDING: EventKind.LANDING,
    Event.TOUCH_DOWN: EventKind.GROUND,
    Event.COASTING_EXPIRED: EventKind.TELEMETRY_LOST,
    Event.POSITION_LOST: EventKind.TELEMETRY_LOST,
    Event.POSITION_RESTORED: EventKind.TELEMETRY_RESTORED,
    Event.CLOCK: EventKind.FRAME,
    Event.ORIGIN: EventKind.FRAME,
}


def _prediction(state: DetectorState, prediction: Prediction) -> Detection:
    """Detect the event that restarted a prediction, once."""
    if prediction.event is None or prediction.event_t == state.prediction_event_t:
        return state, []
    state = state._replace(prediction_event_t=prediction.event_t)
    if (kind := _PREDICTION_EVENTS.get(prediction.event)) is None:
        return state, []
    text = clip(prediction.event_text, MAX_TEXT) or prediction.event.value.replace("_", " ")
    return state, [TimelineEvent(prediction.event_t, kind, text)]


def _outcome(verdict: Verdict) -> str:
    return verdict.outcome.value.replace("_", " ")


def _without_uav_prefix(sentence: str, uav: int) -> str:
    return clip(sentence.removeprefix(f"uav-{uav}: "), MAX_TEXT)


_DETECTORS: dict[type, Callable[[DetectorState, Any], Detection]] = {
    Status: _status,
    Alert: _alert,
    Mismatch: _mismatch,
    Mission: _mission,
    SampleSubset: _sample,
    Model: _model,
    Prediction: _prediction,
}
