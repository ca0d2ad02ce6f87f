"""The timeline: what is kept, what is shown again, what was predicted then against what happened."""

from unittest.mock import MagicMock

import numpy as np
import pytest

from fleet.contract import Alert, AlertKind, GatewayCounters, Status, TwinState
from tests.support.memory_bus import MemoryBus
from tests.support.pretend_feed import HOSTILE, Clock, PretendFleet, PretendUav, T, feed_of
from viewer.panels.detail import figures_html, status_html
from viewer.scene.fleet_arrays import FleetArrays
from viewer.store.forecast import ScenePrediction
from viewer.store.store import FleetStore
from viewer.store.vehicle import Vehicle
from viewer.text.words import summary_html, table
from viewer.theme.events import EventKind, TimelineEvent
from viewer.theme.palette import DARK
from viewer.timeline import past as compare
from viewer.timeline import strip
from viewer.timeline.deck import STEPS, TRANSPORT, Timeline
from viewer.timeline.past import PastVehicle
from viewer.timeline.recording import MAX_ROWS, PREDICTION_STEP_S, RETENTION_S, UavRecording
from viewer.timeline.recordings import Player, RecordingStore, TimelineRange


@pytest.fixture
def clock() -> Clock:
    return Clock()


def timeline(feed: FleetStore) -> Timeline:
    return Timeline(MagicMock(), feed, RecordingStore(), DARK, lambda: None)


def tape_of(one: Timeline) -> UavRecording:
    return one._recordings.by_uav[0]


def show(one: Timeline, feed: FleetStore, clock: Clock) -> FleetArrays:
    """Draw the page once: the fleet of now, or as it was."""
    live = FleetArrays()
    live.update_fleet(feed.all(), clock.now)
    return one.fleet_arrays(live, 0, clock.now)


def fly(one: Timeline, feed: FleetStore, fleet: PretendFleet, clock: Clock, until: float, *, step: float = 1.0) -> None:
    """Let the fleet fly until T + `until`, and keep it."""
    for t in np.arange(fleet._last + step, T + until + 1e-6, step):
        clock.now += step
        fleet.advance(float(t))
        one._recordings.record(feed, feed.all, clock.now)


# --- the player ---


def test_play_pause_and_live_again() -> None:
    player, span = Player(), TimelineRange(T, T + 100)
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
    player.advance(53.0, TimelineRange(T + 50, T + 101))  # the end has moved on, and is reached
    assert player.live


def test_what_is_no_longer_kept_is_skipped_and_from_live_one_plays_from_the_beginning() -> None:
    player = Player(T + 3, 0.0)
    player.advance(1.0, TimelineRange(T + 20, T + 100))
    assert player.t == T + 20
    player.go_live()
    player.play(1.0, TimelineRange(T + 20, T + 100))
    assert player.t == T + 20
    player.seek(T + 900, TimelineRange(T + 20, T + 100))
    assert player.t == T + 100


# --- the tape ---


def test_of_a_live_flight_ten_minutes_are_kept_in_memory_that_stays(clock: Clock) -> None:
    feed, fleet, _ = feed_of(clock, 1)
    one = timeline(feed)
    fly(one, feed, fleet, clock, 700.0)
    tape, before = tape_of(one), one._recordings.nbytes()
    assert tape.t[-1] - tape.t[0] >= RETENTION_S and len(tape.predictions) == pytest.approx(
        RETENTION_S / PREDICTION_STEP_S, abs=2
    )
    assert np.diff([told.t for told in tape.predictions]).min() >= PREDICTION_STEP_S
    fly(one, feed, fleet, clock, 1_900.0)
    assert one._recordings.nbytes() <= 1.35 * before < 350_000
    show(one, feed, clock)
    assert one._span.end - one._span.begin == pytest.approx(RETENTION_S)


