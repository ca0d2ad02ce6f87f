"""The timeline: what is kept, what is shown again, what was predicted then against what happened."""

from unittest.mock import MagicMock

import numpy as np
import pytest
from pretend_feed import HOSTILE, Clock, PretendFleet, PretendUav, T, feed_of

from fleet.bus.memory_bus import MemoryBus
from fleet.contract import Account, Alert, AlertKind, State, Status
from viewer.panels.detail import about, facts
from viewer.scene.fleet_arrays import Flock
from viewer.store.forecast import Forecast
from viewer.store.store import Feed
from viewer.store.vehicle import Vehicle
from viewer.text.words import summary, table
from viewer.theme.events import Event, Kind
from viewer.theme.palette import DARK
from viewer.timeline import compare, strip
from viewer.timeline.deck import Timeline
from viewer.timeline.panel import STEPS, TRANSPORT
from viewer.timeline.past import Past
from viewer.timeline.player import Player, Span
from viewer.timeline.recording import KEPT_S, MAX_ROWS, TOLD_S, Tape
from viewer.timeline.recordings import Tapes


@pytest.fixture
def clock() -> Clock:
    return Clock()


def timeline(feed: Feed) -> Timeline:
    return Timeline(MagicMock(), feed, Tapes(), DARK, lambda: None)


def tape_of(one: Timeline) -> Tape:
    return one._tapes.of[0]


def show(one: Timeline, feed: Feed, clock: Clock) -> Flock:
    """Draw the page once: the fleet of now, or as it was."""
    live = Flock()
    live.meet(feed.all(), clock.now)
    return one.flock(live, 0, clock.now)


def fly(one: Timeline, feed: Feed, fleet: PretendFleet, clock: Clock, until: float, *, step: float = 1.0) -> None:
    """Let the fleet fly until T + `until`, and keep it."""
    for t in np.arange(fleet._last + step, T + until + 1e-6, step):
        clock.now += step
        fleet.advance(float(t))
        one._tapes.take(feed, feed.all, clock.now)


# --- the player ---


def test_play_pause_and_live_again() -> None:
    player, span = Player(), Span(T, T + 100)
    player.pause(span)
    assert player.t == T + 100 and not player.live
    player.seek(T + 40, span)
    player.play(4.0, span)
    player.advance(2.0, span)
    assert player.t == T + 48
    player.pause(span)
    player.advance(60.0, span)
    assert player.t == T + 48
    player.play(1.0, span)
    player.advance(53.0, Span(T + 50, T + 101))  # the end has moved on, and is reached
    assert player.live


def test_what_is_no_longer_kept_is_skipped_and_from_live_one_plays_from_the_beginning() -> None:
    player = Player(T + 3, 0.0)
    player.advance(1.0, Span(T + 20, T + 100))
    assert player.t == T + 20
    player.go_live()
    player.play(1.0, Span(T + 20, T + 100))
    assert player.t == T + 20
    player.seek(T + 900, Span(T + 20, T + 100))
    assert player.t == T + 100


# --- the tape ---


def test_of_a_live_flight_ten_minutes_are_kept_in_memory_that_stays(clock: Clock) -> None:
    feed, fleet, _ = feed_of(clock, 1)
    one = timeline(feed)
    fly(one, feed, fleet, clock, 700.0)
    tape, before = tape_of(one), one._tapes.nbytes()
    assert tape.t[-1] - tape.t[0] >= KEPT_S and len(tape.told) == pytest.approx(KEPT_S / TOLD_S, abs=2)
    assert np.diff([told.t for told in tape.told]).min() >= TOLD_S
    fly(one, feed, fleet, clock, 1_900.0)
    assert one._tapes.nbytes() <= 1.35 * before < 350_000
    show(one, feed, clock)
    assert one._span.end - one._span.begin == pytest.approx(KEPT_S)


def test_of_a_long_recording_all_is_kept_in_rows_that_are_fewer(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 1)
    bus.publish(Account(t=T, links=("replay:x.tlog",), uavs=(0,)))
    tape, vehicle = Tape(), feed.one(0)
    assert vehicle.recorded
    for k in range(1, 3 * MAX_ROWS):
        vehicle.t = T + 0.2 * k
        tape.take(vehicle, np.zeros((0, 5)), clock.now)
    assert MAX_ROWS / 2 <= len(tape) <= 2 * MAX_ROWS and tape.t[0] <= T + 0.2 and T + 0.6 * MAX_ROWS - tape.t[-1] < 2


