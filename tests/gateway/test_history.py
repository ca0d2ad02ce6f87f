"""The last minute of an aircraft, for whoever joins late."""

import time

import msgpack
import numpy as np
import pytest

from fleet.bus.bus_protocol import key_of
from fleet.bus.codec import EncodedMessage, encode
from fleet.bus.session import connect
from fleet.contract import Array, History, Rows, Sample, Status
from gateway.publication import HistoryStore, Publisher
from tests.support.memory_bus import MemoryBus
from tests.support.talker import T0


def sample(uav, t, rows=3):
    stamps = t - 0.04 * np.arange(rows)[::-1]
    return Sample(uav=uav, t=t, attitude=Rows(Array.of(stamps, "<f8"), Array.of(np.full((rows, 6), 0.5))))


def told(keeper, uav, **settings):
    return [message for message, _ in keeper.answer(uav, {k: str(v) for k, v in settings.items()}, b"")]


def test_a_late_joiner_gets_what_was_published_in_order_and_no_more_than_was_asked_for():
    bus = MemoryBus()
    publisher = Publisher(bus)
    said = [sample(7, T0 + 0.1 * k) for k in range(1900)]
    for k, one in enumerate(said):
        publisher.publish([one, *([Status(uav=7, t=one.t, mode=f"m{k}")] if k % 10 == 0 else [])])
        publisher.publish([sample(8, T0 + 0.1 * k)])
    ((past, _),) = bus.get(History, 7)
    assert past.samples == tuple(said[-1601:]) and past.t == said[-1].t
    assert [status.mode for status in past.statuses] == [f"m{k}" for k in range(300, 1900, 10)]
    assert said[298].t <= past.since <= said[299].t
    (short,) = told(publisher.history, 7, seconds=5)
    assert len(short.samples) == 51 and short.since == pytest.approx(past.t - 5)
    assert bus.get(History, 9) == [] == bus.get(History)  # nobody's; and everybody's at once is refused
    with pytest.raises(ValueError, match="expected one id in the key"):
        publisher.history.answer(None, {}, b"")


def test_messages_packed_already_are_kept_too():
    publisher = Publisher(MemoryBus())
    publisher.put([EncodedMessage(Sample, 3, encode(sample(3, T0 + k)), T0 + k) for k in range(200)])
    (past,) = told(publisher.history, 3)
    assert len(past.samples) == 161 and past.t == T0 + 199


def test_memory_is_bounded_whatever_comes_and_what_is_left_out_is_said():
    keeper = HistoryStore(max_bytes=200_000)
    for k in range(2000):
        for uav in range(1 + k // 500):
            keeper.add([EncodedMessage(Sample, uav, bytes(500), T0 + 0.01 * k)])
            assert keeper.size <= 200_000
    assert keeper.size == 4 * 100 * 500
    (first, _), *_ = keeper.answer(0, {}, b"")
    assert first.since == pytest.approx(T0 + 20 - 101 * 0.01)


def test_a_silent_aircraft_gives_room_to_others():
    store = HistoryStore(max_bytes=200_000)
    store.add([EncodedMessage(Sample, 0, bytes(500), T0 + 0.01 * k) for k in range(390)])
    for uav in range(1, 5):
        store.add([EncodedMessage(Sample, uav, bytes(500), T0 + 0.01 * k) for k in range(80)])
        assert store.size <= 200_000
    (oldest, _), *_ = store.answer(0, {}, b"")
    assert len(oldest.samples) == 80 and oldest.since == pytest.approx(T0 + 3.09)


def test_one_aircraft_s_minute_is_there_within_50_ms(router):
    with connect(router) as bus, connect(router) as mine:
        publisher = Publisher(bus)
        for uav in range(20):
            publisher.publish(sample(uav, T0 + 0.1 * k, rows=10) for k in range(600))
        mine.get(History, 1)
        times = []
        for uav in range(20):
            begun = time.perf_counter()
            replies = list(mine._session.get(key_of(History, uav)))
            times.append(time.perf_counter() - begun)
            assert len(msgpack.unpackb(replies[0].ok.payload.to_bytes())["samples"]) == 600
        assert min(times) <= 0.05, f"{np.median(times) * 1e3:.1f} ms"
