"""What the viewer believes: epochs, restarts, late arrival, clocks that go back, strangers, wrong positions."""

import numpy as np
import pytest

from fleet.bus.codec import Stamp
from fleet.contract import Alert, AlertKind, Array, FleetRow, FleetState, Mission, Prediction, Rows, Sample, TwinState
from fleet.frames import Origin
from tests.support.memory_bus import MemoryBus
from tests.support.pretend_feed import HOME, STAMP, Clock, PretendFleet, PretendUav, T, feed_of, fields
from viewer.panels.detail import limitations
from viewer.store.place import UNIT_M
from viewer.store.store import WRITER_TIMEOUT_S, FleetStore
from viewer.store.vehicle import SILENT_S, UNCLAIMED_S
from viewer.theme.events import MAX_ALERTS


@pytest.fixture
def clock() -> Clock:
    return Clock()


def test_a_lower_epoch_is_dropped_until_the_higher_one_falls_silent(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 1)
    one = PretendUav(0)
    bus.publish(one.prediction(T + 1, 0.0), Stamp(5, 1))
    bus.publish(one.prediction(T + 2, 0.0), Stamp(4, 2))
    assert feed.vehicles[0].forecast.t == T + 1
    assert feed.counts["outdated"] == 1
    clock.now += WRITER_TIMEOUT_S + 1
    bus.publish(one.prediction(T + 3, 0.0), Stamp(4, 2))
    assert feed.vehicles[0].forecast.t == T + 3


def test_a_late_viewer_is_complete_after_asking(clock: Clock) -> None:
    bus = MemoryBus()
    fleet = PretendFleet(bus, 2)
    fleet.advance(T)
    feed = FleetStore(bus, clock)
    feed.request_latest()
    late = feed.vehicles[0]
    assert late.mission is not None and late.status is not None and late.model is not None and late.forecast is not None
    assert feed.vehicles[1].forecast is None  # still identifying: nobody claims a path


def test_strange_messages_are_counted_and_change_nothing(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 2)
    before = feed.vehicles[0].at.copy(), feed.vehicles[0].forecast
    good = PretendUav(0).prediction(T + 1, 0.0)
    nan, short = np.full(good.path.shape, np.nan), np.zeros((3, 3))
    strange = [
        Prediction(**{**fields(good), "path": Array.of(nan)}),
        Prediction(**{**fields(good), "path": Array.of(short)}),
        Prediction(**{**fields(good), "ahead": Array.of(np.zeros(good.ahead.shape))}),
        Prediction(**{**fields(good), "origin": (999_999_999_999, 0, 0)}),
        Prediction(**{**fields(good), "prediction_region_half_axes": Array("<f4", (9, 9), b"")}),
        Sample(uav=0, t=T + 1, position=Rows(t=Array.of([T], "<f8"), x=Array.of([[1.0, 2.0]]))),
        Sample(uav=0, t=float("nan")),
        Sample(uav=-4, t=T),
    ]
    for message in strange:
        bus.publish(message, STAMP)
    assert feed.counts["strange"] == len(strange)
    assert np.array_equal(feed.vehicles[0].at, before[0])
    assert feed.vehicles[0].forecast is before[1]


def test_no_fix_draws_nothing(clock: Clock) -> None:
    feed = FleetStore(bus := MemoryBus(), clock)
    bus.publish(Sample(uav=0, t=T, position=Rows(t=Array.of([T], "<f8"), x=Array.of([[0, 0, 0]], "<i8"))))
    assert feed.scene_frame is None and not feed.vehicles


def test_the_trail_is_bounded_and_starts_afresh_when_the_clock_goes_back(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 1)
    one = PretendUav(0)
    for k in range(30):
        bus.publish(one.sample(T + 10 * k, T + 10 * (k + 1)))
    trail = feed.trail(feed.vehicles[0])
    assert trail.shape == (900, 5) and np.isfinite(trail).all()
    bus.publish(one.sample(T, T + 0.5))
    assert len(feed.trail(feed.vehicles[0])) == 5


def test_without_samples_the_link_is_lost_and_the_ghost_moves_on(clock: Clock) -> None:
    feed, _, _ = feed_of(clock, 1)
    one = feed.vehicles[0]
    assert one.state(clock.now) is TwinState.PREDICTING
    clock.now += SILENT_S + 2
    assert one.state(clock.now) is TwinState.LINK_LOST
    expected = one.forecast.position_at(one.data_time(clock.now) - one.forecast.t)
    assert np.allclose(one.position(clock.now), expected)
    assert np.linalg.norm(one.position(clock.now) - one.at) * UNIT_M > 20
    clock.now += 1_000
    assert np.allclose(one.position(clock.now), one.forecast.path[-1])  # and no farther than was predicted


