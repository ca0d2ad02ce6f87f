"""Workers on one bus in memory, and on a real router: who takes over has window and model, and nobody is lost."""

import copy
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import ClassVar

import msgspec
import numpy as np
import pytest
from conftest import ROOT

from fleet.bus.codec import Stamp, encode
from fleet.bus.session import Bus, connect
from fleet.contract import (
    Claim,
    Handover,
    HandoverRequest,
    History,
    Message,
    Mission,
    Model,
    Prediction,
    Sample,
    Status,
)
from gateway.publication import Publisher
from tests.bench.asking.answerer import prediction
from tests.support import flights as f
from tests.support.memory_bus import MemoryBus
from twin_worker.ownership.cold_start import decode_history
from twin_worker.ownership.protocol import OwnershipProtocol
from twin_worker.service.worker import Worker
from twin_worker.twin.state.budget import Schedule

PATIENCE_S = 120.0  # an upper bound on a busy machine
OTHER = "00000000000000aa"


def wait(condition: Callable[[], object]) -> None:
    """Wait for a condition, at most as long as patience lasts."""
    never, waited = threading.Event(), 0.0
    while not condition():
        assert waited < PATIENCE_S, "waited in vain"
        never.wait(0.02)
        waited += 0.02


# --- in memory -------------------------------------------------------------------------------------------------------


@pytest.fixture
def bus() -> MemoryBus:
    return MemoryBus()


@pytest.fixture
def worker(bus: MemoryBus) -> Worker:
    made = Worker(bus, range(1, 5), omega=0.0)
    made.connect()
    return made


def handed(bus: MemoryBus, *uavs: int) -> list[Handover]:
    """Ask as another worker would."""
    return list(bus.get_stream(Handover, "x", msgspec.msgpack.encode(HandoverRequest(uavs=uavs)), 1.0))


def test_a_copy_goes_on_elsewhere_and_is_written_for_here_until_a_higher_claim_is_heard(
    bus: MemoryBus, worker: Worker
) -> None:
    for uav in (1, 2, 3):
        for message in f.messages(f.turn(4.0), uav=uav):
            bus.publish(message)
    worker.sweep()
    bus.publish(f.messages(f.turn(5.0), uav=2)[-1])  # waits in its inbox
    epoch = {held.twin.config.uav: held.epoch for held in worker.owned_twins()}[2]
    (twin,) = handed(bus, 2, 9)
    assert (twin.uav, twin.epoch) == (2, epoch) and len(twin.snapshot) > 10_000
    assert len(worker.owned_twins()) == 3 and handed(bus, 2) and list(bus.get_stream(Handover, "x", b"", 1.0)) == []

    taker = Worker(MemoryBus(), range(1, 5), omega=0.0)
    taker._twins.acquire(2, epoch + 1, twin)
    (held,) = taker.owned_twins()
    assert held.epoch == epoch + 1 and len(held.inbox) == 1 and not taker._twins.without_history
    assert taker._twins.not_publishing == {2}, "it is not claimed aloud before it is written for"
    assert held.twin.telemetry.history.newest == pytest.approx(f.T0 + 4.0, abs=0.2)
    assert taker.sweep() == 1 and held.twin.telemetry.history.newest == pytest.approx(f.T0 + 5.0, abs=0.2)
    bus.publish(Claim(t=0.0, worker=OTHER, owned=((2, epoch + 1),)))
    assert [held.twin.config.uav for held in worker.owned_twins()] == [1, 3]


def test_a_copy_that_was_long_on_its_way_says_nothing_older_than_what_was_said_meanwhile(
    bus: MemoryBus, worker: Worker
) -> None:
    for message in f.messages(f.turn(4.0), uav=2):
        bus.publish(message)
    worker.sweep()
    (twin,) = handed(bus, 2)
    late = f.messages(f.turn(9.0), uav=2)
    for message in late:
        bus.publish(message)
    worker.sweep()
    (said,) = [made for made, _ in bus.get(Prediction, 2)]

    away = MemoryBus()
    taker, told = Worker(away, range(1, 5), omega=0.0), []
    away.subscribe(Prediction, lambda made, _: told.append(made.t))
    assert taker._twins.cache_result(said, Stamp(twin.epoch, 7))
    taker._twins.acquire(2, twin.epoch + 1, twin)
    for message in (m for m in late if m.t > f.T0 + 4.0):
        taker._on_message(message)
        taker.sweep()
    assert not told
    for message in (m for m in f.messages(f.turn(12.0), uav=2) if m.t > said.t):
        taker._on_message(message)
        taker.sweep()
    assert told and min(told) > said.t


ODD = ({"code": "another"}, {"snapshot": b""}, {"snapshot": b"\xc1"}, {"snapshot": msgspec.msgpack.encode([1])})


