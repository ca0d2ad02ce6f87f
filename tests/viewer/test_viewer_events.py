"""What happened, read off what is said: events from messages, and the list they make."""

import numpy as np
import pytest

from fleet.contract import (
    Alert,
    AlertKind,
    Array,
    Item,
    Link,
    Mission,
    Model,
    Outcome,
    Prediction,
    Rows,
    Status,
    TwinState,
    Verdict,
)
from fleet.contract import Event as Happened
from tests.support.pretend_feed import HOSTILE, T
from viewer.panels.panels import MAX_EVENT_ROWS, event_list_html
from viewer.store.event_detection import MAX_STEPS, MAX_TEXT, DetectorState, detect_events
from viewer.store.inbox import SampleSubset
from viewer.theme.events import MAX_ALERTS, MAX_EVENTS, EventKind, TimelineEvent, closed_at, merged
from viewer.theme.palette import DARK, LIGHT


def told(*messages) -> list[tuple[float, EventKind, str]]:
    """Everything that happened, times counted from T."""
    known, events = DetectorState(), []
    for message in messages:
        known, fresh = detect_events(known, message)
        events += [(event.t - T, event.kind, event.text) for event in fresh]
    return events


def status(t: float, mode: str = "AUTO", *, armed: bool = True, lost: bool = False, sentence: str = "") -> Status:
    return Status(uav=7, t=T + t, mode=mode, armed=armed, link=Link.LOST if lost else Link.LIVE, sentence=sentence)


def alert(t: float, kind: AlertKind = AlertKind.LINK_LOST, *, active: bool = True, **more) -> Alert:
    return Alert(uav=7, t=T + t, kind=kind, active=active, **more)


def model(t: float, outcome: Outcome, *, in_force: bool) -> Model:
    newest = Verdict(outcome=outcome, sentence="uav-7: mean fit 88 %")
    return Model(uav=7, t=T + t, method="paper", verdict=newest, active_verdict=newest if in_force else None)


def legs(*seqs: float) -> SampleSubset:
    x = np.array(seqs, float)[:, None]
    return SampleSubset(uav=7, t=T + len(x), leg=Rows(t=Array.of(T + np.arange(len(x)), "<f8"), x=Array.of(x)))


def told_of(t: float, event: Happened | None, said: str = "", *, event_t: float | None = None) -> Prediction:
    nothing = Array.of(np.zeros((0, 3)))
    return Prediction(
        uav=7,
        t=T + t,
        state=TwinState.PREDICTING,
        method="imm",
        origin=(0, 0, 0),
        ahead=Array.of([]),
        path=nothing,
        prediction_region_half_axes=nothing,
        event=event,
        event_t=T + (t if event_t is None else event_t) if event else 0.0,
        event_text=said,
    )


def mission(t: float, *, alt_m: float = 60.0, frame: int = 3, complete: bool = True, home: float = 0.0) -> Mission:
    items = (
        Item(seq=0, command=16, frame=0, alt_m=home),
        Item(seq=1, command=22, frame=frame, alt_m=alt_m),
        Item(seq=2, command=999, frame=frame, lat_e7=5, lon_e7=5, alt_m=alt_m),
    )
    return Mission(uav=7, t=T + t, items=items, complete=complete)