def test_a_fast_recording_is_filled_in_from_its_trail(clock: Clock) -> None:
    feed, fleet, _ = feed_of(clock, 1)
    one, uav = timeline(feed), PretendUav(0)
    fly(one, feed, fleet, clock, 60.0, step=20.0)
    tape = tape_of(one)
    assert np.diff(tape.t).max() < 1.5
    at = np.arange(T + 5, T + 55, 3.3)
    flown = np.array([tape.row(t)[:3] for t in at]) * 10
    ned = uav.ned(at)
    enu = ned[:, [1, 0, 2]] * [1, 1, -1]
    assert np.abs((flown - flown[0]) - (enu - enu[0])).max() < 2.0


def test_a_clock_that_goes_back_begins_another_tape(clock: Clock) -> None:
    feed, fleet, bus = feed_of(clock, 1)
    one = timeline(feed)
    fly(one, feed, fleet, clock, 30.0)
    bus.publish(PretendUav(0).sample(T - 1_000, T - 999))
    clock.now += 1
    one._tapes.take(feed, feed.all, clock.now)
    assert len(tape_of(one)) == 1


# --- as it was ---


@pytest.fixture
def flown(clock: Clock):
    """Five UAVs, 100 s; after 50 s one changes its mode and has an alert, which ends 10 s later."""
    feed, fleet, bus = feed_of(clock, 5)
    one = timeline(feed)
    fly(one, feed, fleet, clock, 50.0)
    bus.publish(Alert(uav=0, t=T + 50, kind=AlertKind.GROUND, sentence="ground in 8 s"))
    for uav in fleet.uavs:
        uav.status = lambda t, was=uav.status: Status(uav=was(t).uav, t=t, mode="RTL", armed=True)
    fly(one, feed, fleet, clock, 60.0)
    bus.publish(Alert(uav=0, t=T + 60, kind=AlertKind.GROUND, active=False))
    fly(one, feed, fleet, clock, 100.0)
    return one, feed, clock


def shown(one: Timeline, feed: Feed, clock: Clock, t: float) -> list:
    show(one, feed, clock)
    one.asked(f"at:{T + t}")
    return show(one, feed, clock).fleet


def test_everyone_is_shown_where_and_how_they_were(flown) -> None:
    one, feed, clock = flown
    for t in (20.0, 55.0, 80.0):
        fleet = shown(one, feed, clock, t)
        assert len(fleet) == 5 and all(isinstance(past, Past) for past in fleet)
        past = fleet[0]
        uav = PretendUav(0)
        assert past.clock(clock.now) == T + t and past.age(clock.now) < 1.1
        ned = (uav.ned(T + t) - uav.ned(T + 10.0))[[1, 0]]
        back = (past.where(clock.now) - tape_of(one).row(T + 10.0)[:3])[:2] * 10
        assert np.allclose(back, ned, atol=1.0)
        assert past.status.mode == ("AUTO" if t < 50 else "RTL")
        assert [a.sentence for a in past.alerts.values()] == (["ground in 8 s"] if 50 < t < 60 else [])
        assert T + t - 2 * TOLD_S < past.forecast.t <= T + t + 0.5
        assert past.events and all(event.t <= T + t for event in past.events)
        assert fleet[1].state(clock.now) is State.IDENTIFYING and fleet[1].forecast is None
        assert len(feed.trail(past)) > 10 and feed.trail(past)[-1, 0] == pytest.approx(T + t)
        assert feed.track(past)[-1, 0] == pytest.approx(T + t)


def test_the_page_can_say_all_of_a_past_fleet(flown) -> None:
    one, feed, clock = flown
    fleet = shown(one, feed, clock, 55.0)
    said = about(fleet[0], DARK, clock.now) + facts(fleet[0], clock.now) + summary(fleet, feed, DARK, clock.now)
    said += table(fleet, DARK, clock.now, total=5, pick="{}", selected=0)
    assert "ground in 8 s" in said and "RTL" in said and "paused" in said and "nan" not in said