def test_of_a_long_recording_all_is_kept_in_rows_that_are_fewer(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 1)
    bus.publish(GatewayCounters(t=T, links=("replay:x.tlog",), uavs=(0,)))
    tape, vehicle = UavRecording(), feed.get(0)
    assert vehicle.recorded
    for k in range(1, 3 * MAX_ROWS):
        vehicle.t = T + 0.2 * k
        tape.record(vehicle, np.zeros((0, 5)), clock.now)
    assert MAX_ROWS / 2 <= len(tape) <= 2 * MAX_ROWS and tape.t[0] <= T + 0.2 and T + 0.6 * MAX_ROWS - tape.t[-1] < 2


def test_a_fast_recording_is_filled_in_from_its_trail(clock: Clock) -> None:
    feed, fleet, _ = feed_of(clock, 1)
    one, uav = timeline(feed), PretendUav(0)
    fly(one, feed, fleet, clock, 60.0, step=20.0)
    tape = tape_of(one)
    assert np.diff(tape.t).max() < 1.5
    at = np.arange(T + 5, T + 55, 3.3)
    flown = np.array([tape.row_at(t)[:3] for t in at]) * 10
    ned = uav.ned(at)
    enu = ned[:, [1, 0, 2]] * [1, 1, -1]
    assert np.abs((flown - flown[0]) - (enu - enu[0])).max() < 2.0


def test_a_clock_that_goes_back_begins_another_tape(clock: Clock) -> None:
    feed, fleet, bus = feed_of(clock, 1)
    one = timeline(feed)
    fly(one, feed, fleet, clock, 30.0)
    bus.publish(PretendUav(0).sample(T - 1_000, T - 999))
    clock.now += 1
    one._recordings.record(feed, feed.all, clock.now)
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


def shown(one: Timeline, feed: FleetStore, clock: Clock, t: float) -> list:
    show(one, feed, clock)
    one.on_command(f"at:{T + t}")
    return show(one, feed, clock).fleet


def test_everyone_is_shown_where_and_how_they_were(flown) -> None:
    one, feed, clock = flown
    for t in (20.0, 55.0, 80.0):
        fleet = shown(one, feed, clock, t)
        assert len(fleet) == 5 and all(isinstance(past, PastVehicle) for past in fleet)
        past = fleet[0]
        uav = PretendUav(0)
        assert past.data_time(clock.now) == T + t and past.sample_age_s(clock.now) < 1.1
        ned = (uav.ned(T + t) - uav.ned(T + 10.0))[[1, 0]]
        back = (past.position(clock.now) - tape_of(one).row_at(T + 10.0)[:3])[:2] * 10
        assert np.allclose(back, ned, atol=1.0)
        assert past.status.mode == ("AUTO" if t < 50 else "RTL")
        assert [a.sentence for a in past.alerts.values()] == (["ground in 8 s"] if 50 < t < 60 else [])
        assert T + t - 2 * PREDICTION_STEP_S < past.forecast.t <= T + t + 0.5
        assert past.events and all(event.t <= T + t for event in past.events)
        assert fleet[1].state(clock.now) is TwinState.IDENTIFYING and fleet[1].forecast is None
        assert len(feed.trail(past)) > 10 and feed.trail(past)[-1, 0] == pytest.approx(T + t)
        assert feed.track(past)[-1, 0] == pytest.approx(T + t)


def test_the_page_can_say_all_of_a_past_fleet(flown) -> None:
    one, feed, clock = flown
    fleet = shown(one, feed, clock, 55.0)
    said = (
        status_html(fleet[0], DARK, clock.now)
        + figures_html(fleet[0], clock.now)
        + summary_html(fleet, feed, DARK, clock.now)
    )
    said += table(fleet, DARK, clock.now, total=5, pick="{}", selected=0)
    assert "ground in 8 s" in said and "RTL" in said and "paused" in said and "nan" not in said