@pytest.mark.parametrize("odd", ODD)
def test_a_twin_that_cannot_be_read_is_taken_over_cold(bus: MemoryBus, worker: Worker, odd: dict) -> None:
    for message in f.messages(f.turn(2.0), uav=2):
        bus.publish(message)
    worker.sweep()
    (twin,) = handed(bus, 2)
    taker = Worker(MemoryBus(), range(1, 5), omega=0.0)
    taker._twins.expect([2])
    taker._twins.acquire(2, 5, msgspec.structs.replace(twin, **odd))
    (held,) = taker.owned_twins()
    assert held.epoch == 5 and held.twin.config.uav == 2 and held.twin.telemetry.history.newest == -float("inf")


def test_what_is_not_here_yet_or_just_being_worked_on_is_not_copied(bus: MemoryBus, worker: Worker) -> None:
    for message in f.messages(f.turn(2.0), uav=2):
        bus.publish(message)
    worker._twins.expect([4])
    worker.ownership.state.acquire(4, 5)
    assert handed(bus, 4) == []
    (held,) = worker.owned_twins()
    with held.lock:
        assert handed(bus, 2) == []
    assert len(handed(bus, 2)) == 1


def test_while_a_twin_is_worked_on_its_last_path_is_renewed(bus: MemoryBus, flown: tuple, heard: tuple) -> None:
    """A thread that learns may hold a twin for seconds on a busy machine: nobody waits for the next prediction."""
    worker = Worker(bus, range(1, 5), omega=0.0, schedule=Schedule(predict=5.0, renew=0.1))
    worker.connect()
    for message in heard[-400:]:
        bus.publish(message)
    (held,) = worker.owned_twins()
    held.twin, told = copy.deepcopy(flown[0]), []
    held.twin.config = msgspec.structs.replace(held.twin.config, schedule=worker.schedule)
    held.twin.prediction.last_rollout = held.twin.prediction.latest
    held.inbox.clear()
    bus.subscribe(Prediction, lambda made, _: told.append(made))
    rows = f.shifted([m for m in heard if isinstance(m, Sample) and m.position][-20:], 2.0, 1e9)
    with held.lock:
        for message in rows:
            bus.publish(message)
            worker.sweep()
    times = [made.t for made in told]
    assert len(times) > 3 and times == sorted(set(times)) and len(held.inbox) == len(rows)
    worker.sweep()
    assert not held.inbox and all(made.t > times[-1] for made in told[len(times) :])


def test_a_first_prediction_is_what_ends_the_quiet(bus: MemoryBus, worker: Worker) -> None:
    """Who took a copy is heard of once it writes; until then the other is believed to hold it."""
    taker = Worker(bus, range(1, 5), omega=0.0)
    assert taker._twins.cache_result(prediction(2), Stamp(5, 7))
    taker._twins.expect([2])
    taker.ownership.state.acquire(2, 9)
    assert taker.ownership.claim().owned == ()
    (held,) = taker._twins.by_uav.values()
    taker._twins._start(held, taker._create_twin(2), [])
    taker.ownership.state.unsynchronised = False
    assert taker.ownership.claim().owned == ()
    taker.publish(prediction(2), held)
    assert taker.ownership.claim().owned == ((2, 9),)


def test_a_higher_claim_is_yielded_to_at_once(bus: MemoryBus, worker: Worker) -> None:
    for message in f.messages(f.turn(2.0), uav=2):
        bus.publish(message)
    (held,) = worker.owned_twins()
    bus.publish(Claim(t=0.0, worker=OTHER, owned=((2, held.epoch - 1),)))
    assert worker.owned_twins() == [held]
    bus.publish(Claim(t=0.0, worker=OTHER, owned=((2, held.epoch + 1), (3, -5), (4, 1 << 63))))
    assert worker.owned_twins() == []


def test_a_cold_takeover_has_telemetry_mission_and_model(bus: MemoryBus, heard: tuple, flown: tuple) -> None:
    """A worker comes when a gateway has been there for long, and another worker has just died."""
    twin, said = flown
    publisher = Publisher(bus)
    publisher.publish(heard)
    worker = Worker(bus, range(1, 5), omega=0.0)
    worker.ownership.state.on_claim(OTHER, {1: 7})
    for kind in (Model, Prediction):
        last = [m for m in said if isinstance(m, kind)][-1]
        worker._twins.cache_result(last, Stamp(7, int(OTHER, 16)))
    worker.connect()
    (held,) = worker.owned_twins()
    mine = held.twin
    assert mine.onboard.mission and mine.onboard.status and mine.received_params == twin.received_params
    assert mine.telemetry.history.newest - mine.telemetry.history.rows("attitude")[0][0] > 90.0
    assert mine.models.active_verdict is not None and mine.models.active_verdict.fit == twin.models.active_verdict.fit
    told: list[Prediction] = []
    bus.subscribe(Prediction, lambda made, _: told.append(made))
    bus.publish(f.shifted([m for m in heard if isinstance(m, Sample)][-12:], 0.5, 1e9)[-1])
    worker.sweep()
    assert told and told[0].method in f.ROUTE


