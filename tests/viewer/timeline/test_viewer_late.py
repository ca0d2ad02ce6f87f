"""A page that opens late shows what was flown before, as a smooth path."""

import numpy as np
import pytest

from fleet.contract import History, Sample
from tests.support.memory_bus import MemoryBus
from tests.support.pretend_feed import Clock, PretendUav, T
from viewer.scene.labels import CameraView, Tag, visible_labels
from viewer.scene.strokes import smooth_curve
from viewer.server.app import SMALL_FLEET, Backfill
from viewer.store.store import FleetStore
from viewer.store.track import TRAIL_ROWS

BEFORE_S, HZ = 120.0, 10.0


def heard(uav: PretendUav, t: np.ndarray) -> list[Sample]:
    """Give the samples of one UAV at some times [s since 1970]."""
    return [uav.sample(at - 0.5 / HZ, at) for at in t.tolist()]


@pytest.fixture
def asked() -> list[int]:
    return []


def late(clock: Clock, asked: list[int], uavs: int, answers: int) -> tuple[FleetStore, Backfill]:
    """Hear one second of some UAVs, of whom a gateway remembers a few."""
    bus, fleet = MemoryBus(), [PretendUav(k) for k in range(uavs)]
    past = T + np.arange(-BEFORE_S, 0.0, 1 / HZ)

    def answer(uav: int | None, settings: dict[str, str], payload: bytes) -> list:
        asked.append(-1 if uav is None else uav)
        if uav is None or uav >= answers:
            return []
        return [(History(uav=uav, t=T, samples=tuple(heard(fleet[uav], past))), None)]

    bus.declare_queryable(History, answer)
    feed = FleetStore(bus, clock)
    for one in fleet:
        for sample in heard(one, T + np.array([0.0, 0.5])):
            bus.publish(sample)
    return feed, Backfill(bus, feed)


def test_what_was_flown_before_is_laid_before_what_was_heard(asked: list[int]) -> None:
    feed, bygone = late(Clock(), asked, 3, 2)
    feed.all()
    bygone.request()
    bygone.request()
    assert asked == [0, 1, 2]  # each once
    assert bygone.take_filled() == {0, 1} and not bygone.take_filled()
    for uav, since in ((0, BEFORE_S), (1, BEFORE_S), (2, 0.0)):
        rows, trail = feed.track(feed.vehicles[uav]), feed.trail(feed.vehicles[uav])
        assert rows[0, 0] == pytest.approx(T - since) and rows[-1, 0] == pytest.approx(T + 0.5)
        assert (np.diff(rows[:, 0]) > 0).all() and (np.diff(trail[:, 0]) > 0).all()
        assert len(trail) == (TRAIL_ROWS if since else 2)
    step = np.linalg.norm(np.diff(feed.track(feed.vehicles[0])[:, 1:], axis=0), axis=1)
    assert step.max() < 2 * np.median(step)  # no leap where the two are joined


def test_what_flies_on_is_added_after_it(asked: list[int]) -> None:
    feed, bygone = late(Clock(), asked, 1, 1)
    feed.all()
    bygone.request()
    vehicle = feed.vehicles[0]
    vehicle.trail.add((T + 1.0, 0.0, 0.0, 0.0, 20.0))
    rows = vehicle.trail_rows()
    assert len(rows) == TRAIL_ROWS and rows[-1, 0] == T + 1.0 and (np.diff(rows[:, 0]) > 0).all()


def test_of_a_crowd_only_those_are_asked_for_whom_somebody_looks_at(asked: list[int]) -> None:
    feed, bygone = late(Clock(), asked, SMALL_FLEET + 1, 0)
    feed.inbox.full_rate_uavs = frozenset((4,))
    feed.all()
    bygone.request()
    assert asked == [4]


def test_a_strange_past_is_left_out() -> None:
    bus, clock = MemoryBus(), Clock()
    good = heard(PretendUav(0), T + np.array([-2.0, -1.0]))
    strange = Sample(uav=0, t=float("nan"))
    bus.declare_queryable(History, lambda *_: [(History(uav=0, t=T, samples=(strange, *good)), None)])
    feed = FleetStore(bus, clock)
    bus.publish(heard(PretendUav(0), np.array([T]))[0])
    feed.all()
    Backfill(bus, feed).request()
    assert feed.track(feed.vehicles[0])[:, 0] == pytest.approx([T - 2, T - 1, T])


def test_a_rounded_path_goes_through_its_points_and_is_nearer_to_the_circle() -> None:
    turn = np.linspace(0, np.pi, 9)
    points = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=-1)
    curve = smooth_curve(points[None], 4)[0]
    assert curve.shape == (33, 3) and curve[::4] == pytest.approx(points)
    inner = np.abs(np.linalg.norm(curve, axis=1) - 1)[4:-4]
    assert inner.max() < 0.1 * (1 - np.cos(turn[1] / 2))
    assert smooth_curve(points[:1], 4).shape == (1, 3)


def test_words_at_the_right_edge_go_to_the_other_side() -> None:
    sight = CameraView(np.array([0.0, -100.0, 0.0]), np.zeros(3), np.radians(50), 1.0)
    edge = Tag("horizon", "horizon 62 s: error reaches 10 %", np.array([44.0, 0.0, 0.0]), "bottom-left")
    assert [one.anchor for one in visible_labels([edge], sight)[0]] == ["bottom-right"]
    middle = edge._replace(at=np.zeros(3))
    assert [one.anchor for one in visible_labels([middle], sight)[0]] == ["bottom-left"]
