"""Detect events in the messages of a UAV.

`detect_events(state, message)` is a pure function: it returns the next state and the events of this message.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from fleet.contract import (
    About,
    Alert,
    AlertKind,
    Found,
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
from fleet.contract import Event as Happened
from viewer.store.mission_items import ITEM_NAMES
from viewer.store.received.inbox import Head
from viewer.theme.events import LATEST, MAX_RAISED, Event, Kind

MAX_WORDS = 200  # characters kept of a received text
QUIET_S = 2.5  # without a gateway status for this long, link alerts of the worker count [s]
MAX_CAUSES = 8  # names accepted of one mismatch
MAX_STEPS = 20  # mission item changes accepted of one sample
LASTS_S = 12.0  # failing verifications for this long are an event: about three verdicts [s]
SOUND = (Outcome.VERIFIED, Outcome.WORSE_THAN_LAST)  # outcomes that confirm a model, new or active


class Known(NamedTuple):
    """Latest values of one UAV whose change is an event."""

    mode: str = ""
    armed: bool = False
    lost: bool | None = None  # None: link never up, so it cannot be lost
    status_t: float = -np.inf  # time of the last gateway status [s since 1970]
    sentence: str = ""
    items: tuple[Item, ...] = ()
    seq: int = -1
    verdict: str | None = None  # last reported: none (no model), sound or doubted; None before any
    sound_t: float = -np.inf  # time of the last accepted verification [s since 1970]
    raised: frozenset[About] = frozenset()  # active alerts, by `Alert.about`
    found: tuple[str, ...] = ()  # outcome and names of the last reported mismatch
    told_t: float = 0.0  # time of the last event in predictions [s since 1970]


Told = tuple[Known, list[Event]]


def hear(known: Known, message: Any) -> Told:
    """Compare a message with the state; return the next state and the events in order.

    Raises:
        ValueError: when rows of a sample have a wrong shape; the gateway must resend.
    """
    tell = _TELLS.get(type(message))
    if tell is None:
        return known, []
    known, events = tell(known, message)
    return known, [event for event in events if 0 < event.t < LATEST]


def _status(known: Known, status: Status) -> Told:
    lost = status.link is Link.LOST
    if known.lost is None:
        known = known._replace(lost=None if lost else False)
    known, events = _link(known, status.t, lost) if known.lost is not None else (known, [])
    known = known._replace(status_t=status.t)
    if status.mode and status.mode != known.mode:
        events.append(Event(status.t, Kind.MODE, _clip(status.mode)))
    if status.armed != known.armed:
        kind = Kind.ARMED if status.armed else Kind.DISARMED
        events.append(Event(status.t, kind, kind.value))
    sentence = "" if lost else status.sentence  # while lost, the sentence only counts seconds
    if sentence and sentence != known.sentence:
        events.append(Event(status.t, Kind.WARNING, _own_words(sentence, status.uav)))
    return known._replace(mode=status.mode or known.mode, armed=status.armed, sentence=sentence), events


def _link(known: Known, t: float, lost: bool) -> Told:
    if lost == bool(known.lost):
        return known, []
    event = Event(t, Kind.LOST, "link lost") if lost else Event(t, Kind.BACK, "link back")
    return known._replace(lost=lost), [event]


def _alert(known: Known, alert: Alert) -> Told:
    if alert.kind is AlertKind.LINK_LOST:  # a worker may lag behind the gateway
        return _link(known, alert.t, alert.active) if alert.t > known.status_t + QUIET_S else (known, [])
    if alert.active == (alert.about in known.raised):
        return known, []
    name = alert.kind.value.replace("_", " ") + (f" with uav-{alert.other}" if alert.other >= 0 else "")
    if not alert.active:
        return known._replace(raised=known.raised - {alert.about}), [Event(alert.t, Kind.EASED, f"{name} cleared")]
    if len(known.raised) >= MAX_RAISED:
        return known, []
    said = _own_words(alert.sentence, alert.uav) or name
    return known._replace(raised=known.raised | {alert.about}), [Event(alert.t, Kind.ALERT, said)]


def _mismatch(known: Known, told: Mismatch) -> Told:
    """Detect a change of outcome or names of a mismatch; a suspected mismatch is no event."""
    stands = told.outcome in (Found.NAMED, Found.UNKNOWN)
    found = (told.outcome.value, *(one.name for one in told.causes[:MAX_CAUSES])) if stands else ()
    if found == known.found:
        return known, []
    known = known._replace(found=found)
    if not stands:
        return known, [Event(told.t, Kind.EASED, "mismatch cleared")]
    return known, [Event(told.t, Kind.MISMATCH, _own_words(told.sentence, told.uav) or "mismatch")]


def _mission(known: Known, mission: Mission) -> Told:
    if len(mission.items) < 2 or not mission.complete:  # a single item is home
        return known, []
    if known.items and _plan(mission.items) == _plan(known.items):
        return known._replace(items=mission.items), []
    said = f"{'new mission' if known.items else 'mission'} on board, {len(mission.items)} items"
    return known._replace(items=mission.items), [Event(mission.t, Kind.MISSION, said)]


def _plan(items: tuple[Item, ...]) -> list[tuple[int, int, int, str]]:
    """Return the fields that identify a mission: no home, no fields that depend on the link or the log."""
    return [(item.command, item.lat_e7, item.lon_e7, f"{item.alt_m:.1f}") for item in items[1:]]


def _sample(known: Known, sample: Head) -> Told:
    if sample.leg is None:
        return known, []
    t, x = sample.leg.t.numpy(), sample.leg.x.numpy()
    if x.ndim != 2 or x.shape[1] != 1 or t.shape != (len(x),):
        raise ValueError(f"uav-{sample.uav}: leg rows have shape {x.shape}, expected (n, 1) and n times; resend")
    sound = np.isfinite(x[:, 0]) & (np.abs(x[:, 0]) < 1e6)
    t, seqs = t[sound], x[sound, 0].astype(int)
    steps = np.flatnonzero(np.diff(seqs, prepend=known.seq))[-MAX_STEPS:]
    if not len(steps):
        return known, []
    events = [Event(float(t[k]), Kind.ITEM, _item(known.items, int(seqs[k]))) for k in steps if seqs[k] > 0]
    return known._replace(seq=int(seqs[-1])), events


def _item(items: tuple[Item, ...], seq: int) -> str:
    """Describe a mission item; without the mission by its number only."""
    command = next((item.command for item in items if item.seq == seq), None)
    return f"item {seq}" if command is None else f"item {seq}: {ITEM_NAMES.get(command, f'command {command}')}"


def _model(known: Known, model: Model) -> Told:
    """Detect the first verified model, persistent verification failure, and recovery.

    Verdicts arrive every few seconds and alternate near a threshold: only a lasting change is an event.
    """
    newest, before = model.verdict, known.verdict
    sound_t = model.t if before is None or newest.outcome in SOUND else known.sound_t
    known = known._replace(sound_t=sound_t)
    if model.in_force is None:
        news, event = "none", Event(model.t, Kind.NO_MODEL, f"no model yet: {_outcome(newest)}")
    elif before in (None, "none"):
        said = _own_words(model.in_force.sentence, model.uav)
        news, event = "sound", Event(model.t, Kind.VERIFIED, f"model verified: {said}")
    elif newest.outcome in SOUND:
        news, event = "sound", Event(model.t, Kind.SOUND, "model verified again")
    elif model.t - sound_t >= LASTS_S:
        words = f"no verification for {LASTS_S:.0f} s ({_outcome(newest)}); an earlier model stays active"
        news, event = "doubted", Event(model.t, Kind.DOUBTED, words)
    else:
        return known, []
    return (known, []) if news == before else (known._replace(verdict=news), [event])


_TOLD = {  # events in predictions; other messages report modes, missions and the link sooner
    Happened.PARAMETERS: Kind.PARAMETERS,
    Happened.TAKE_OFF: Kind.TAKE_OFF,
    Happened.LANDING: Kind.LANDING,
    Happened.TOUCH_DOWN: Kind.GROUND,
    Happened.HORIZON_OVER: Kind.BLIND,
    Happened.TELEMETRY_BROKEN: Kind.BLIND,
    Happened.TELEMETRY_WHOLE: Kind.SIGHT,
    Happened.CLOCK: Kind.FRAME,
    Happened.ORIGIN: Kind.FRAME,
}


def _prediction(known: Known, prediction: Prediction) -> Told:
    """Detect the event that restarted a prediction, once."""
    if prediction.event is None or prediction.event_t == known.told_t:
        return known, []
    kind = _TOLD.get(prediction.event)
    said = _clip(prediction.event_said) or prediction.event.value.replace("_", " ")
    return known._replace(told_t=prediction.event_t), [Event(prediction.event_t, kind, said)] if kind else []


def _outcome(verdict: Verdict) -> str:
    return verdict.outcome.value.replace("_", " ")


def _own_words(sentence: str, uav: int) -> str:
    return _clip(sentence.removeprefix(f"uav-{uav}: "))


def _clip(text: str) -> str:
    return text if len(text) <= MAX_WORDS else text[: MAX_WORDS - 1] + "…"


_TELLS: dict[type, Callable[[Known, Any], Told]] = {
    Status: _status,
    Alert: _alert,
    Mismatch: _mismatch,
    Mission: _mission,
    Head: _sample,
    Model: _model,
    Prediction: _prediction,
}