def test_live_shows_the_fleet_itself_and_another_time_another_flock(flown) -> None:
    one, feed, clock = flown
    live = Flock()
    live.meet(feed.all(), clock.now)
    assert one.flock(live, 0, clock.now) is live and type(one.one(0)) is Vehicle
    one.asked(f"at:{T + 40}")
    then = one.flock(live, 0, clock.now)
    assert then is not live and then.changes < 0 and isinstance(one.one(0), Past) and one.one(99) is None
    i = then.index(0)
    assert np.allclose(then.at[i], tape_of(one).row(T + 40)[:3]) and np.isfinite(then.ring).all()
    assert np.allclose(then.ring[i, -11], tape_of(one).row(T + 30)[:3], atol=0.05)  # ten seconds before
    before = then.changes
    one.asked(f"at:{T + 60}")
    assert one.flock(live, 0, clock.now).changes < before  # trails are laid anew
    one.asked("● Live")
    assert one.flock(live, 0, clock.now) is live


def test_the_head_says_how_much_is_kept_and_what_it_takes(flown) -> None:
    one, feed, clock = flown
    shown(one, feed, clock, 70.0)
    said = one._head(one.player.t, one._span)
    assert "0:30 ago · paused · 1:40 of 5 UAVs recorded, " in said and " MB<" in said and "every 5 s" in said
    assert " UAVs" not in said  # the fleet's own words, which are looked for on the page


def test_two_pages_show_two_times(flown) -> None:
    one, feed, clock = flown
    other = Timeline(MagicMock(), feed, one._tapes, DARK, lambda: None)
    shown(one, feed, clock, 30.0)
    assert shown(other, feed, clock, 70.0)[0].then == T + 70 and one.one(0).then == T + 30


def test_it_plays_on_by_the_wall_clock_and_becomes_live(flown) -> None:
    one, feed, clock = flown
    shown(one, feed, clock, 90.0)
    one.asked("4×")
    for expected in (94.0, 98.0, None):
        clock.now += 1.0
        show(one, feed, clock)
        assert one.player.t == (None if expected is None else pytest.approx(T + expected))


def test_before_it_was_heard_of_it_is_not_there(clock: Clock) -> None:
    feed, fleet, bus = feed_of(clock, 1)
    one = timeline(feed)
    fly(one, feed, fleet, clock, 30.0)
    late = PretendUav(4)
    for k in range(31, 41):
        clock.now += 1
        fleet.advance(T + k)
        bus.publish(late.sample(T + k - 1, T + k))
        one._tapes.take(feed, feed.all, clock.now)
    assert [past.uav for past in shown(one, feed, clock, 20.0)] == [0]
    assert [past.uav for past in shown(one, feed, clock, 38.0)] == [0, 4]


def test_recordings_of_different_days_are_laid_beside_each_other(clock: Clock) -> None:
    feed = Feed(bus := MemoryBus(), clock)
    one, uavs, later = timeline(feed), (PretendUav(0), PretendUav(2)), 9e6
    for k in range(1, 41):
        clock.now += 1
        for uav, shift in zip(uavs, (0.0, later), strict=True):
            bus.publish(uav.sample(T + shift + k - 1, T + shift + k))
        bus.publish(Account(t=T, links=("replay:a", "replay:b"), uavs=(0, 2)))
        one._tapes.take(feed, feed.all, clock.now)
    fleet = shown(one, feed, clock, 20.0)
    assert fleet[0].then == T + 20 and fleet[1].then == pytest.approx(T + later + 20, abs=1.0)


# --- steps and presses ---


def test_steps_go_by_event_by_second_and_by_frame(flown) -> None:
    one, feed, clock = flown
    shown(one, feed, clock, 52.0)
    seen = {}
    for what in STEPS:
        shown(one, feed, clock, 52.0)
        one.asked(what)
        seen[what] = one.player.t - T
    events = sorted(event.t - T for event in tape_of(one).events)
    assert seen["1 s ▸"] == 53.0 and seen["◂ 1 s"] == 51.0
    assert seen["frame ▸"] == pytest.approx(53.0) and seen["◂ frame"] == pytest.approx(51.0)  # rows a second apart
    assert seen["event ▸"] == min(t for t in events if t > 52) == 60.0
    assert seen["◂ event"] == max(t for t in events if t < 52)


def test_a_press_near_an_event_means_the_event(flown) -> None:
    one, feed, clock = flown
    show(one, feed, clock)
    begin, end = one._span
    one.asked(f"share:{(T + 60.4 - begin) / (end - begin):.5f}")
    assert one.player.t == T + 60.0
    one.asked(f"share:{(T + 70.0 - begin) / (end - begin):.5f}")
    assert one.player.t == pytest.approx(T + 70.0, abs=0.1)