def test_what_was_foreseen_is_renewed_until_the_turn_to_fly_comes(bus: MemoryBus, heard: tuple, flown: tuple) -> None:
    """Of many taken over at once each flies ahead in its turn; that it hears of mission and parameters is no news."""
    Publisher(bus).publish(heard)
    worker = Worker(bus, range(1, 5), omega=0.0, schedule=Schedule(predict=5.0, renew=0.1))
    for kind in (Model, Prediction):
        worker._twins.cache_result([m for m in flown[1] if isinstance(m, kind)][-1], Stamp(7, int(OTHER, 16)))
    worker._twins.acquire(1, 9, None)
    twin = worker._twins._continue_prediction(1)
    assert twin is not None and worker._twins.without_history == (1,)
    worker._twins._rehydrate_one(1, twin, 0.8)
    assert twin.onboard.mission is not None and worker._twins.without_history == ()
    told: list[Prediction] = []
    bus.subscribe(Prediction, lambda made, _: told.append(made))
    worker.ownership.state.unsynchronised = False
    for message in f.shifted([m for m in heard if isinstance(m, Sample) and m.position][-12:], 1.2, 1e9):
        worker._on_message(message)
        worker.sweep()
    assert len(told) > 2 and all(made.sentence.endswith("continued from another worker") for made in told)


def test_many_messages_are_one_and_what_does_not_fit_is_left_out(heard: tuple[Message, ...]) -> None:
    samples = tuple(m for m in heard if isinstance(m, Sample))[:200]
    statuses = tuple(m for m in heard if isinstance(m, Status))
    told = encode(History(uav=1, t=samples[-1].t, samples=samples, statuses=statuses))
    whole = decode_history(told)
    assert whole is not None and (whole.uav, whole.t) == (1, samples[-1].t)
    one, many = f.remembered([whole]), f.remembered(samples)
    for name in f.HZ:
        assert all((a == b).all() for a, b in zip(one.rows(name), many.rows(name), strict=True)), name
    rows = samples[0].attitude
    odd = [msgspec.structs.replace(rows, x=msgspec.structs.replace(rows.x, **bad))
           for bad in ({"shape": (1, 2)}, {"data": b""}, {"dtype": "|O8"}, {"dtype": "no"})]  # fmt: skip
    broken = [Sample(uav=1, t=0.0, attitude=each) for each in odd]
    assert decode_history(encode(History(uav=1, t=whole.t, samples=(*broken, *samples)))) == whole
    assert decode_history(encode(History(uav=1, t=whole.t, samples=tuple(broken)))) is None


@pytest.mark.parametrize(
    "data", [b"", b"\x80", b"\xc1", b"\xdf\xff\xff\xff\xff", b"\x81\xa7samples\xdd\xff\xff\xff\xff"]
)
def test_what_is_no_past_is_none(data: bytes) -> None:
    assert decode_history(data) is None


def test_a_damaged_past_is_none_or_what_is_left_of_it(heard: tuple[Message, ...]) -> None:
    samples = tuple(m for m in heard if isinstance(m, Sample))[:20]
    told = encode(History(uav=1, t=samples[-1].t, samples=samples))
    whole, rng = decode_history(told), np.random.default_rng(4)
    assert whole is not None and whole.attitude is not None
    for _ in range(300):
        hurt = bytearray(told[: int(rng.integers(1, len(told) + 1))])
        for at in rng.integers(len(hurt), size=3):
            hurt[at] = rng.integers(256)
        found = decode_history(bytes(hurt))
        for name in f.HZ:
            rows, most = (getattr(found, name), getattr(whole, name)) if found is not None else (None, None)
            assert rows is None or most is None or rows.t.shape[0] <= most.t.shape[0]


# --- on a router -----------------------------------------------------------------------------------------------------


@pytest.fixture
def site(router: str) -> Iterator[Callable[[int], Worker]]:
    """Starts workers on one router; each turns by itself, and leaves politely when its event is set."""
    with ExitStack() as stack:

        def start(name: int) -> Worker:
            bus = stack.enter_context(connect(router))
            bus.writer = name  # so that each owns some
            worker = Worker(bus, range(6), omega=0.0)
            stop = threading.Event()
            thread = threading.Thread(target=worker.run, args=(stop,))
            thread.start()
            stack.callback(thread.join)
            stack.callback(stop.set)
            worker.leave = lambda: (stop.set(), thread.join())  # type: ignore[attr-defined]
            return worker

        yield start


