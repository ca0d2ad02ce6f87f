"""The fleet as arrays, what of it is drawn, and the labels: level of detail without a browser."""

import copy

import numpy as np
import pytest

from fleet.bus.codec import encode, encoding
from fleet.contract import Array, Mission, Rows, Sample, Status
from fleet.frames import Origin
from tests.support.memory_bus import MemoryBus
from tests.support.pretend_feed import STAMP, Clock, PretendUav, T, feed_of
from viewer.scene.fleet_arrays import LARGE_FLEET, LOST, MISMATCH, READ_PARTS, TRAIL_AGES_S, FleetArrays, display_status
from viewer.scene.labels import MAX_LABELS, CameraView, Tag, overlap, visible_labels
from viewer.scene.selection.pins import BAND_SIGMA, sample_paths
from viewer.scene.selection.selected import active_seq
from viewer.server.app import Backfill
from viewer.store.forecast import LOOK_AHEADS_S, prediction_errors, rms_by_look_ahead
from viewer.store.inbox import MAX_QUEUED, MAX_UAVS, Inbox
from viewer.store.sample_layout import MIN_TOGETHER, SampleReader
from viewer.store.store import COALESCE_S, FleetStore
from viewer.text.missed_events import Absence, missed_events, missed_events_html
from viewer.theme.events import EventKind
from viewer.theme.palette import DARK
from viewer.theme.shapes import digit_strokes

SIGHT = CameraView(np.array([0.0, -100.0, 50.0]), np.zeros(3), np.radians(50), 1.6)


@pytest.fixture
def clock() -> Clock:
    return Clock()


def fixes(n: int, t: float, north: float = 0.0) -> list[Sample]:
    """Give one position of each of n UAVs, a hundred metres apart, all moved north by some 1e-7 degrees."""
    when = Array.of([t], "<f8")
    return [
        Sample(
            uav=uav,
            t=t,
            position=Rows(t=when, x=Array.of([[473_977_420 + north, 85_455_940 + 13_000 * uav, 488_000]], "<i4")),
        )
        for uav in range(n)
    ]


def crowd_of(clock: Clock, n: int) -> tuple[FleetStore, FleetArrays, MemoryBus]:
    bus = MemoryBus()
    feed, flock = FleetStore(bus, clock), FleetArrays()
    for message in fixes(n, T):
        bus.publish(message)
    flock.update_fleet(feed.all(), clock.now)
    flock.update_poses(feed, clock.now)
    return feed, flock, bus


# --- who is drawn, and how ---


def test_a_mismatch_and_an_alert_stand_out_and_a_lost_link_more(clock: Clock) -> None:
    feed, _, _ = feed_of(clock, 8)
    fleet = feed.all()
    assert display_status(fleet[2], clock.now) == display_status(fleet[6], clock.now) == MISMATCH
    clock.now += 60
    assert {display_status(one, clock.now) for one in feed.all()} == {LOST}


@pytest.mark.parametrize(("n", "points", "chunks"), [(20, 13, 5), (200, 7, 3), (LARGE_FLEET + 1, 4, 2)])
def test_trails_are_coarser_and_shorter_the_more_there_are(clock: Clock, n: int, points: int, chunks: int) -> None:
    _, flock, _ = crowd_of(clock, n)
    assert flock.chunk(0).shape == (n, points, 3) and flock.chunks == chunks
    sizes = set()
    for _ in range(25):
        flock.extend_trails({})
        sizes.add(flock.head().shape)
    assert len(sizes) == 1  # a head of fixed size, however far the chunk has come


def test_a_crowd_goes_on_between_two_looks_and_who_is_selected_is_looked_at(clock: Clock) -> None:
    feed, flock, bus = crowd_of(clock, LARGE_FLEET + 1)
    feed.inbox.full_rate_uavs = feed.immediate_uavs = frozenset({7})
    for step in (np.arange(1, 11) / READ_PARTS).tolist():
        clock.now += 1.0 / READ_PARTS
        for message in fixes(LARGE_FLEET + 1, T + step, 900 * step):
            bus.publish(message)
        flock.update_poses(feed, clock.now)
    one_second = flock.at[0, 1]
    assert one_second == pytest.approx(2.0, rel=0.01)  # 20 m north in two seconds, in tens of metres
    clock.now += 0.25
    bus.publish(fixes(LARGE_FLEET + 1, T + 2.25, 9_000)[7])
    flock.update_poses(feed, clock.now)
    assert flock.at[0, 1] - one_second == pytest.approx(0.25, rel=0.01)
    assert flock.at[7, 1] == pytest.approx(10.0, rel=0.01)


