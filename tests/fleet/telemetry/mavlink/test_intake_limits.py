"""What strangers make a gateway remember is bounded and forgotten; what rightful aircraft said is not."""

import queue
import socket
import threading

import numpy as np
import pytest

from fleet.bus.codec import EncodedMessage
from fleet.contract import Link, Params, Sample, Status
from fleet.telemetry.mavlink import intake as module
from fleet.telemetry.mavlink.intake import (
    EARLY_S,
    LINK_LOST_S,
    MAX_EARLY_TOTAL,
    NO_HEARTBEAT,
    PROBATION_S,
    SILENCE_LIMIT_S,
    MavlinkReceiver,
)
from fleet.telemetry.mavlink.parsing.received import ReceivedBytes
from gateway import pipeline as pump_module
from gateway.links import receive
from gateway.links.link import Batch, wall
from gateway.links.receive import MAX_DATAGRAMS, BatchReceiver
from gateway.pipeline import FLUSH_BYTES, Pipeline
from gateway.publication import Publisher
from tests.support.fake_link import FakeLink
from tests.support.memory_bus import MemoryBus
from tests.support.talker import ITEMS, T0, Talker, of


def fly(intake: MavlinkReceiver, talker: Talker, begin: float, seconds: float, source: str = "air") -> list:
    """Let one aircraft speak once a second; give what was handed over."""
    news = []
    for k in range(round(seconds) + 1):
        intake.receive(begin + k, talker.heartbeat() + talker.attitude(begin - T0 + 1.0 + k), source)
        news += intake.flush(begin + k)
    return news


def test_what_systems_say_before_a_heartbeat_has_a_common_limit_and_an_end(monkeypatch):
    monkeypatch.setattr(module, "MAX_EARLY_TOTAL", 100)
    intake = MavlinkReceiver()
    for system in range(1, 11):
        talker = Talker(system)
        intake.receive(T0, b"".join(talker.param(f"P{i}", i, i, 20) for i in range(20)))
    intake.flush(T0)
    assert sum(map(len, intake._early.values())) == 100 and intake.rejected[NO_HEARTBEAT] == 100
    intake.remove_silent(T0 + EARLY_S - 1)
    assert sum(map(len, intake._early.values())) == 100
    intake.remove_silent(T0 + EARLY_S + 1)
    assert not intake._early and intake.rejected[NO_HEARTBEAT] == 200
    rightful = Talker(200)  # there is room again for who says first what it has and then what it is
    params = b"".join(rightful.param(f"P{i}", i, i, 20) for i in range(20))
    intake.receive(T0 + 20, params)
    intake.flush(T0 + 20)
    intake.receive(T0 + 21, rightful.heartbeat())
    (told,) = of(Params, intake.flush(T0 + 21.5))
    assert told.complete and len(told.values) == 20
    assert MAX_EARLY_TOTAL >= module.MAX_EARLY  # one aircraft alone meets only its own limit


def test_a_ghost_is_forgotten_soon_and_gives_its_place_back():
    claims: dict = {}
    intake = MavlinkReceiver(id_owners=claims, max_uavs=3)
    ghosts = [Talker(system) for system in (1, 2, 3)]
    for ghost in ghosts:
        intake.receive(T0, ghost.heartbeat() + ghost.param("A", 1.0, 0, 1) + ghost.mission(ghost.item(0)), "foe")
    rightful = Talker(9)
    intake.receive(T0 + 1, rightful.heartbeat(), "air")
    intake.flush(T0 + 1)
    assert sorted(claims) == [1, 2, 3]  # three are the most
    assert intake.remove_silent(T0 + SILENCE_LIMIT_S) == []
    assert sorted(intake.remove_silent(T0 + SILENCE_LIMIT_S + 1)) == [1, 2, 3]
    assert not claims and not intake.aircraft
    news = fly(intake, rightful, T0 + SILENCE_LIMIT_S + 2, 3)
    assert sorted(claims) == [9] and {one.uav for one in news} == {9} and of(Sample, news)


def test_an_aircraft_that_was_known_stays_lost_until_its_place_is_needed():
    claims: dict = {}
    one, other = (MavlinkReceiver(offset=offset, id_owners=claims, max_uavs=1) for offset in (0, 1000))
    fly(one, Talker(7), T0, PROBATION_S + 5)
    silent = T0 + PROBATION_S + 5
    assert one.remove_silent(silent + 3600) == []
    (status,) = of(Status, one.flush(silent + 3600))
    assert status.link is Link.LOST
    other.receive(silent + LINK_LOST_S + 1, Talker(8).heartbeat())
    other.flush(silent + LINK_LOST_S + 1)
    assert sorted(claims) == [7]  # just lost: nobody takes its place
    assert other.rejected == {"more than 1 aircraft; raise --most-uavs": 1}
    other.receive(silent + SILENCE_LIMIT_S + 1, Talker(8).heartbeat())
    other.flush(silent + SILENCE_LIMIT_S + 1)
    assert sorted(claims) == [1008]
    assert one.remove_silent(silent + SILENCE_LIMIT_S + 2) == [7] and not one.aircraft
    assert other.remove_silent(silent + SILENCE_LIMIT_S + 2) == []


def test_who_comes_again_begins_anew_beside_others_in_their_order():
    intake, a, b = MavlinkReceiver(), Talker(1), Talker(2)
    intake.receive(T0, a.heartbeat() + a.param("OLD", 1.0, 0, 1), "air")
    fly(intake, b, T0, 40)
    assert intake.remove_silent(T0 + 40) == [1]
    again = T0 + 41
    news = fly(intake, Talker(1), again, 5, "elsewhere")
    assert {one.uav for one in news} == {1, 2} and not of(Params, news)
    mine = of(Sample, news, 1)
    assert len(mine) == 6 and all(abs(one.t - again - k) < 0.5 for k, one in enumerate(mine))
    (last,) = of(Status, news, 1)[-1:]
    assert last.received < 20 and last.missed == 0 and last.clock_jumps == 0
    news = fly(intake, b, again + 6, 2)
    assert len(of(Sample, news, 2)) == 3 and len(intake.arrays.clocks) == 2  # a system keeps its number
    assert intake.remove_silent(again + 8) == []