def test_live_shows_the_fleet_itself_and_another_time_another_flock(flown) -> None:
    one, feed, clock = flown
    live = FleetArrays()
    live.update_fleet(feed.all(), clock.now)
    assert one.fleet_arrays(live, 0, clock.now) is live and type(one.vehicle(0)) is Vehicle
    one.on_command(f"at:{T + 40}")
    then = one.fleet_arrays(live, 0, clock.now)
    assert (
        then is not live and then.revision < 0 and isinstance(one.vehicle(0), PastVehicle) and one.vehicle(99) is None
    )
    i = then.index(0)
    assert np.allclose(then.at[i], tape_of(one).row_at(T + 40)[:3]) and np.isfinite(then.trails).all()
    assert np.allclose(then.trails[i, -11], tape_of(one).row_at(T + 30)[:3], atol=0.05)  # ten seconds before
    before = then.revision
    one.on_command(f"at:{T + 60}")
    assert one.fleet_arrays(live, 0, clock.now).revision < before  # trails are laid anew
    one.on_command("● Live")
    assert one.fleet_arrays(live, 0, clock.now) is live


def test_the_head_says_how_much_is_kept_and_what_it_takes(flown) -> None:
    one, feed, clock = flown
    shown(one, feed, clock, 70.0)
    said = one._head(one.player.t, one._span)
    assert "0:30 ago · paused · 1:40 of 5 aircraft recorded, " in said and " MB<" in said and "every 5 s" in said
    assert " UAVs" not in said  # the fleet's own words, which are looked for on the page


def test_two_pages_show_two_times(flown) -> None:
    one, feed, clock = flown
    other = Timeline(MagicMock(), feed, one._recordings, DARK, lambda: None)
    shown(one, feed, clock, 30.0)
    assert shown(other, feed, clock, 70.0)[0].shown_t == T + 70 and one.vehicle(0).shown_t == T + 30


def test_it_plays_on_by_the_wall_clock_and_becomes_live(flown) -> None:
    one, feed, clock = flown
    shown(one, feed, clock, 90.0)
    one.on_command("4×")
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
        one._recordings.record(feed, feed.all, clock.now)
    assert [past.uav for past in shown(one, feed, clock, 20.0)] == [0]
    assert [past.uav for past in shown(one, feed, clock, 38.0)] == [0, 4]


def test_recordings_of_different_days_are_laid_beside_each_other(clock: Clock) -> None:
    feed = FleetStore(bus := MemoryBus(), clock)
    one, uavs, later = timeline(feed), (PretendUav(0), PretendUav(2)), 9e6
    for k in range(1, 41):
        clock.now += 1
        for uav, shift in zip(uavs, (0.0, later), strict=True):
            bus.publish(uav.sample(T + shift + k - 1, T + shift + k))
        bus.publish(GatewayCounters(t=T, links=("replay:a", "replay:b"), uavs=(0, 2)))
        one._recordings.record(feed, feed.all, clock.now)
    fleet = shown(one, feed, clock, 20.0)
    assert fleet[0].shown_t == T + 20 and fleet[1].shown_t == pytest.approx(T + later + 20, abs=1.0)


# --- steps and presses ---


def test_steps_go_by_event_by_second_and_by_frame(flown) -> None:
    one, feed, clock = flown
    shown(one, feed, clock, 52.0)
    seen = {}
    for what in STEPS:
        shown(one, feed, clock, 52.0)
        one.on_command(what)
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
    one.on_command(f"share:{(T + 60.4 - begin) / (end - begin):.5f}")
    assert one.player.t == T + 60.0
    one.on_command(f"share:{(T + 70.0 - begin) / (end - begin):.5f}")
    assert one.player.t == pytest.approx(T + 70.0, abs=0.1)


@pytest.mark.parametrize(
    "what", ["", ":", "share:", "share:nan", "at:inf", "at:x", "x:1", HOSTILE, "9×", "▸", "at:" * 9]
)
def test_mischief_changes_nothing_that_matters(flown, what: str) -> None:
    one, feed, clock = flown
    show(one, feed, clock)
    one.on_command(what)
    assert one.player.t is None or T <= one.player.t <= T + 100
    timeline(feed).on_command(what)  # nobody was ever heard