@pytest.mark.parametrize(
    "what", ["", ":", "share:", "share:nan", "at:inf", "at:x", "x:1", HOSTILE, "9×", "▸", "at:" * 9]
)
def test_mischief_changes_nothing_that_matters(flown, what: str) -> None:
    one, feed, clock = flown
    show(one, feed, clock)
    one.asked(what)
    assert one.player.t is None or T <= one.player.t <= T + 100
    timeline(feed).asked(what)  # nobody was ever heard


def test_every_button_does_something(flown) -> None:
    one, feed, clock = flown
    for what in (*TRANSPORT, *STEPS):
        shown(one, feed, clock, 52.0)
        before = one.player.t, one.player.rate
        one.asked("4×" if what == "Pause" else "Pause")
        one.asked(what)
        assert (one.player.t, one.player.rate) != before or what == "Pause"


# --- then against since ---


def laid(told: Forecast, path: np.ndarray) -> Forecast:
    """Give the same prediction with another path."""
    other = Forecast(told.message, told.place, told.heard)
    vars(other)["_scene_arrays"] = told.ahead, path, told.tube
    return other


def test_a_prediction_that_came_true_is_held_and_one_that_did_not_is_not(flown) -> None:
    one, feed, clock = flown
    past = shown(one, feed, clock, 40.0)[0]
    path = past.tape.path(past.then, past.then + 60)
    told = past.forecast
    flown_path = np.stack([np.interp(told.ahead, path[:, 0] - told.t, path[:, k]) for k in (1, 2, 3)], -1)
    true = laid(told, flown_path)
    found = compare.misses(true, path, past.then)
    assert [one.ahead for one in found] == [s for s in compare.STEPS_S if past.then + s <= told.t + told.until]
    assert len(found) >= 2 and all(one.held and one.miss < 3.0 for one in found)
    wrong = laid(told, flown_path + np.array([0, 0, 50.0]))
    assert not any(one.held for one in compare.misses(wrong, path, past.then))
    assert compare.misses(wrong, path, past.then)[0].miss == pytest.approx(500, abs=3)
    lines = compare.whiskers(wrong, path, past.then)
    assert len(lines) >= 2 and np.allclose(lines[:, 0, 2] - lines[:, 1, 2], 50, atol=0.3)


def test_what_is_not_answered_yet_is_said_so(flown) -> None:
    one, feed, clock = flown
    past = shown(one, feed, clock, 98.0)[0]
    assert compare.misses(past.forecast, past.tape.path(past.then, past.then + 60), past.then) == []
    assert "not yet compared" in strip.compared([], past.forecast.t, past.then, DARK)
    assert "no prediction at this time" in strip.compared([], None, past.then, DARK)
    assert "horizon shorter than 5 s" in strip.compared([], past.forecast.t, past.then, DARK, 4.9)


# --- the bar ---


def test_the_bar_marks_events_in_their_colours_and_escapes_their_words() -> None:
    own = [Event(T + 10, Kind.MODE, HOSTILE), Event(T + 50, Kind.ALERT, "x"), Event(T - 50, Kind.MODE, "before")]
    others = [Event(T + 20, Kind.MODE, "y"), Event(T + 30, Kind.LOST, "z")]
    bar = strip.strip(own, others, Span(T, T + 100), T + 50, DARK)
    assert bar.count('class="mark"') == 3 and "<img" not in bar and "before" not in bar
    assert DARK.event(Kind.ALERT) in bar and 'data-kind="lost"' in bar and 'x="500.0"' in bar
    flood = [Event(T + k / 100, Kind.ALERT, "x" * 200) for k in range(9_000)]
    assert len(strip.strip(flood, flood, Span(T, T + 100), None, DARK)) < 120_000
    assert strip.strip([], [], Span(T, T), None, DARK).count("<rect") < 9


def test_lengths_and_sizes_are_said_shortly() -> None:
    assert [strip.length(s) for s in (-3, 0, 133, 4_000)] == ["0:00", "0:00", "2:13", "1:06:40"]
    assert strip.size(3_421_000) == "3.4 MB" and strip.size(64_000) == "64 kB"
