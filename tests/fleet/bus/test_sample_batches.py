"""Samples of many aircraft travel in batches; what is received is what was published, aircraft by aircraft."""

import threading
from collections.abc import Iterator
from queue import SimpleQueue
from typing import Any

import msgspec
import pytest
from conftest import unused_port

from fleet.bus.bus_protocol import MAX_BATCH_BYTES, key_of, make_batches, split_batch
from fleet.bus.codec import EncodedMessage, Stamp, decode, encode, encoding
from fleet.bus.session import Bus, connect, open_router
from fleet.contract import Sample, Samples
from tests.support.examples import EXAMPLES

PATIENCE_S = 10.0
STAMP = Stamp(epoch=5, writer=99)


def encoded(uav: int, t: float = 1.0) -> EncodedMessage:
    sample = msgspec.structs.replace(EXAMPLES[Sample], uav=uav, t=t)
    return EncodedMessage(Sample, uav, encode(sample), t)


def split(payload: bytes) -> list[tuple[int | None, bytes]]:
    return [message[:2] for message in split_batch((None, payload, encoding(Samples), None))]


def test_batches_keep_every_sample_in_order_and_their_size() -> None:
    samples = [encoded(k % 40, 0.1 * k) for k in range(200)]
    batches = list(make_batches(samples))
    assert [pair for batch in batches for pair in split(batch)] == [(one.uav, one.payload) for one in samples]
    sizes = [sum(map(len, decode(Samples, batch).samples)) for batch in batches]
    size = len(samples[0].payload)
    assert max(sizes) <= MAX_BATCH_BYTES < min(sizes[:-1]) + 2 * size, "batches are as large as allowed"
    assert [decode(Samples, batch).t for batch in batches][-1] == samples[-1].t


def test_a_sample_above_the_size_is_a_batch_of_its_own() -> None:
    large = EncodedMessage(Sample, 2, bytes(MAX_BATCH_BYTES + 1), 0.0)
    found = [split(batch) for batch in make_batches([encoded(1), large, encoded(3)])]
    assert [[uav for uav, _ in batch] for batch in found] == [[1], [2], [3]]
    assert list(make_batches([])) == []


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xc1",
        encode(Samples(t=0.0, uavs=(1, 2), samples=(b"x",))),
        encode(Samples(t=0.0, uavs=(-1,), samples=(b"x",))),
        encode(Samples(t=0.0, uavs=(1_000_000_000,), samples=(b"x",))),
        encode(EXAMPLES[Samples])[:-1],
    ],
)
def test_a_batch_that_does_not_decode_is_passed_on_as_received(payload: bytes) -> None:
    message = (None, payload, encoding(Samples), STAMP)
    assert split_batch(message) == [message]


def test_a_batch_of_another_version_is_passed_on_as_received() -> None:
    message = (None, encode(EXAMPLES[Samples]), encoding(Samples)[:-1] + "9", None)
    assert split_batch(message) == [message]


@pytest.fixture
def buses() -> Iterator[tuple[Bus, Bus]]:
    at = f"tcp/127.0.0.1:{unused_port()}"
    with open_router(at), connect(at) as here, connect(at) as there:
        yield here, there


def received(channel: SimpleQueue, publish: Any, n: int) -> list[Any]:
    """Publish until the subscription is known to the publisher; return n messages from the first of a group on."""
    while channel.empty():
        publish()
        threading.Event().wait(0.05)
    return [channel.get(timeout=PATIENCE_S) for _ in range(n)]


def test_subscribers_receive_samples_of_accepted_aircraft_each_once(buses: tuple[Bus, Bus]) -> None:
    here, there = buses
    messages: SimpleQueue = SimpleQueue()
    raw: SimpleQueue = SimpleQueue()
    there.subscribe(Sample, lambda message, stamp: messages.put((message.uav, stamp)), accepts=lambda uav: uav != 2)
    there.subscribe_raw(Sample, lambda *message: raw.put(message))
    group = [encoded(uav) for uav in (1, 2, 3)]
    assert received(messages, lambda: here.put_all(group, STAMP), 2) == [(1, STAMP), (3, STAMP)]
    expected = [(one.payload, encoding(Sample), STAMP) for one in group]
    assert received(raw, lambda: here.put_all(group, STAMP), 3) == expected


def test_a_buffered_subscriber_receives_all_samples_or_the_newest_of_each_aircraft(buses: tuple[Bus, Bus]) -> None:
    here, there = buses
    messages: SimpleQueue = SimpleQueue()
    latest: tuple[type, ...] = ()

    def publish() -> None:
        here.put_all([encoded(1, 1.0), encoded(2, 2.0)])
        here.put_all([encoded(1, 3.0)])
        threading.Event().wait(0.05)
        there.dispatch(latest)

    there.subscribe_buffered(Sample, lambda batch: [messages.put(message) for message in batch])
    times = [decode(Sample, payload).t for _, payload, _, _ in received(messages, publish, 3)]
    assert times == [1.0, 2.0, 3.0]
    while not messages.empty():
        messages.get()
    latest = (Sample,)
    newest = dict(message[:2] for message in received(messages, publish, 2))
    assert {uav: decode(Sample, payload).t for uav, payload in newest.items()} == {1: 3.0, 2: 2.0}


def test_a_batch_with_a_sample_of_another_aircraft_costs_that_sample_alone(buses: tuple[Bus, Bus]) -> None:
    here, there = buses
    messages: SimpleQueue = SimpleQueue()
    there.subscribe(Sample, lambda message, _: messages.put(message.uav))
    key, name = key_of(Samples, "ab"), encoding(Samples)
    forged = Samples(t=0.0, uavs=(1, 2), samples=(encoded(9).payload, encoded(2).payload))
    assert received(messages, lambda: here._session.put(key, encode(forged), encoding=name), 1) == [2]
    rejected = there.bad
    here._session.put(key, b"\xc1", encoding=name)
    here.put_all([encoded(5)])
    while messages.get(timeout=PATIENCE_S) != 5:
        pass
    assert rejected >= 1 and there.bad == rejected + 1


def test_samples_are_also_published_under_the_key_of_each_aircraft(buses: tuple[Bus, Bus]) -> None:
    here, there = buses
    keys: SimpleQueue = SimpleQueue()
    subscriber = there._session.declare_subscriber("parauav/*/sample", lambda sample: keys.put(str(sample.key_expr)))
    group = [encoded(uav) for uav in (1, 2)]
    assert received(keys, lambda: here.put_all(group), 2) == ["parauav/1/sample", "parauav/2/sample"]
    subscriber.undeclare()