def test_every_button_does_something(flown) -> None:
    one, feed, clock = flown
    for what in (*TRANSPORT, *STEPS):
        shown(one, feed, clock, 52.0)
        before = one.player.t, one.player.rate
        one.on_command("4×" if what == "Pause" else "Pause")
        one.on_command(what)
        assert (one.player.t, one.player.rate) != before or what == "Pause"


# --- then against since ---


def laid(told: ScenePrediction, path: np.ndarray) -> ScenePrediction:
    """Give the same prediction with another path."""
    other = ScenePrediction(told.message, told.scene_frame, told.received)
    vars(other).update(_refined_path=(told.ahead, path), tube=told.tube)
    return other


def test_a_prediction_that_came_true_is_held_and_one_that_did_not_is_not(flown) -> None:
    one, feed, clock = flown
    past = shown(one, feed, clock, 40.0)[0]
    path = past.recording.path(past.shown_t, past.shown_t + 60)
    told = past.forecast
    flown_path = np.stack([np.interp(told.ahead, path[:, 0] - told.t, path[:, k]) for k in (1, 2, 3)], -1)
    true = laid(told, flown_path)
    found = compare.lead_time_errors(true, path, past.shown_t)
    assert [one.ahead for one in found] == [s for s in compare.STEPS_S if past.shown_t + s <= told.t + told.horizon_s]
    assert len(found) >= 2 and all(one.inside and one.distance < 3.0 for one in found)
    wrong = laid(told, flown_path + np.array([0, 0, 50.0]))
    assert not any(one.inside for one in compare.lead_time_errors(wrong, path, past.shown_t))
    assert compare.lead_time_errors(wrong, path, past.shown_t)[0].distance == pytest.approx(500, abs=3)
    lines = compare.error_lines(wrong, path, past.shown_t)
    assert len(lines) >= 2 and np.allclose(lines[:, 0, 2] - lines[:, 1, 2], 50, atol=0.3)


def test_what_is_not_answered_yet_is_said_so(flown) -> None:
    one, feed, clock = flown
    past = shown(one, feed, clock, 98.0)[0]
    assert (
        compare.lead_time_errors(past.forecast, past.recording.path(past.shown_t, past.shown_t + 60), past.shown_t)
        == []
    )
    assert "not yet compared" in strip.comparison_html([], past.forecast.t, past.shown_t, DARK)
    assert "no prediction at this time" in strip.comparison_html([], None, past.shown_t, DARK)
    assert "horizon shorter than 5 s" in strip.comparison_html([], past.forecast.t, past.shown_t, DARK, 4.9)


# --- the bar ---


def test_the_bar_marks_events_in_their_colours_and_escapes_their_words() -> None:
    own = [
        TimelineEvent(T + 10, EventKind.MODE, HOSTILE),
        TimelineEvent(T + 50, EventKind.ALERT, "x"),
        TimelineEvent(T - 50, EventKind.MODE, "before"),
    ]
    others = [TimelineEvent(T + 20, EventKind.MODE, "y"), TimelineEvent(T + 30, EventKind.LINK_LOST, "z")]
    bar = strip.strip(own, others, TimelineRange(T, T + 100), T + 50, DARK)
    assert bar.count('class="mark"') == 3 and "<img" not in bar and "before" not in bar
    assert DARK.event(EventKind.ALERT) in bar and 'data-kind="link lost"' in bar and 'x="500.0"' in bar
    flood = [TimelineEvent(T + k / 100, EventKind.ALERT, "x" * 200) for k in range(9_000)]
    assert len(strip.strip(flood, flood, TimelineRange(T, T + 100), None, DARK)) < 120_000
    assert strip.strip([], [], TimelineRange(T, T), None, DARK).count("<rect") < 9


def test_lengths_and_sizes_are_said_shortly() -> None:
    assert [strip.duration_text(s) for s in (-3, 0, 133, 4_000)] == ["0:00", "0:00", "2:13", "1:06:40"]
    assert strip.size_text(3_421_000) == "3.4 MB" and strip.size_text(64_000) == "64 kB"