NAN = float("nan")
STORIES = {
    "nothing new": (
        [status(0), status(1), status(2)],
        [(0, EventKind.MODE, "AUTO"), (0, EventKind.ARMED, "armed")],
    ),
    "a mode changes, an unknown one does not": (
        [status(0, armed=False), status(1, "", armed=False), status(2, "RTL", armed=False)],
        [(0, EventKind.MODE, "AUTO"), (2, EventKind.MODE, "RTL")],
    ),
    "armed and disarmed": (
        [status(0, "", armed=False), status(1, ""), status(9, "", armed=False)],
        [(1, EventKind.ARMED, "armed"), (9, EventKind.DISARMED, "disarmed")],
    ),
    "a sentence stands for half a minute": (
        [
            status(k, "", armed=False, sentence=said)
            for k, said in enumerate(["uav-7: EKF", "uav-7: EKF", "", "x", "y"])
        ],
        [(0, EventKind.WARNING, "EKF"), (3, EventKind.WARNING, "x"), (4, EventKind.WARNING, "y")],
    ),
    "what counts the seconds of a lost link is no warning": (
        [status(0, "", armed=False)] + [status(k, "", armed=False, lost=True, sentence=f"{k} s") for k in (4, 5, 6)],
        [(4, EventKind.LINK_LOST, "link lost")],
    ),
    "who was never heard is not lost": ([status(0, "", armed=False, lost=True), status(1, "", armed=False)], []),
    "two speak of one loss": (
        [
            status(0, "", armed=False),
            alert(3),
            status(4, "", armed=False, lost=True),
            status(9, "", armed=False),
            alert(9.1, active=False),
        ],
        [(3, EventKind.LINK_LOST, "link lost"), (9, EventKind.LINK_RESTORED, "link back")],
    ),
    "and one of them late": (
        [
            status(0, "", armed=False),
            status(4, "", armed=False, lost=True),
            status(9, "", armed=False),
            alert(3),
            alert(9, active=False),
        ],
        [(4, EventKind.LINK_LOST, "link lost"), (9, EventKind.LINK_RESTORED, "link back")],
    ),
    "a worker that is behind calls a link lost that its gateway hears": (
        [status(60, "", armed=False), alert(20), alert(31, active=False), status(61, "", armed=False)],
        [],
    ),
    "where the gateway has fallen silent the worker tells": (
        [status(0, "", armed=False), alert(3), alert(40, active=False)],
        [(3, EventKind.LINK_LOST, "link lost"), (40, EventKind.LINK_RESTORED, "link back")],
    ),
    "what a prediction tells is told once": (
        [
            told_of(1, None),
            told_of(2, Happened.PARAMETERS, "L1"),
            told_of(3, Happened.PARAMETERS, "L1", event_t=2),
            told_of(9, Happened.TOUCH_DOWN, "down"),
            told_of(12, Happened.COASTING_EXPIRED),
        ],
        [
            (2, EventKind.PARAMETERS, "L1"),
            (9, EventKind.GROUND, "down"),
            (12, EventKind.TELEMETRY_LOST, "coasting expired"),
        ],
    ),
    "a prediction repeats nothing that others tell": (
        [told_of(k, event) for k, event in enumerate((Happened.MODE, Happened.MISSION, Happened.LINK_LOST), 1)],
        [],
    ),
    "home alone is no mission": ([Mission(uav=7, t=T, items=(Item(seq=0, command=16),), complete=True)], []),
    "an alert is raised once and withdrawn once": (
        [alert(k, AlertKind.GROUND, active=k < 3, sentence="uav-7: ground in 8 s") for k in range(5)],
        [(0, EventKind.ALERT, "ground in 8 s"), (3, EventKind.CLEARED, "ground cleared")],
    ),
    "conflicts with two others are told apart": (
        [
            alert(0, AlertKind.CONFLICT, other=8, sentence="uav-7: near uav-8"),
            alert(1, AlertKind.CONFLICT, other=9, sentence="uav-7: near uav-9"),
            alert(2, AlertKind.CONFLICT, other=8, active=False),
        ],
        [
            (0, EventKind.ALERT, "near uav-8"),
            (1, EventKind.ALERT, "near uav-9"),
            (2, EventKind.CLEARED, "conflict with uav-8 cleared"),
        ],
    ),
    "a stranger cannot raise alerts without end": (
        [alert(k, AlertKind.CONFLICT, other=k, sentence=f"{k}") for k in range(MAX_ALERTS + 5)],
        [(k, EventKind.ALERT, f"{k}") for k in range(MAX_ALERTS)],
    ),
    "a model that was never verified is none": (
        [model(0, Outcome.INSUFFICIENT_DATA, in_force=False), model(4, Outcome.INSUFFICIENT_DATA, in_force=False)],
        [(0, EventKind.NO_MODEL, "no model yet: insufficient data")],
    ),
    "a model is verified, doubted, and sound again": (
        [
            model(0, Outcome.BELOW_THRESHOLD, in_force=False),
            model(4, Outcome.VERIFIED, in_force=True),
            model(8, Outcome.WORSE_THAN_LAST, in_force=True),
            *(model(t, Outcome.DIVERGED, in_force=True) for t in (12, 16, 20, 24)),
            model(28, Outcome.VERIFIED, in_force=True),
        ],
        [
            (0, EventKind.NO_MODEL, "no model yet: below threshold"),
            (4, EventKind.VERIFIED, "model verified: mean fit 88 %"),
            (20, EventKind.UNVERIFIED, "no verification for 12 s (diverged); an earlier model stays active"),
            (28, EventKind.ACCEPTED, "model accepted again"),
        ],
    ),
    "a model that is only plausible is named so": (
        [model(2, Outcome.PLAUSIBLE, in_force=True), model(6, Outcome.VERIFIED, in_force=True)],
        [(2, EventKind.VERIFIED, "model plausible: mean fit 88 %")],
    ),
    "verdicts that alternate are not told one by one": (
        [model(t, Outcome.VERIFIED if t % 4 else Outcome.DIVERGED, in_force=True) for t in range(2, 90, 2)],
        [(2, EventKind.VERIFIED, "model verified: mean fit 88 %")],
    ),
    "a model that is withdrawn is none": (
        [model(0, Outcome.VERIFIED, in_force=True), model(4, Outcome.INSUFFICIENT_DATA, in_force=False)],
        [
            (0, EventKind.VERIFIED, "model verified: mean fit 88 %"),
            (4, EventKind.NO_MODEL, "no model yet: insufficient data"),
        ],
    ),
    "a late viewer meets a model in force whose newest try failed": (
        [model(0, Outcome.INSUFFICIENT_DATA, in_force=True)],
        [(0, EventKind.VERIFIED, "model verified: mean fit 88 %")],
    ),
    "items by name, number or nothing": (
        [legs(0, 0, 3), mission(5), legs(1, 1, 2, 2)],
        [
            (2, EventKind.ITEM, "item 3"),
            (5, EventKind.MISSION, "mission on board, 3 items"),
            (0, EventKind.ITEM, "item 1: take-off"),
            (2, EventKind.ITEM, "item 2: command 999"),
        ],
    ),
    "the same mission read twice, and another": (
        [mission(0), mission(1, frame=6, home=584.0), mission(2, complete=False, alt_m=9.0), mission(3, alt_m=70.0)],
        [(0, EventKind.MISSION, "mission on board, 3 items"), (3, EventKind.MISSION, "new mission on board, 3 items")],
    ),
    "a mission with no number for a height is no other one every time": (
        [mission(0, alt_m=NAN), mission(10, alt_m=NAN)],
        [(0, EventKind.MISSION, "mission on board, 3 items")],
    ),
    "times that cannot be": ([status(NAN), status(1e300, "RTL"), status(-1e11, "LAND", armed=False)], []),
}