def test_a_leap_begins_a_new_trail(clock: Clock) -> None:
    feed, flock, bus = crowd_of(clock, 2)
    flock.extend_trails({})
    before = flock.revision
    clock.now += 1
    bus.publish(fixes(2, T + 1, 900_000)[1])
    flock.update_poses(feed, clock.now)
    flock.extend_trails({})
    assert (
        flock.revision > before
        and np.ptp(flock.trails[1], axis=0).max() == 0
        and len(flock.trails[1]) == len(TRAIL_AGES_S)
    )


# --- samples put aside ---


def test_in_a_crowd_the_newest_sample_and_news_of_the_mission_are_read() -> None:
    def leg(seq: float) -> bytes:
        return encode(Sample(uav=3, t=T, leg=Rows(t=Array.of([T], "<f8"), x=Array.of([[seq]]))))

    plain, box = encode(Sample(uav=3, t=T)), Inbox()
    box.large_fleet = True
    for payload in (plain, leg(1.0), plain, plain, leg(1.0), plain, leg(2.0), plain):
        box.put([(3, payload, "", None)], 0.0)
    assert [letter.payload for _, letter in box.take()] == [leg(1.0), leg(2.0), plain]
    box.full_rate_uavs = frozenset({3})
    for _ in range(4):
        box.put([(3, plain, "", None)], 0.0)
    assert len(list(box.take((3,)))) == 4 and list(box.take()) == []
    box.put([(None, b"\xc1", "", None)], 0.0)
    assert box.dropped == 1


@pytest.mark.parametrize("large_fleet", [False, True])
def test_samples_to_be_kept_and_uavs_are_limited(*, large_fleet: bool) -> None:
    box = Inbox()
    box.large_fleet, box.full_rate_uavs = large_fleet, frozenset({1})
    payloads = [encode(Sample(uav=1, t=T + k)) for k in range(MAX_QUEUED + 5)]
    box.put([(1, payload, "", None) for payload in payloads], 0.0)
    assert [message.payload for _, message in box.take((1,))] == [*payloads[: MAX_QUEUED - 1], payloads[-1]]
    box.put([(uav, payloads[0], "", None) for uav in range(MAX_UAVS + 3)], 1.0)
    assert box.dropped == 3 and len(box.take()) == MAX_UAVS
    box.full_rate_uavs = frozenset()
    box.put([(2, payloads[0], "", None)], 2.0)
    box.full_rate_uavs = frozenset({2})
    for k in (1, 2):
        box.put([(2, payloads[k], "", None)], 2.0 + k)
    assert [message.now for _, message in box.take((2,))] == [2.0, 3.0, 4.0]  # the one before is kept, too


def test_to_ask_for_the_past_of_some_of_a_crowd_nobody_is_read(clock: Clock) -> None:
    feed, _, bus = crowd_of(clock, LARGE_FLEET + 1)
    for message in fixes(LARGE_FLEET + 1, T + 1, 900):
        bus.publish(message)
    Backfill(bus, feed).request()
    assert len(feed.inbox.waiting_since(clock.now)) == LARGE_FLEET + 1


def test_who_has_waited_longest_is_named_first() -> None:
    box = Inbox()
    box.large_fleet = True
    for now, uav in ((0.0, 1), (0.5, 2), (0.6, 1), (1.0, 3)):
        box.put([(uav, encode(Sample(uav=uav, t=T)), "", None)], now)
    assert box.waiting_since(0.5) == [1, 2] and [letter.now for _, letter in box.take((1,))] == [0.6]
    box.put([(1, b"", "", None)], 2.0)
    assert box.waiting_since(2.0) == [2, 3, 1]


