"""What messages that cross, or one that is lost, leave half done in a worker's claims is put right at the next look."""

import threading
from collections import deque
from collections.abc import Callable, Iterator
from math import isfinite
from typing import Any, ClassVar

import msgspec
import pytest

import fleet
from fleet.bus.bus_protocol import WorkerToken
from fleet.bus.codec import encode
from fleet.contract import Claim, Handover, HandoverRequest, History, Message, Sample, Status
from tests.support import flights as f
from tests.support.memory_bus import MemoryBus
from twin_worker.ownership import protocol
from twin_worker.ownership.cold_start import query_history
from twin_worker.ownership.protocol import OwnershipProtocol
from twin_worker.ownership.twin_store import INBOX_SIZE
from twin_worker.service.worker import Worker

OTHER = WorkerToken("00000000000000aa", range(5), 1)


@pytest.fixture
def worker(monkeypatch: pytest.MonkeyPatch) -> Worker:
    """One that holds UAV 1 and looks at every turn."""
    monkeypatch.setattr("twin_worker.ownership.protocol._REPAIR_PERIOD_S", 0.0)
    made = Worker(MemoryBus(), range(5), omega=0.0)
    made.connect()
    made.bus.publish(Status(uav=1, t=f.T0))
    assert held(made) == {1}
    return made


def held(worker: Worker) -> set[int]:
    return {one.twin.config.uav for one in worker.owned_twins()}


def test_what_was_claimed_and_never_came_is_begun(worker: Worker) -> None:
    worker.ownership.state.acquire(3, 1)
    worker.ownership.step()
    assert held(worker) == {1, 3} and [uav for uav, _ in worker.ownership.claim().owned] == [1, 3]


def test_what_was_expected_and_came_to_nothing_is_begun(worker: Worker) -> None:
    worker._twins.expect([2])
    worker.ownership.state.acquire(2, 1)
    assert worker._twins.ready_by_uav == {1: True, 2: False}
    worker.ownership.step()
    assert worker._twins.ready_by_uav == {1: True, 2: True}


def test_what_came_without_a_claim_is_let_go(worker: Worker) -> None:
    worker._twins.acquire(4, 9, None)
    worker._twins.rehydrate([4])
    assert held(worker) == {1, 4}
    worker.ownership.step()
    assert held(worker) == {1}


def test_one_that_announces_and_passes_for_dead_is_looked_for(worker: Worker) -> None:
    claims = worker.ownership.state
    worker.bus.declare_liveliness(OTHER.token)
    worker.ownership._on_token(OTHER.token, False)  # the end of its last life, told late
    assert not claims.peers
    worker.ownership.step()
    assert not claims.peers, "nothing was heard of it"
    worker.bus.publish(Claim(t=f.T0, worker=OTHER.worker, owned=((2, 7),)))
    worker.ownership.step()
    assert list(claims.peers) == [OTHER.worker]