def test_ghosts_in_every_id_leave_nothing_behind():
    intake = MavlinkReceiver()
    for turn in range(3):
        t = T0 + turn * 100
        for system in range(1, 256):
            ghost = Talker(system)
            intake.receive(
                t, ghost.heartbeat() + ghost.count(len(ITEMS)) + ghost.param("A", 1.0, 0, 1), ("foe", system)
            )
        intake.flush(t + 1)
        assert len(intake.aircraft) == 255
        assert len(intake.remove_silent(t + 1 + SILENCE_LIMIT_S)) == 255
    assert not intake.aircraft and len(intake.arrays.clocks) == 255
    assert not any(craft.params.values or craft.mission.items for craft in intake._aircraft_by_number)


def test_the_bus_is_no_longer_told_of_who_was_forgotten(monkeypatch):
    bus, link = MemoryBus(), FakeLink()
    pump = Pipeline([link], bus)
    ghost, now = Talker(3), wall()
    pump.take(
        Batch(
            0,
            ReceivedBytes.from_pieces(
                [(now, "foe", ghost.heartbeat() + ghost.param("A", 1.0, 0, 1) + ghost.attitude(1.0))]
            ),
        )
    )
    pump._tick(0.0)
    pump._publish_statistics()
    publisher = pump.publisher
    assert (
        publisher.newest_account.uavs == (3,) and bus.get(Status, 3) and bus.get(Params, 3) and publisher.history.size
    )
    monkeypatch.setattr(pump_module, "wall", lambda: now + SILENCE_LIMIT_S + 1)
    pump._publish_statistics()
    assert publisher.newest_account.uavs == () and not bus.get(Status, 3) and not bus.get(Params, 3)
    assert publisher.history.size == 0 and not any(publisher._latest.values())


def test_what_is_remembered_of_others_stays():
    publisher = Publisher(MemoryBus())
    talkers = [Talker(1), Talker(2)]
    intake = MavlinkReceiver()
    for talker in talkers:
        intake.receive(T0, talker.heartbeat() + talker.param("A", 1.0, 0, 1) + talker.attitude(1.0))
    news = intake.flush_packed(T0 + 1)
    publisher.put([one for one in news if isinstance(one, EncodedMessage)])
    publisher.publish([one for one in news if not isinstance(one, EncodedMessage)])
    size = publisher.history.size
    publisher.remove([1])
    assert 0 < publisher.history.size < size
    assert [status.uav for status in publisher.snapshot()[1]] == [2]
    assert {uav for latest in publisher._latest.values() for uav, _ in latest} == {2}


def test_a_flood_is_worked_through_in_portions():
    pump = Pipeline([FakeLink()], MemoryBus())
    piece = ReceivedBytes.from_pieces([(wall(), "foe", bytes(64_000))])
    for _ in range(100):
        pump._queue.put(Batch(0, piece))
    pump._drain(float("inf"), threading.Event())
    assert FLUSH_BYTES <= pump._new_bytes < FLUSH_BYTES + 64_000 and pump._queue.qsize() > 60
    pump._tick(0.0)
    assert pump._new_bytes == 0
    with pytest.raises(queue.Full):
        for _ in range(1_000):
            pump._queue.put(Batch(0, piece), block=False)
    pump._queue.put(Batch(1, piece), block=False)  # another link has its own room


def test_memory_of_long_datagrams_goes_back_to_the_system():
    udp = socket.AF_INET, socket.SOCK_DGRAM
    with socket.socket(*udp) as near, socket.socket(*udp) as far:
        near.bind(("127.0.0.1", 0))
        bulk = BatchReceiver(near)
        data = np.random.default_rng(1).bytes(60_000)
        for _ in range(3):
            far.sendto(data, near.getsockname())
            heard = bulk.receive()
            assert heard.buf.tobytes() == data
            assert not bulk._slots.any()  # pages given back read as zeros
        far.sendto(b"short", near.getsockname())
        assert bulk.receive().buf.tobytes() == b"short"
    assert len(bulk._slots) == MAX_DATAGRAMS * 65_536 <= 16 << 20


def test_a_round_takes_all_that_has_come():
    udp = socket.AF_INET, socket.SOCK_DGRAM
    with socket.socket(*udp) as near, socket.socket(*udp) as far:
        receive._set_buffer(near)
        near.bind(("127.0.0.1", 0))
        far.bind(("127.0.0.1", 0))
        reader = BatchReceiver(near)
        assert receive.receive_round(reader) == (None, True)
        sent = [bytes([k % 251]) * 3 for k in range(MAX_DATAGRAMS)] + [b"last"]
        for data in sent:
            far.sendto(data, near.getsockname())
        received, is_empty = receive.receive_round(reader)
        assert received.senders == (far.getsockname(),)
    cut = [received.buf[start:stop].tobytes() for start, stop in zip(received.start, received.stop, strict=True)]
    assert cut == sent and is_empty


class Flood:
    """A receiver that always has more."""

    def receive(self) -> ReceivedBytes:
        return ReceivedBytes.from_pieces([(T0, "foe", bytes(1000))] * MAX_DATAGRAMS)


def test_a_round_ends_in_a_flood():
    received, is_empty = receive.receive_round(Flood())
    assert len(received.start) == 2 * MAX_DATAGRAMS and not is_empty