def test_in_a_crowd_what_comes_every_second_is_read_now_and_then_and_of_who_is_looked_at_at_once(clock: Clock) -> None:
    feed, _, bus = crowd_of(clock, LARGE_FLEET + 1)

    def mode(uav: int) -> str:
        return feed.get(uav).status.mode

    for k, uav in enumerate((5, 6, 7)):
        bus.publish(Status(uav=uav, t=T + 0.1 * k, mode="AUTO"))
    assert mode(5) == mode(6) == "AUTO"  # the first is read at once
    feed.immediate_uavs = frozenset({6})
    for name in ("RTL", "LAND"):
        clock.now += 0.5
        for uav in (5, 6):
            bus.publish(Status(uav=uav, t=T + clock.now, mode=name))
    feed.poll()
    assert (mode(5), mode(6)) == ("AUTO", "LAND")
    clock.now += COALESCE_S[Status]
    feed.poll()
    assert mode(5) == "LAND" and [e.text for e in feed.get(5).events if e.kind is EventKind.MODE] == ["AUTO", "LAND"]
    bus.publish(Status(uav=5, t=T + clock.now, mode="HOLD"))
    feed.immediate_uavs = frozenset({5})
    bus.publish(Status(uav=5, t=T + clock.now + 1, mode="STAB"))  # looked at: what waited is older
    clock.now += 2 * COALESCE_S[Status]
    feed.poll()
    assert mode(5) == "STAB"


