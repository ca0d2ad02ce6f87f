"""Recordings on the page: data time, the flown path with its marks, the end, and what real flights tell."""

from pathlib import Path

import numpy as np
import pytest

from fleet.contract import Alert, AlertKind, GatewayCounters, Status, TwinState
from fleet.telemetry.onboard_logs.onboard_news import DEFAULT_EPOCH_S
from fleet.telemetry.recording.recordings import Recording
from tests.support.memory_bus import MemoryBus
from tests.support.pretend_feed import STAMP, Clock, PretendUav, T, feed_of
from viewer.panels.detail import figures_html, status_html
from viewer.scene.selection.pins import MAX_LABELS, MINOR_KINDS, event_text, labelled_events
from viewer.store import inbox as datatime
from viewer.store.inbox import DataTime, date_text, is_dated, rate_text, time_of_day, timestamp
from viewer.store.store import FleetStore
from viewer.store.track import POINTS, FlightTrack, positions_at
from viewer.store.vehicle import ENDED_S, SILENT_S
from viewer.text.words import severity, status_label, summary_html
from viewer.theme.events import EventKind, TimelineEvent
from viewer.theme.palette import DARK

REPLAY = "replay:flight.tlog?speed=4"
NAN = float("nan")


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.mark.parametrize(
    ("t", "short", "whole", "date"),
    [
        (T, "22:13:20", "2023-11-14 22:13:20 UTC", "2023-11-14 UTC"),
        (1_357_000_000.0, "00:26:40", "2013-01-01 00:26:40 UTC", "2013-01-01 UTC"),
        (DEFAULT_EPOCH_S + 125.7, "+2:05", "undated +2:05", "undated, since its start"),
        (72.0, "+1:12", "undated +1:12", "undated, since its start"),
        (NAN, "–", "undated –", "undated, since its start"),
        (1e300, "–", "undated –", "undated, since its start"),
    ],
)
def test_a_time_is_said_as_the_recording_has_it(t: float, short: str, whole: str, date: str) -> None:
    assert (time_of_day(t), timestamp(t), date_text(t)) == (short, whole, date)


def test_undated_means_what_the_reader_means() -> None:
    assert datatime.UNDATED_EPOCH_S == DEFAULT_EPOCH_S and not is_dated(DEFAULT_EPOCH_S) and is_dated(T)


# --- data time ---


@pytest.mark.parametrize("pace", [0.25, 1.0, 4.0, 150.0])
def test_data_time_runs_at_the_pace_of_the_recording(pace: float) -> None:
    data = DataTime()
    for k in range(101):
        data = data.update(T + 0.1 * k * pace, 50 + 0.1 * k)
    assert data.rate == pytest.approx(pace) and float(rate_text(data.rate)[:-1]) == pytest.approx(pace)
    assert data.estimate(60.5) == pytest.approx(T + 10.5 * pace, abs=1e-4)
    assert data.estimate(70.0) == pytest.approx(T + 11 * pace + 9, abs=1e-4)  # silent for long: as the wall clock


def test_before_the_first_sample_there_is_no_data_time(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 1)
    bus.publish(Status(uav=1, t=T, mode="AUTO"))
    one = feed.get(1)
    assert one.data_time(clock.now) == -np.inf and one.sample_age_s(clock.now) == np.inf
    assert "none yet" in figures_html(one, clock.now) and "undated –" in figures_html(one, clock.now)


def test_a_late_message_does_not_turn_data_time_back() -> None:
    data = DataTime().update(T, 50.0)
    assert data.update(T - 3, 51.0) == data and data.update(NAN, 51.0) == data


# --- on the path ---


def test_the_track_keeps_the_whole_flight_in_a_fixed_number_of_points() -> None:
    track, t = FlightTrack(), T + 0.1 * np.arange(60_000)
    enu = np.stack([np.cos(t / 40), np.sin(t / 40), t * 0 + 3], axis=-1) * 20
    for part in np.array_split(np.arange(len(t)), 500):
        assert not track.add([(float(at), *spot) for at, spot in zip(t[part], enu[part].tolist(), strict=True)])
    rows = track.rows()
    assert POINTS // 2 <= len(rows) <= POINTS
    assert rows[0, 0] == t[0] and t[-1] - rows[-1, 0] < 30
    assert np.linalg.norm(positions_at(rows, t[::100]) - enu[::100], axis=1)[:-10].max() < 2.0