def test_an_alert_comes_and_goes(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 1)
    for active, n in ((True, 1), (False, 0)):
        bus.publish(Alert(uav=0, t=T, kind=AlertKind.GROUND, active=active, sentence="x"))
        assert len(feed.get(0).alerts) == n


def test_of_two_conflicts_one_may_end(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 1)
    for other, active in ((4, True), (5, True), (4, False)):
        bus.publish(Alert(uav=0, t=T, kind=AlertKind.CONFLICT, other=other, active=active, sentence=f"near {other}"))
    assert [alert.other for alert in feed.get(0).alerts.values()] == [5]
    for other in range(100):
        bus.publish(Alert(uav=0, t=T, kind=AlertKind.CONFLICT, other=other, sentence="x"))
    assert len(feed.get(0).alerts) == MAX_ALERTS


def test_a_worker_that_died_is_not_believed_for_ever(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 1)
    clock.now += UNCLAIMED_S + 1
    bus.publish(PretendUav(0).sample(T, T + 31))
    assert feed.all()[0].state(clock.now) is TwinState.UNCLAIMED
    assert "No worker result for this UAV for" in " ".join(limitations(feed.all()[0], clock.now))
    bus.publish(FleetState(t=T + 31, rows=(FleetRow(uav=0, state=TwinState.IDENTIFYING, verdict="", epoch=2),)))
    assert feed.all()[0].state(clock.now) is TwinState.IDENTIFYING


def test_what_is_being_drawn_does_not_change(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 1)
    drawn = feed.all()[0]
    bus.publish(Alert(uav=0, t=T, kind=AlertKind.GROUND, sentence="x"))
    bus.publish(PretendUav(0).sample(T - 1_000, T - 999))
    assert feed.vehicles[0].forecast is None
    assert drawn.forecast is not None and not drawn.alerts


def fix(uav: int, t: float, origin: Origin) -> Sample:
    return Sample(uav=uav, t=t, position=Rows(t=Array.of([t], "<f8"), x=Array.of([tuple(origin)], "<i4")))


def test_a_wrong_first_position_does_not_shut_the_others_out(clock: Clock) -> None:
    bus = MemoryBus()
    feed = FleetStore(bus, clock)
    wrong = Origin(0, 300_000_000, 0)
    bus.publish(fix(0, T, wrong))
    bus.publish(fix(1, T, HOME))
    assert feed.vehicles[1].at is None
    assert "expected at most 100 km" in " ".join(limitations(feed.vehicles[1], clock.now))
    bus.publish(fix(0, T + 1, HOME))  # the wrong one corrects itself: nobody else was drawn
    bus.publish(fix(1, T + 1, HOME))
    assert feed.scene_frame.origin == HOME and np.allclose([feed.vehicles[k].at for k in (0, 1)], 0)
    bus.publish(fix(2, T + 1, wrong))  # and now the stray one is the exception
    assert feed.scene_frame.origin == HOME and feed.vehicles[2].at is None
    clock.now += WRITER_TIMEOUT_S + 1
    bus.publish(fix(2, T + 12, wrong))  # the others have gone
    assert feed.scene_frame.origin == wrong and feed.vehicles[0].at is None


def test_an_answer_older_than_what_came_meanwhile_is_dropped(clock: Clock) -> None:
    bus = MemoryBus()
    feed, old, new = FleetStore(bus, clock), Mission(uav=0, t=T), Mission(uav=0, t=T + 600, seq=4)
    bus.declare_queryable(Mission, lambda *_: [(old, None)])
    bus.publish(new)
    feed.request_latest()
    assert feed.vehicles[0].mission == new


def test_look_aheads_seconds_apart_cut_no_corner(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 1)
    ahead = np.concatenate([np.arange(0.0, 61.0), np.arange(64.0, 181.0, 4.0)])
    circle = 80.0 * np.column_stack([np.cos(ahead / 5), np.sin(ahead / 5), 0 * ahead])
    made = {**fields(PretendUav(0).prediction(T + 1, 0.0)), "origin": tuple(HOME), "horizon_s": 180.0}
    made |= {
        "ahead": Array.of(ahead),
        "path": Array.of(circle),
        "prediction_region_half_axes": Array.of(0 * circle + 1.0),
    }
    bus.publish(Prediction(**made), STAMP)
    told = feed.vehicles[0].forecast
    from_start = told.position_at(np.arange(0.0, 180.5, 0.5)) - told.position_at(0.0)
    off = np.linalg.norm(from_start[:, :2] + [0.0, 8.0], axis=1)
    assert (
        told.horizon_s == 180.0 and np.abs(off - 8.0).max() < 0.3
    )  # a chord over 4 s lies 0.6 inside, in tens of metres