@pytest.mark.parametrize(("messages", "expected"), STORIES.values(), ids=STORIES)
def test_what_is_said_becomes_what_happened(messages: list, expected: list) -> None:
    assert told(*messages) == expected


@pytest.mark.parametrize("x", [np.zeros(3), np.zeros((3, 2)), np.zeros((2, 1))], ids=["flat", "wide", "short"])
def test_legs_of_no_sound_shape_are_refused(x: np.ndarray) -> None:
    rows = Rows(t=Array.of([T, T, T], "<f8"), x=Array.of(x))
    with pytest.raises(ValueError, match="leg rows have shape"):
        detect_events(DetectorState(), SampleSubset(uav=7, t=T, leg=rows))


def test_wild_messages_stay_within_bounds() -> None:
    flood = np.random.default_rng(3).integers(1, 900, 5_000).astype(float)
    flood[::7] = np.nan
    known, events = detect_events(DetectorState(), legs(*flood))
    assert len(events) == MAX_STEPS and known.seq == int(flood[np.isfinite(flood)][-1])
    _, (event, *_) = detect_events(DetectorState(), status(0, "M" * 10_000))
    assert len(event.text) == MAX_TEXT
    many: tuple[TimelineEvent, ...] = ()
    for k in np.random.default_rng(4).permutation(1_000):
        many = merged(many, [TimelineEvent(T + float(k), EventKind.MODE, "x")])
    assert len(many) == MAX_EVENTS and [e.t for e in many] == sorted(e.t for e in many)


def test_every_kind_has_its_mark_and_only_verified_looks_verified() -> None:
    assert all(kind.glyph for kind in EventKind)
    for palette in (DARK, LIGHT):
        green = {kind for kind in EventKind if palette.event(kind) == palette.verified}
        assert green == {EventKind.VERIFIED, EventKind.ACCEPTED}
    assert EventKind.NO_MODEL.glyph != EventKind.VERIFIED.glyph != EventKind.UNVERIFIED.glyph


def test_the_end_takes_away_only_losses_after_it() -> None:
    events = (
        TimelineEvent(T, EventKind.LINK_LOST, "link lost"),
        TimelineEvent(T + 5, EventKind.LINK_RESTORED, "x"),
        TimelineEvent(T + 13, EventKind.LINK_LOST, "link lost"),
    )
    assert [e.kind for e in closed_at(events, T + 10)] == [EventKind.LINK_LOST, EventKind.LINK_RESTORED, EventKind.END]


# --- the list ---


def test_the_list_is_newest_first_bounded_and_escaped() -> None:
    events = tuple(TimelineEvent(T + k, EventKind.WARNING, f"{k} {HOSTILE}") for k in range(MAX_EVENT_ROWS + 12))
    page = event_list_html(events, DARK)
    assert page.count('class="event"') == MAX_EVENT_ROWS and "and 12 earlier" in page and "<img" not in page
    assert page.index(f"{MAX_EVENT_ROWS + 11} &lt;img") < page.index(f"{MAX_EVENT_ROWS + 10} &lt;img")