def held(worker: Worker) -> set[int]:
    return {one.twin.config.uav for one in worker.owned_twins()}


def test_two_share_a_third_joins_one_leaves_and_nothing_is_forgotten(
    site: Callable[[int], Worker], router: str
) -> None:
    with connect(router) as gateway:
        publisher = Publisher(gateway)
        one, two = site(1), site(2)
        for uav in range(6):
            publisher.publish([Status(uav=uav, t=f.T0), Mission(uav=uav, t=f.T0, items=(f.item(0),))])
            publisher.publish(f.messages(f.turn(3.0), uav=uav))
        wait(lambda: held(one) | held(two) == set(range(6)) and not held(one) & held(two))
        wait(lambda: all(h.twin.telemetry.history.newest > f.T0 + 2.5 for w in (one, two) for h in w.owned_twins()))
        epochs = {h.twin.config.uav: h.epoch for w in (one, two) for h in w.owned_twins()}
        three = site(3)
        wait(lambda: held(three) and held(one) | held(two) | held(three) == set(range(6)))
        moved = {h.twin.config.uav: h for h in three.owned_twins()}
        assert all(h.epoch > epochs[uav] for uav, h in moved.items())
        assert all(
            h.twin.telemetry.history.newest > f.T0 + 2.5 and h.twin.onboard.mission is not None for h in moved.values()
        )
        one.leave()  # type: ignore[attr-defined]
        wait(lambda: held(two) | held(three) == set(range(6)))
        assert not held(one)


def test_all_that_are_taken_over_write_before_the_past_of_any_has_come() -> None:
    class Asked(MemoryBus):
        seen: ClassVar[list[set[tuple[bool, bool]]]] = []

        def get_payloads(self, kind: type, *_: object) -> Iterator:
            self.seen.append({(held.ready, held.without_history) for held in worker._owned.values()})
            return iter(())

    worker = Worker(Asked(), range(5), omega=0.0)
    for uav in (1, 2, 3):
        assert worker._twins.cache_result(prediction(uav), Stamp(5, 7))
        worker._twins.acquire(uav, 9, None)
    assert worker._twins.without_history == (1, 2, 3) and not worker.owned_twins()
    worker._twins.rehydrate([1, 2, 3])
    assert Asked.seen[0] == {(True, True)} and worker._twins.without_history == ()
    assert all(held.twin.prediction.last_rollout is not None for held in worker.owned_twins())


def test_the_protocol_ignores_strangers(bus: MemoryBus) -> None:
    claiming = OwnershipProtocol(bus, range(5), Worker(bus, range(5), omega=0.0)._twins)
    for name in ("", "worker", "viewer/x/0-4/1", f"worker/{OTHER}/4/1", f"worker/{OTHER}/a-b/1", "worker/x/0-4/1"):
        claiming._on_token(name, True)
    assert not claiming.state.peers
    claiming._on_token(f"worker/{OTHER}/0-4/1", True)
    assert list(claiming.state.peers) == [OTHER]


def test_several_processes_share_a_range_and_one_that_dies_is_replaced(router: str) -> None:
    """The command itself: two processes, one is killed, and there are two again."""
    command = [sys.executable, "-m", "twin_worker", "--uavs=0-5", "--no-diagnosis", "--router", router]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    with (
        connect(router) as bus,
        subprocess.Popen([*command, "--processes=2"], cwd=ROOT, env=env, stderr=subprocess.PIPE) as parent,
    ):
        try:
            publisher = Publisher(bus)
            publisher.publish(Status(uav=uav, t=f.T0) for uav in range(6))

            def holders() -> set[str]:
                return {claim.worker for claim, _ in bus.get(Claim)}

            wait(lambda: len(holders()) == 2 and not held_twice(bus) and count(bus) == 6)
            before = holders()
            children = Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().split()
            os.kill(int(children[0]), signal.SIGKILL)
            wait(lambda: len(holders() - before) == 1 and not held_twice(bus) and count(bus) == 6)
        finally:
            parent.terminate()
        assert b"worker" in parent.communicate(timeout=PATIENCE_S)[1] and parent.returncode == 0


def claimed(bus: Bus) -> list[int]:
    return [uav for claim, _ in bus.get(Claim) for uav, _ in claim.owned]


def count(bus: Bus) -> int:
    return len(set(claimed(bus)))


def held_twice(bus: Bus) -> bool:
    found = claimed(bus)
    return len(found) > len(set(found))