def mixed_samples(uavs: int, k: int) -> list[tuple[int, bytes]]:
    """Return the id of the key and the payload of a sample of each UAV, most of one layout and some of no valid one."""
    r = np.random.default_rng(k)

    def rows(x: object, dtype: str = "<f4", n: int = 1) -> Rows:
        return Rows(t=Array.of(t - 0.1 * np.arange(n), "<f8"), x=Array.of(x, dtype))

    messages = []
    for uav in range(uavs):
        t, odd = T + k + 0.001 * uav, int(r.integers(60))
        place = np.array([473_977_420 + 100 * k + 7 * uav, 85_455_940 + 1_300 * uav, 488_000 + 10 * k])
        fields = {"attitude": rows(r.normal(size=(1, 6))), "air": rows([[15.0 + 0.1 * k, 0.5, 0.0]])}
        fields |= {"imu": rows(r.normal(size=(1, 6))), "position": rows(place[None], "<i4")}
        if r.integers(10) == 0:
            fields["leg"] = rows([[float(k // 3)]])
        odd_fields = {
            1: {"attitude": None},
            2: {"position": None},
            3: {"attitude": rows(np.full((1, 6), np.nan))},
            4: {"air": rows([[np.nan, 0.5, 0.0]])},
            5: {"position": rows([[0, 0, 0]], "<i4")},
            6: {"position": rows([[0, 0, 0]], "<i8")},
            7: {"position": rows(place[None] + [90_000_000, 0, 0], "<i4")},
            8: {"position": rows(place[None] + np.arange(3)[:, None], "<i4", n=3)},
            9: {"attitude": rows(r.normal(size=(4, 6)), n=4)},
            10: {"attitude": Rows(t=Array.of([t], "<f8"), x=Array("<f4", (1, 6), b"short"))},
            11: {"position": Rows(t=Array.of([np.nan], "<f8"), x=Array.of(place[None], "<i4"))},
            12: {"air": rows(np.zeros((0, 3)), n=0)},
            13: {"attitude": rows(r.normal(size=(1, 6)), "<f8")},
            14: {"attitude": rows(r.normal(size=6))},
        }
        times = {15: np.nan, 16: np.inf, 17: t - 100.0, 18: t - 1.0}
        payload = encode(Sample(uav=uav, t=times.get(odd, t), **{**fields, **odd_fields.get(odd, {})}))
        if odd == 19:
            payload = payload[:-1] + b"\xc1"
        if odd == 20:
            payload = payload.replace(b"attitude", b"attitudf")
        if odd == 21:
            payload = payload.replace(b"\xa3uav", b"\xa3uaw")
        messages.append((uav + (odd == 22), payload))
    return messages


def test_samples_read_together_change_the_same_as_samples_read_one_by_one(
    clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    n, feeds, together = LARGE_FLEET + 20, [], 0
    for least in (MIN_TOGETHER, n + 1):
        monkeypatch.setattr("viewer.store.sample_layout.MIN_TOGETHER", least)
        feed, _, bus = crowd_of(clock, n)
        bus.publish(Status(uav=2, t=T, mode="AUTO", armed=False))
        feed.inbox.full_rate_uavs = frozenset({4})
        for k in range(1, 12):
            for part in (k, k + 0.5):
                messages = [(uav, payload, encoding(Sample), None) for uav, payload in mixed_samples(n, int(2 * part))]
                feed._receiver(Sample)(messages[:: 1 if part == k else 7])
            queued = copy.deepcopy(feed.inbox).take()
            read, _ = SampleReader().read(queued, feed._vehicles, feed.scene_frame)
            together += len(read)
            feed.poses(tuple(feed.uavs))
        feeds.append(feed)
    feed, other = feeds
    assert together > 5 * n and feed.counts == other.counts and feed.counts["strange"] > 100
    for one, same in zip(feed.all(), other.all(), strict=True):
        for name in ("t", "attitude", "Va", "alt_m", "time", "sample_received", "floor", "events", "refusal"):
            assert repr(getattr(one, name)) == repr(getattr(same, name)), (one.uav, name)
        assert np.array_equal(one.at, same.at) and one.detector_state == same.detector_state
        assert np.array_equal(one.trail_rows(), same.trail_rows(), equal_nan=True)
        assert np.array_equal(one.track_rows(), same.track_rows())


def test_nobody_writes_in_the_name_of_another(clock: Clock) -> None:
    feed, _, _ = feed_of(clock, 2)
    at, hear = feed.get(0).at, feed._receiver
    for kind, message in ((Status, Status(uav=0, t=T, mode="X")), (Sample, fixes(1, T + 1, 9_000)[0])):
        hear(kind)([(1, encode(message), encoding(kind), None)])
    assert feed.get(0).status.mode != "X" and np.array_equal(feed.get(0).at, at) and feed.counts["strange"] == 2


def test_a_sample_of_another_kind_changes_nothing(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 1)
    at = feed.get(0).at
    bus.deliver(Sample, b"junk", "application/msgpack;parauav.sample.1")
    bus.deliver(Sample, b"junk", "application/msgpack;parauav.sample.9")
    assert feed.counts["strange"] == 1 and feed.inbox.dropped == 1 and np.array_equal(feed.get(0).at, at)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_places_that_are_not_finite_are_passed_over(clock: Clock, bad: float) -> None:
    feed, _, bus = feed_of(clock, 1)
    at, good = feed.get(0).at, [473_977_430.0, 85_455_940.0, 500_000.0]
    x = np.array([good, [bad, bad, bad], [good[0], bad, good[2]]])
    bus.publish(Sample(uav=0, t=T + 1, position=Rows(t=Array.of(T + np.arange(3.0), "<f8"), x=Array.of(x, "<f8"))))
    assert np.isfinite(feed.get(0).at).all() and not np.array_equal(feed.get(0).at, at)
    bus.publish(Sample(uav=0, t=T + 2, position=Rows(t=Array.of([T + 2], "<f8"), x=Array.of(x[1:2], "<f8"))))
    assert np.isfinite(feed.get(0).at).all()


def test_another_continent_is_refused_in_words_and_harms_nobody(clock: Clock) -> None:
    feed, flock, bus = crowd_of(clock, 3)
    far = Origin(-338_000_000, 1_512_000_000, 30_000)
    bus.publish(Sample(uav=9, t=T, position=Rows(t=Array.of([T], "<f8"), x=Array.of([tuple(far)], "<i4"))))
    bus.publish(Status(uav=9, t=T, mode="AUTO"))
    flock.update_fleet(feed.all(), clock.now)
    flock.update_poses(feed, clock.now)
    assert flock.uavs == (0, 1, 2) and np.isfinite(flock.at).all()
    assert "at most 100 km" in feed.get(9).refusal[1] and feed.get(9).status.mode == "AUTO"


# --- labels ---


def test_labels_are_few_in_the_picture_and_clear_of_each_other() -> None:
    near, far = np.zeros(3), np.array([0.0, -300.0, 80.0])  # behind the camera
    tags = [Tag("a", "first", near), Tag("b", "upon the first", near), Tag("c", "behind", far)]
    shown, boxes = visible_labels(tags, SIGHT)
    assert [tag.key for tag in shown] == ["a", "b"] and not overlap(*boxes)  # the second below the point
    many = [Tag(str(k), "x", np.array([6.0 * (k % 5), 12.0 * (k // 5), 0.0])) for k in range(20)]
    assert len(visible_labels(many, SIGHT)[0]) == MAX_LABELS
    assert visible_labels([], SIGHT) == ([], [])


def test_the_sight_projects_as_the_camera_does() -> None:
    ahead, right = np.array([0, 100.0, -50.0]) / np.hypot(100, 50), np.array([1.0, 0, 0])
    spots, depth = SIGHT.project(np.array([SIGHT.position + 10 * ahead + 2 * right, SIGHT.position - ahead]))
    assert spots[0] == pytest.approx([2 / (2 * np.tan(np.radians(25)) * 10), 0.0]) and depth[1] < 0


def test_figures_are_as_tall_as_asked_and_letters_without_one_are_space() -> None:
    lines = digit_strokes("0123456789 km.", 2.0)
    assert np.ptp(lines[..., 1]) == pytest.approx(2.0) and (lines[..., 2] == 0).all()
    assert digit_strokes("<script>", 2.0).shape == (0, 2, 3)


# --- paths, errors, items ---


def test_sample_paths_spread_as_the_band_says_and_do_not_flicker() -> None:
    path = np.stack([np.linspace(0, 100, 40), np.zeros(40), np.full(40, 10.0)], axis=-1)
    axes = np.tile([3.0, 2.1, 1.05], (40, 1))
    drawn = sample_paths(path, axes, 4000, 1)
    off = (drawn - path)[:, -1]
    assert off[:, 1].std() == pytest.approx(2.1 / BAND_SIGMA, rel=0.05)
    assert off[:, 2].std() == pytest.approx(1.05 / BAND_SIGMA, rel=0.05) and np.abs(off[:, 0]).max() == 0
    assert np.array_equal(drawn, sample_paths(path, axes, 4000, 1))


def test_errors_are_measured_where_they_can_be(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 1)
    one = PretendUav(0)
    one.drift = np.array([0.05, 0.0, 0.0])
    for k in range(1, 31):
        clock.now += 1
        bus.publish(one.sample(T + k - 1, T + k))
        bus.publish(one.prediction(T + k, 0.0), STAMP)
    made, off = prediction_errors(feed.past(feed.get(0)), feed.trail(feed.get(0)))
    assert len(made) == len(off) >= 29 and np.isnan(off[-1]).all()
    expected = 0.05 * LOOK_AHEADS_S**1.7
    assert rms_by_look_ahead(off)[9] == pytest.approx(expected[9], rel=0.05)
    assert np.isnan(prediction_errors([], feed.trail(feed.get(0)))[1]).all()


def test_the_newest_word_of_the_item_in_force_counts(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 1)
    assert active_seq(feed.get(0)) == 3
    bus.publish(Sample(uav=0, t=T + 1, leg=Rows(t=Array.of([T + 1], "<f8"), x=Array.of([[5.0]]))))
    assert active_seq(feed.get(0)) == 5
    bus.publish(Mission(uav=0, t=T + 2, items=(), seq=1))
    assert active_seq(feed.get(0)) == 5


# --- while one was away ---


def test_what_was_missed_is_what_happened_in_between(clock: Clock) -> None:
    feed, _, _ = feed_of(clock, 8, hostile=3)
    fleet = feed.all()
    told = missed_events(fleet, Absence(T - 10, T + 10))
    assert {v.uav for v, _ in told} >= {2, 6} and [e.t for _, e in told] == sorted((e.t for _, e in told), reverse=True)
    assert missed_events(fleet, Absence(T + 1, T + 60)) == [] and missed_events(fleet, Absence(T - 60, T - 50)) == []
    page = missed_events_html(fleet, Absence(T - 10, T + 10), DARK, "pick({})")
    assert "<img" not in page and "pick(2@" in page
    assert missed_events_html(fleet, None, DARK, "") == "" and "no events" in missed_events_html(
        [], Absence(T, T + 9), DARK, ""
    )