def test_who_hands_over_many_is_waited_for_as_long_as_copies_come(
    worker: Worker, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, coming = [100.0], []
    monkeypatch.setattr("twin_worker.ownership.protocol.time.monotonic", lambda: now[0])
    monkeypatch.setattr(worker.bus, "get_stream", lambda *_: iter(coming))
    claiming = worker.ownership
    claiming.tick()
    claiming.state.resynchronise(1)
    assert claiming._request_handovers({OTHER.worker: [2, 3]}) == []
    now[0] += 2.9
    coming.append(Handover(t=f.T0, uav=2, epoch=5, code=fleet.SOURCES, snapshot=b""))
    assert claiming._request_handovers({OTHER.worker: [2, 3]}) == [] and 2 not in claiming.state.owned, (
        "paused for too long itself"
    )
    now[0] += 2.9
    coming.clear()
    assert claiming._request_handovers({OTHER.worker: [3]}) == [], "one has come meanwhile"
    now[0] += 0.2
    assert claiming._request_handovers({OTHER.worker: [3]}) == [3]


def test_other_work_waits_while_aircraft_change_hands_but_not_for_long(
    worker: Worker, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr("twin_worker.ownership.protocol.time.monotonic", lambda: now[0])
    claiming, wanted = worker.ownership, msgspec.msgpack.encode(HandoverRequest(uavs=(1,)))
    worker.bus.publish(Sample(uav=1, t=f.T0))
    worker._owned[1].ready_since = float("-inf")
    worker.quota.limit = 1.0

    def free() -> bool:
        worker._sweep_order()
        assert worker.quota.rollouts_only == (worker._with_history() == [])
        return bool(worker._with_history())

    assert free()
    assert list(worker.bus.get_stream(Handover, "x", wanted, 1.0)) and not free(), "a copy is sent"
    assert worker.cpu_share.share < 1.0, "what has waited begins slowly"
    now[0] += 0.6
    assert free()
    claiming._accept_snapshot("b", [2], Handover(t=f.T0, uav=2, epoch=1, code="", snapshot=b""))
    assert not free(), "a copy has come"
    for _ in range(30):
        now[0] += 0.4
        list(worker.bus.get_stream(Handover, "x", wanted, 1.0))
    assert free(), "whoever asks on and on stops nothing"


@pytest.mark.parametrize("leaving", [False, True])
def test_who_stays_hands_over_slowly_and_who_leaves_does_not(
    worker: Worker, monkeypatch: pytest.MonkeyPatch, leaving: bool
) -> None:
    class Rest:
        taken: ClassVar[list[float]] = []

        def wait(self, seconds: float) -> None:
            self.taken.append(seconds)

    now, claiming, asked = [100.0], worker.ownership, []

    def get_stream(kind: type, who: object, payload: bytes, timeout_s: float) -> Iterator[Handover]:
        (uav,) = msgspec.msgpack.decode(payload, type=HandoverRequest).uavs
        now[0] += took[len(asked)]
        asked.append(uav)
        if uav != 3:  # that one is lost
            yield Handover(t=f.T0, uav=uav, epoch=1, code=fleet.SOURCES, snapshot=b"")

    took = [0.01, 1.4, 0.4]
    monkeypatch.setattr("twin_worker.ownership.protocol.time.monotonic", lambda: now[0])
    monkeypatch.setattr("twin_worker.ownership.protocol.threading.Event", Rest)
    monkeypatch.setattr(worker.bus, "get_stream", get_stream)
    monkeypatch.setattr(worker._twins, "acquire", lambda *_: None)
    claiming.threaded = True
    worker.bus.declare_liveliness(OTHER.token)
    claiming.state.on_claim(OTHER.worker, {}, leaving)
    for one in (2, 3, 4):
        now[0] += 0.01
        claiming.tick()
        claiming.state.resynchronise(1)
        claiming._fetch_snapshots(OTHER.worker, [one])
    expected = [] if leaving else [pytest.approx(4.0 * 0.01), protocol._MAX_REST_S]
    assert asked == [2, 3, 4] and Rest.taken == expected
    assert 2 * protocol._SNAPSHOT_TIMEOUT_S + protocol._MAX_REST_S < protocol._HANDOVER_TIMEOUT_S
    Rest.taken.clear()


# --- while threads of the bus are at work ----------------------------------------------------------------------------

BLOCKED_S = 0.5  # how long a thread that may be waiting for a lock is waited for [s]


def beside(act: Callable[[], object]) -> threading.Thread:
    """Do something on a thread of its own, and go on once it is done, or waits for what is locked here."""
    thread = threading.Thread(target=act, daemon=True)
    thread.start()
    thread.join(BLOCKED_S)
    return thread


class Inbox(deque[Message]):
    """One that another thread appends to while it is read, and again before it is cleared."""

    def __init__(self, *given: Any, hear: Callable[[], object], **named: Any) -> None:
        super().__init__(*given, **named)
        self.hear, self.threads = hear, list[threading.Thread]()

    def __iter__(self) -> Iterator[Message]:
        for message in super().__iter__():
            if not self.threads:
                self.threads.append(beside(self.hear))
            yield message

    def clear(self) -> None:
        self.threads.append(beside(self.hear))
        super().clear()


def test_what_the_bus_appends_while_a_twin_begins_is_taken_in(worker: Worker) -> None:
    """A twin comes while its telemetry does: nothing is lost, nothing raised, nothing taken in twice."""
    twins, coming = worker._twins, iter([Sample(uav=2, t=f.T0 + t) for t in (2.0, 3.0)])
    twins.expect([2])
    held = twins.by_uav[2]
    held.inbox = Inbox(hear=lambda: twins.enqueue(next(coming)), maxlen=INBOX_SIZE)
    for t in (0.0, 1.0):
        twins.enqueue(Sample(uav=2, t=f.T0 + t))
    twins._start(held, worker._create_twin(2), [Sample(uav=2, t=f.T0)])
    for thread in held.inbox.threads:
        thread.join()
    assert [message.t - f.T0 for message in held.inbox] == [0.0, 1.0, 2.0, 3.0]


def test_fallbacks_are_published_until_everything_is_handed_over(
    worker: Worker, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop, published, found = threading.Event(), threading.Event(), list[bool]()
    monkeypatch.setattr("twin_worker.service.worker.CHECK_PERIOD_S", 0.01)
    monkeypatch.setattr("twin_worker.service.worker.publish_fallbacks", lambda *_: published.set())
    monkeypatch.setattr(worker.ownership, "leave", lambda: found.append(published.wait(20.0)))
    stop.set()
    worker.run(stop)
    assert found == [True]


def test_two_that_are_asked_at_once_are_both_known_to_answer() -> None:
    """Each worker that sends copies is waited for longer; a note of one must not undo that of the other."""

    class Copies(MemoryBus):
        def get_stream(self, kind: type, who: object, *_: object) -> Iterator[Handover]:
            yield Handover(t=f.T0, uav=99, epoch=1, code="", snapshot=b"")

    class Noting(OwnershipProtocol):
        between: list[threading.Thread] | None = None

        @property
        def _requested(self) -> dict[int, float]:
            found = self._noted
            if self.between is not None and not self.between:
                self.between.append(threading.current_thread())
                self.between.append(beside(lambda: self._fetch_snapshots("b", [2])))
            return found

        @_requested.setter
        def _requested(self, noted: dict[int, float]) -> None:
            self._noted = noted

    bus = Copies()
    claiming = Noting(bus, range(5), Worker(bus, range(5), omega=0.0)._twins)
    claiming._requested = dict.fromkeys((1, 2), float("-inf"))
    claiming.between = []
    claiming._fetch_snapshots("a", [1])
    claiming.between[1].join()
    assert all(isfinite(since) for since in claiming._noted.values()), "both answer"


def test_copies_are_asked_for_one_by_one_and_the_past_again_where_it_was_lost() -> None:
    """What is large is dropped where nobody reads it: little is under way at a time, and a loss is asked for again."""

    class Lossy(MemoryBus):
        def __init__(self) -> None:
            super().__init__()
            self.asked: list[tuple[int, ...]] = []
            self.pasts = 0

        def get_stream(self, kind: type, who: object, payload: bytes, timeout_s: float) -> Iterator[Handover]:
            self.asked.append(msgspec.msgpack.decode(payload, type=HandoverRequest).uavs)
            return iter(())

        def get_payloads(self, *_: object) -> Iterator[bytes]:
            self.pasts += 1
            past = History(uav=3, t=f.T0, samples=tuple(m for m in f.messages(f.turn(1.0), uav=3)))
            return iter([encode(past)] if self.pasts == 2 else ())

    bus = Lossy()
    claiming = OwnershipProtocol(bus, range(5), Worker(bus, range(5), omega=0.0)._twins)
    claiming.state.acquire(2, 1)
    claiming._fetch_snapshots("a", [1, 2, 3])
    assert bus.asked == [(1,), (3,)], "what is held meanwhile is not asked for"
    (past,) = [said for said in query_history(bus, 3, {}) if isinstance(said, Sample)]
    assert bus.pasts == 2 and past.uav == 3