def test_a_leap_among_the_first_positions_begins_the_path_anew() -> None:
    track = FlightTrack()
    track.add([(T, 0, 0, -45.0)])
    assert track.add([(T + 2.9, 0, 0, 0)]) and len(track.rows()) == 1
    assert not track.add([(T + 60.0, 0, 0, 90.0)])
    assert not track.add([(T + 61.0, 0, 0, -90.0)])  # later a leap is what was recorded
    assert len(track.rows()) == 3


def test_what_happened_off_the_flown_path_has_no_place() -> None:
    rows = np.array([[T, 0, 0, 0], [T + 10, 10, 0, 0]])
    spots = positions_at(rows, T + np.array([-60, -1, 4, 11, 300]))
    assert np.isnan(spots[[0, 4]]).all() and np.allclose(spots[1:4, 0], [0, 4, 10])
    assert np.isnan(positions_at(rows[:0], np.array([T]))).all()


def test_labels_are_few_and_apart() -> None:
    kinds = [
        EventKind.MODE,
        EventKind.ITEM,
        EventKind.WARNING,
        EventKind.UNVERIFIED,
        EventKind.LINK_LOST,
        EventKind.LINK_RESTORED,
        EventKind.MODE,
        EventKind.MODE,
    ]
    found = [(TimelineEvent(T + k, kind, "x"), np.array([10.0 * k, 0, 0])) for k, kind in enumerate(kinds)]
    chosen = labelled_events(found, np.array([70.0, 0, 0]), 8.0)
    assert [event.t - T for event, _ in chosen] == [6, 5, 4] and len(chosen) == MAX_LABELS
    assert [event.t - T for event, _ in labelled_events(found, None, 15.0)] == [7, 5, 2]
    assert not any(event.kind in MINOR_KINDS for event, _ in chosen)
    assert (
        event_text(TimelineEvent(T, EventKind.VERIFIED, "model verified: mean fit 88 %")) == "✓ model verified 22:13:20"
    )
    assert len(event_text(TimelineEvent(T, EventKind.MODE, "M" * 500))) < 45


# --- through the feed: a replayed recording ---


def test_a_recording_is_told_in_its_own_time_and_ends(clock: Clock) -> None:
    """Four times real time, with old dates; then the player falls silent, and the twin's coasting is not shown."""
    feed, _, bus = feed_of(clock, 1)
    one = PretendUav(0)
    for k in range(1, 41):
        clock.now += 0.25
        bus.publish(one.sample(T + k - 1, T + k))
        bus.publish(one.status(T + k))
        bus.publish(one.prediction(T + k, 0.0), STAMP)
        bus.publish(GatewayCounters(t=T + k, links=(REPLAY,), uavs=(0,)))
    vehicle = feed.get(0)
    assert vehicle.recorded and not vehicle.ended and vehicle.time.rate == pytest.approx(4.0)
    assert f"{timestamp(T + 40)}" in figures_html(vehicle, clock.now) and "played 4×" in summary_html(
        [vehicle], feed, DARK, clock.now
    )
    assert vehicle.sample_age_s(clock.now) == 0 and vehicle.sample_age_s(clock.now + 0.5) == pytest.approx(2.0)
    clock.now += ENDED_S + 0.5
    bus.publish(Alert(uav=0, t=T + 43, kind=AlertKind.LINK_LOST))
    bus.publish(one.prediction(T + 43, 3.0), STAMP)
    over = feed.get(0)
    assert over.ended and not over.alerts
    assert over.events[-1] == TimelineEvent(T + 40, EventKind.END, "end of the recording")
    assert all(event.kind is not EventKind.LINK_LOST for event in over.events)
    assert over.forecast.t == T + 40 and np.array_equal(over.position(clock.now), over.at)
    assert status_label(over, DARK, clock.now).text == "recording ended"
    assert "recording ended" in status_html(over, DARK, clock.now) and "link lost" not in status_html(
        over, DARK, clock.now
    )
    assert f"{timestamp(T + 40)} · ended" in summary_html([over], feed, DARK, clock.now).replace("</span>", "")
    bus.publish(one.sample(T + 40, T + 41))  # it was only a pause
    bus.publish(GatewayCounters(t=T + 41, links=(REPLAY,), uavs=(0,)))
    assert not feed.get(0).ended


