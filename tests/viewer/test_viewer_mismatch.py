"""A mismatch on the page: its sentence with its proof, its stretch of the flown path, its mark in the table."""

import msgspec
import numpy as np
import pytest

from fleet.contract import Cause, DiagnosisOutcome, Mismatch
from tests.support.pretend_feed import HOSTILE, STAMP, Clock, T, feed_of
from viewer.panels.detail import status_html
from viewer.scene.selection import selected as mismatch_lines
from viewer.text import words as mismatch_text
from viewer.text.words import alerts_html, severity, table
from viewer.theme.events import EventKind
from viewer.theme.palette import DARK

TRACK = np.column_stack([T + np.arange(100.0), np.arange(100.0), np.zeros(100), np.full(100, 9.0)])


def told(*segments: tuple[float, float], **more) -> Mismatch:
    cause = Cause(name="thrust_loss", channel="thrust", segments=segments)
    given = {
        "uav": 2,
        "t": T + 99.0,
        "outcome": DiagnosisOutcome.NAMED,
        "causes": (cause,),
        "sentence": "thrust is lost",
    }
    return Mismatch(**(given | more))


@pytest.fixture
def scene():
    clock = Clock()
    feed, fleet, bus = feed_of(clock, 4, hostile=3)
    return feed, fleet, bus, clock


def page(feed, clock) -> str:
    fleet = feed.all()
    shown = [status_html(vehicle, DARK, clock()) for vehicle in fleet]
    listed = table(fleet, DARK, clock(), total=len(fleet), pick="pick({})", selected=None)
    return "".join([*shown, listed, alerts_html(fleet, DARK, clock())])


def test_the_sentence_and_its_proof_are_said(scene):
    feed, _, _, clock = scene
    said = status_html(feed.get(2), DARK, clock())
    assert "control_effectiveness_loss of the aileron after 120 s" in said
    assert "1.94 → <b>1.07</b>" in said and "0.41 → <b>0.22</b>" in said
    assert "included in the prediction model" in said and DARK.mismatch in said
    assert "5 s free run" not in said  # nothing was measured
    assert "mismatch" not in status_html(feed.get(0), DARK, clock())


def test_table_and_alerts_mark_the_aircraft(scene):
    feed, _, bus, clock = scene
    fleet = feed.all()
    assert severity(fleet[2], clock()) < severity(fleet[0], clock())
    assert alerts_html(fleet, DARK, clock()).count("mismatch</span>") == 2  # of uav 2, and of the hostile one
    assert "control effectiveness loss of the aileron" in page(feed, clock)
    bus.publish(told(outcome=DiagnosisOutcome.SUSPECTED, t=T + 1.0), STAMP)
    assert "control effectiveness" not in page(feed, clock)
    assert "mismatch suspected" in status_html(feed.get(2), DARK, clock())
    assert not mismatch_text.in_force(feed.get(2).mismatch)


def test_hostile_words_stay_words(scene):
    feed, _, _, clock = scene
    assert HOSTILE in feed.get(3).mismatch.sentence
    assert HOSTILE not in page(feed, clock)
    assert "&lt;img" in status_html(feed.get(3), DARK, clock())


def test_a_mismatch_is_an_event_once(scene):
    feed, _, bus, _ = scene
    for k in range(3):
        bus.publish(told((T, T + 5.0), t=T + k), STAMP)
    bus.publish(told(outcome=DiagnosisOutcome.NONE, causes=(), t=T + 9.0), STAMP)
    kinds = [event.kind for event in feed.get(2).events if event.kind in (EventKind.MISMATCH, EventKind.CLEARED)]
    assert kinds == [
        EventKind.MISMATCH,
        EventKind.MISMATCH,
        EventKind.CLEARED,
    ]  # the pretend fleet's, then this one, then none


def test_segments_lie_on_the_flown_path():
    drawn = mismatch_lines.lines(told((T + 20.0, T + 30.0)), TRACK)
    assert drawn[0, 0, 0] == pytest.approx(20.0) and drawn[-1, 1, 0] == pytest.approx(30.0)
    assert mismatch_lines.onset_position(told((T + 20.0, T + 30.0)), TRACK) == pytest.approx([20.0, 0.0, 9.0])
    goes_on = mismatch_lines.lines(told((T + 50.0, T + 98.0)), TRACK)
    assert goes_on[-1, 1, 0] == pytest.approx(99.0)  # up to the aircraft
    assert len(mismatch_lines.lines(told((T - 500.0, T - 400.0)), TRACK)) == 0
    assert len(mismatch_lines.lines(None, TRACK)) == len(mismatch_lines.lines(told((T, T + 9.0)), TRACK[:1])) == 0


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e300])
def test_absurd_times_draw_nothing_absurd(bad):
    for segment in ((bad, T + 9.0), (T, bad), (bad, bad)):
        found = told(*(segment,) * 50)
        assert np.isfinite(mismatch_lines.lines(found, TRACK)).all()
        assert len(mismatch_lines.lines(found, TRACK)) <= mismatch_text.MAX_SHOWN * mismatch_lines.MAX_POINTS
    assert mismatch_lines.onset_position(told((bad, T)), TRACK) is None


def test_a_long_sentence_is_cut():
    found = msgspec.structs.replace(told(), sentence="x" * 100_000)
    assert len(mismatch_text.mismatch_html(found, DARK)) < 2_000
