"""What messages that cross, or one that is lost, leave half done in a worker's claims is put right at the next look."""

import flights as f
import pytest

import fleet
from fleet.contract import Claim, Handover, Status
from fleet.memory_bus import MemoryBus
from fleet.presence import Present
from twin_worker.worker import Worker

OTHER = Present("00000000000000aa", range(5), 1)


@pytest.fixture
def worker(monkeypatch: pytest.MonkeyPatch) -> Worker:
    """One that holds UAV 1 and looks at every turn."""
    monkeypatch.setattr("twin_worker.claims.protocol._MEND_S", 0.0)
    made = Worker(MemoryBus(), range(5), omega=0.0)
    made.listen()
    made.bus.publish(Status(uav=1, t=f.T0))
    assert held(made) == {1}
    return made


def held(worker: Worker) -> set[int]:
    return {one.twin.uav for one in worker.holding()}


def test_what_was_claimed_and_never_came_is_begun(worker: Worker) -> None:
    worker.claiming.claims.take(3, 1)
    worker.claiming.turn()
    assert held(worker) == {1, 3} and [uav for uav, _ in worker.claiming.claim().held] == [1, 3]


def test_what_was_expected_and_came_to_nothing_is_begun(worker: Worker) -> None:
    worker._twins.expect([2])
    worker.claiming.claims.take(2, 1)
    assert worker._twins.kept == {1: True, 2: False}
    worker.claiming.turn()
    assert worker._twins.kept == {1: True, 2: True}


def test_what_came_without_a_claim_is_let_go(worker: Worker) -> None:
    worker._twins.adopt(4, 9, None)
    worker._twins.recall([4])
    assert held(worker) == {1, 4}
    worker.claiming.turn()
    assert held(worker) == {1}


def test_one_that_announces_and_passes_for_dead_is_looked_for(worker: Worker) -> None:
    claims = worker.claiming.claims
    worker.bus.present(OTHER.token)
    worker.claiming._token(OTHER.token, False)  # the end of its last life, told late
    assert not claims.peers
    worker.claiming.turn()
    assert not claims.peers, "nothing was heard of it"
    worker.bus.publish(Claim(t=f.T0, worker=OTHER.worker, held=((2, 7),)))
    worker.claiming.turn()
    assert list(claims.peers) == [OTHER.worker]


def test_who_hands_over_many_is_waited_for_as_long_as_copies_come(
    worker: Worker, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, coming = [100.0], []
    monkeypatch.setattr("twin_worker.claims.protocol.time.monotonic", lambda: now[0])
    monkeypatch.setattr(worker.bus, "gather", lambda *_: iter(coming))
    claiming = worker.claiming
    claiming.tick()
    claiming.claims.synced(1)
    assert claiming._ask({OTHER.worker: [2, 3]}) == []
    now[0] += 2.9
    coming.append(Handover(t=f.T0, uav=2, epoch=5, code=fleet.SOURCES, load=b""))
    assert claiming._ask({OTHER.worker: [2, 3]}) == [] and 2 not in claiming.claims.held, "paused for too long itself"
    now[0] += 2.9
    coming.clear()
    assert claiming._ask({OTHER.worker: [3]}) == [], "one has come meanwhile"
    now[0] += 0.2
    assert claiming._ask({OTHER.worker: [3]}) == [3]