def test_a_live_aircraft_that_falls_silent_is_lost_not_over(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 2)
    bus.publish(GatewayCounters(t=T, links=("udpin:0.0.0.0:14550",), uavs=(0, 1)))
    clock.now += SILENT_S + ENDED_S
    one = feed.get(0)
    assert not one.recorded and not one.ended and one.state(clock.now) is TwinState.LINK_LOST


def test_a_worker_that_has_fallen_behind_is_told_of(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 1)
    for k in range(1, 9):
        clock.now += 1.0
        bus.publish(PretendUav(0).sample(T + 10 * (k - 1), T + 10 * k))
    bus.publish(PretendUav(0).prediction(T + 40, 0.0), STAMP)  # ten times real time: 4 s behind
    assert "overloaded" not in status_html(feed.get(0), DARK, clock.now)
    bus.publish(PretendUav(0).sample(T + 80, T + 99))
    assert "59 s old: its worker is overloaded" in status_html(feed.get(0), DARK, clock.now)


def test_a_slow_recording_may_breathe(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 1)
    for k in range(1, 8):
        clock.now += 4.0
        bus.publish(PretendUav(0).sample(T + k - 1, T + k))
        bus.publish(PretendUav(0).prediction(T + k, 0.0), STAMP)
    assert feed.get(0).state(clock.now + 3.9) is TwinState.PREDICTING


def test_ended_recordings_stand_last(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 2)
    bus.publish(GatewayCounters(t=T, links=(REPLAY,), uavs=(0,)))
    clock.now += ENDED_S + 0.1
    bus.publish(PretendUav(1).sample(T, T + 3))
    assert sorted(feed.all(), key=lambda v: severity(v, clock.now))[-1].uav == 0


def test_a_recording_begun_anew_begins_its_events_anew(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 1)
    bus.publish(Status(uav=0, t=T + 1, mode="RTL"))
    assert [event.text for event in feed.get(0).events][-2:] == ["RTL", "disarmed"]
    bus.publish(PretendUav(0).sample(T - 1_000, T - 999))
    assert feed.get(0).events == () and len(feed.track(feed.get(0))) == 2


# --- real flights ---

FLIGHTS = {
    "sitl/s02_nominal_light_wind.tlog.xz": (3, "2025-11-20", ["MANUAL", "AUTO", "armed", "item 16: land", "disarmed"]),
    "sitl/s09_quadplane_nominal.tlog.xz": (9, "2025-11-21", ["AUTO", "armed", "item 6: VTOL landing", "disarmed"]),
    "real/alfa_20180718_155331_1_engine_failure.tlog": (1, "2018-07-18", ["GUIDED", "armed"]),
    "real/dronekit_copter_log171_crash.bin": (1, "2015-11-21", ["LOITER", "armed", "ACRO", "ERR subsystem 16"]),
}


@pytest.mark.parametrize("name", FLIGHTS, ids=lambda name: name.split("/")[1].split(".")[0])
def test_a_recorded_flight_tells_its_events_on_its_path(recordings: Path, clock: Clock, name: str) -> None:
    uav, date, expected = FLIGHTS[name]
    feed = FleetStore(bus := MemoryBus(), clock)
    for now, news in Recording(str(recordings / name), 0).steps():
        clock.now += 0.025
        for message in news:
            bus.publish(message)
        heard = uav in feed.vehicles and feed.vehicles[uav].t > 0
        assert not heard or abs(feed.vehicles[uav].data_time(clock.now) - now) < 4.0
    one = feed.get(uav)
    page = [event.text for event in one.events]
    found = [next((k for k, text in enumerate(page) if text.startswith(words)), -1) for words in expected]
    assert -1 not in found and len(page) == len({(e.t, e.text) for e in one.events}), page
    assert timestamp(one.data_time(clock.now)).startswith(date)
    assert one.sample_age_s(clock.now) < 10 and "link lost" not in page
    spots = positions_at(feed.track(one), np.array([event.t for event in one.events]))
    assert np.isfinite(spots[-1]).all() and np.isfinite(spots).mean() > 0.6  # before its first fix it was nowhere
    assert feed.counts["strange"] == 0
