"""One law for both buses: what is published is heard, what is asked is answered, the highest epoch wins."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import pairwise
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

import msgspec
import pytest
import zenoh
from conftest import ROOT, unused_port

from fleet.access.entry import parse_endpoint
from fleet.access.knock import accepts_connections
from fleet.bus.bus_protocol import key_of, select_latest, uav_of_key
from fleet.bus.codec import Stamp, encode, encoding
from fleet.bus.session import Bus, connect, open_router
from fleet.contract import Alert, AlertKind, FleetState, GatewayCounters, Handover, Prediction, Sample, Status
from tests.bench.referee.forwarder import Forwarder
from tests.support.examples import EXAMPLES
from tests.support.memory_bus import MemoryBus

PATIENCE_S = 10.0
STAMP = Stamp(epoch=5, writer=99)
PREDICTION = EXAMPLES[Prediction]


class Pair(NamedTuple):
    """Two ends of one bus, and a way to put raw bytes on it."""

    here: Any
    there: Any
    inject: Callable[[type, bytes, str], None]


@pytest.fixture(scope="module")
def router() -> Iterator[tuple[str, zenoh.Session]]:
    """A router on a free loopback port: its endpoint and its session."""
    at = f"tcp/127.0.0.1:{unused_port()}"
    with open_router(at) as session:
        yield at, session


@pytest.fixture(params=["memory", "zenoh"])
def pair(request: pytest.FixtureRequest) -> Iterator[Pair]:
    with ExitStack() as stack:
        if request.param == "memory":
            bus = stack.enter_context(MemoryBus())
            yield Pair(bus, bus, bus.deliver)
            return
        at, raw = request.getfixturevalue("router")
        here, there = (stack.enter_context(connect(at)) for _ in range(2))
        yield Pair(here, there, lambda kind, payload, named: raw.put(key_of(kind, 7), payload, encoding=named))


def told(heard: SimpleQueue, tell: Callable[[], None]) -> Any:
    """Tell until it is heard, since a subscription takes a moment to travel; give the first thing heard."""
    for _ in range(int(PATIENCE_S / 0.05)):
        tell()
        try:
            return heard.get(timeout=0.05)
        except Empty:
            continue
    pytest.fail(f"nothing heard within {PATIENCE_S} s")


def asked(bus: Bus, kind: type, who: int | str, count: int = 1) -> list[tuple[Any, Stamp | None]]:
    """Ask until that many answer, since a queryable takes a moment to travel."""
    deadline = threading.Event()
    timer = threading.Timer(PATIENCE_S, deadline.set)
    timer.start()
    try:
        while not deadline.is_set():
            found = bus.get(kind, who)
            if len(found) >= count:
                return found
    finally:
        timer.cancel()
    pytest.fail(f"fewer than {count} answers within {PATIENCE_S} s")


# --- publish and subscribe -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stamp", [STAMP, None])
@pytest.mark.parametrize("kind", list(EXAMPLES), ids=lambda kind: kind.__name__)
def test_what_is_published_is_heard_with_its_stamp(pair: Pair, kind: type, stamp: Stamp | None) -> None:
    heard: SimpleQueue = SimpleQueue()
    pair.there.subscribe(kind, lambda message, stamp: heard.put((message, stamp)))
    assert told(heard, lambda: pair.here.publish(EXAMPLES[kind], stamp)) == (EXAMPLES[kind], stamp)


def test_what_is_put_aside_is_handed_out_in_order_with_whose_it_is(pair: Pair) -> None:
    heard: SimpleQueue = SimpleQueue()
    pair.there.subscribe_buffered(Status, lambda letters: [heard.put(letter) for letter in letters])
    pair.there.dispatch()  # nothing waits

    def tell(stamp: Stamp | None = STAMP) -> None:
        pair.here.publish(EXAMPLES[Status], stamp)
        pair.there.dispatch()

    uav, payload, named = EXAMPLES[Status].uav, encode(EXAMPLES[Status]), encoding(Status)
    assert told(heard, tell) == (uav, payload, named, STAMP)
    assert told(heard, lambda: (pair.inject(Status, b"", "odd"), pair.there.dispatch()))[1] in (b"", payload)
    *_, last = [told(heard, lambda: tell(None)) for _ in range(3)]
    assert last[3] is None or last[2] == "odd" or last[1] == payload


def test_what_is_kept_for_an_aircraft_is_released_and_made_again(router: tuple) -> None:
    sample, heard = EXAMPLES[Sample], SimpleQueue()
    with connect(router[0]) as bus:
        bus.subscribe(Sample, lambda message, _: heard.put(message.uav))
        for uav in range(1, 4):
            bus.publish(msgspec.structs.replace(sample, uav=uav))
        bus.remove_publishers({1, 3})
        assert {uav for _, uav in bus._publishers} == {2, -1}  # -1: batches of samples, of no one aircraft
        bus.publish(msgspec.structs.replace(sample, uav=3))
        assert [heard.get(timeout=PATIENCE_S) for _ in range(4)] == [1, 2, 3, 3]


def test_a_subscriber_hears_its_own_class_alone(pair: Pair) -> None:
    heard: SimpleQueue = SimpleQueue()
    pair.there.subscribe(Status, lambda message, _: heard.put(message))

    def tell() -> None:
        for kind in (Sample, Alert, FleetState, Status):  # in order, so the others would be heard first
            pair.here.publish(EXAMPLES[kind])

    assert told(heard, tell) == EXAMPLES[Status]


def test_bytes_that_do_not_decode_are_counted_and_the_next_message_is_heard(pair: Pair) -> None:
    heard: SimpleQueue = SimpleQueue()
    pair.there.subscribe(Status, lambda message, _: heard.put(message))
    told(heard, lambda: pair.here.publish(EXAMPLES[Status]))
    good, name = encode(EXAMPLES[Status]), encoding(Status)
    assert pair.there.bad == 0
    pair.inject(Status, b"\xc1 no message", name)
    pair.inject(Status, good, name[:-1] + "2")
    pair.inject(Status, good[:-1], name)
    last = msgspec.structs.replace(EXAMPLES[Status], sentence="last")
    pair.inject(Status, encode(last), name)
    found = heard.get(timeout=PATIENCE_S)
    while found != last:
        assert found == EXAMPLES[Status]
        found = heard.get(timeout=PATIENCE_S)
    assert pair.there.bad == 3


# --- who is slow holds up nobody -------------------------------------------------------------------------------------

MANY = 3000  # messages; Zenoh keeps 256 for a callback, then stops reading
LEAST_S = 2.5  # much less than Zenoh waits for who does not read [s]


def test_who_is_slow_with_one_class_still_hears_the_others_asks_and_is_asked(router: tuple[str, zenoh.Session]) -> None:
    """What Python has no time for must not keep a session from reading: the router would wait with it."""
    heard: SimpleQueue = SimpleQueue()
    begun, go_on = threading.Event(), threading.Event()

    def slow(*_: object) -> None:
        begun.set()
        go_on.wait(6.0 * PATIENCE_S)

    with connect(router[0]) as here, connect(router[0]) as there:
        try:
            there.subscribe(Sample, slow)
            there.subscribe(Status, lambda message, _: heard.put(message))
            there.declare_queryable(GatewayCounters, lambda *_: [(EXAMPLES[GatewayCounters], None)])
            here.declare_queryable(Alert, lambda *_: [(EXAMPLES[Alert], None)])
            told(heard, lambda: (here.publish(EXAMPLES[Sample]), here.publish(EXAMPLES[Status])))
            assert begun.wait(PATIENCE_S) and asked(here, GatewayCounters, "*") and asked(there, Alert, "*")
            for _ in range(MANY):
                here.publish(EXAMPLES[Sample])
            while not heard.empty():
                heard.get()
            assert told(heard, lambda: here.publish(EXAMPLES[Status])) == EXAMPLES[Status]
            assert asked(here, GatewayCounters, "*") and asked(there, Alert, "*")
        finally:
            go_on.set()


def test_who_reads_no_large_answer_holds_up_nobody(router: tuple[str, zenoh.Session]) -> None:
    """A process is frozen while copies come to it: others hear whoever sends them, where the router waited for 5 s."""
    heard: SimpleQueue = SimpleQueue()
    large = [Handover(t=0.0, uav=uav, epoch=1, code="", snapshot=os.urandom(1_000_000)) for uav in range(60)]
    with Forwarder(parse_endpoint(router[0])) as way, connect(router[0]) as here, connect(router[0]) as other:

        def copies(_: int | None, asked_for: dict[str, str], payload: bytes) -> Iterator[tuple[Handover, None]]:
            way.stalled = bool(payload)
            return ((each, None) for each in (large if payload else [EXAMPLES[Handover]]))

        here.declare_queryable(Handover, copies)
        other.subscribe(Status, lambda message, _: heard.put(time.monotonic()))
        told(heard, lambda: here.publish(EXAMPLES[Status]))
        with connect(f"tcp/127.0.0.1:{way.port}") as frozen:
            while not list(frozen.get_stream(Handover, "*", b"", 1.0)):
                pass
            asking = threading.Thread(target=lambda: list(frozen.get_stream(Handover, "*", b"all", PATIENCE_S)))
            asking.start()
            begun, pause = time.monotonic(), threading.Event()
            while time.monotonic() < begun + 1.5 * LEAST_S or not way.stalled:
                here.publish(EXAMPLES[Status])
                pause.wait(0.05)
            way.stalled = False
            asking.join()
            at = [begun, *(heard.get() for _ in range(heard.qsize()))]
            at.append(told(heard, lambda: here.publish(EXAMPLES[Status])))
        assert max(b - a for a, b in pairwise(at)) < LEAST_S, "the router waited"


# --- ask and answer --------------------------------------------------------------------------------------------------


def about(uav: int, t: float = 1.0) -> Prediction:
    return msgspec.structs.replace(PREDICTION, uav=uav, t=t)


def test_one_wildcard_queryable_answers_for_all_and_for_one(pair: Pair) -> None:
    seen = []

    def reply(uav: int | None, parameters: dict[str, str], payload: bytes) -> list[tuple[Prediction, Stamp]]:
        seen.append((uav, parameters, payload))
        return [(about(n), Stamp(n, 1)) for n in (3, 1, 2)]

    pair.there.declare_queryable(Prediction, reply)
    assert asked(pair.here, Prediction, "*", 3) == [(about(n), Stamp(n, 1)) for n in (1, 2, 3)]
    assert asked(pair.here, Prediction, 2) == [(about(2), Stamp(2, 1))], "answers about others are left out"
    assert pair.here.get(Prediction, 9) == []
    assert [uav for uav, _, _ in seen[-3:]] == [None, 2, 9]
    assert seen[-1] == (9, {}, b"")


def test_the_highest_epoch_wins_whoever_answers_first(pair: Pair) -> None:
    pair.there.declare_queryable(Prediction, lambda *_: [(about(1, t=50.0), Stamp(8, 1)), (about(2), Stamp(1, 1))])
    pair.here.declare_queryable(Prediction, lambda *_: [(about(1, t=10.0), Stamp(9, 2)), (about(3), None)])
    found = asked(pair.here, Prediction, "*", 3)
    assert found == [(about(1, t=10.0), Stamp(9, 2)), (about(2), Stamp(1, 1)), (about(3), None)]


def test_a_refusal_does_not_silence_the_others(pair: Pair) -> None:
    def refuse(*_: object) -> list[tuple[Prediction, Stamp | None]]:
        raise ValueError("prediction: found horizon=x, expected a number; write horizon=30")

    pair.here.declare_queryable(Prediction, refuse)
    pair.there.declare_queryable(Prediction, lambda *_: [(about(4), STAMP)])
    assert asked(pair.here, Prediction, "*") == [(about(4), STAMP)]


def test_a_question_with_a_payload_is_answered_or_refused_in_words(pair: Pair) -> None:
    def reply(uav: int | None, _: dict[str, str], payload: bytes) -> list[tuple[Prediction, Stamp | None]]:
        if payload == b"odd":
            raise ValueError("what if: found odd, expected even; correct it")
        return [(about(uav or 0), STAMP)] if payload == b"even" else []

    pair.there.declare_queryable(Prediction, reply)
    heard: SimpleQueue = SimpleQueue()
    assert told(heard, lambda: heard.put(found) if (found := pair.here.get_one(Prediction, 4, b"even")) else None)
    with pytest.raises(ValueError, match=r"^what if: found odd, expected even; correct it$"):
        pair.here.get_one(Prediction, 4, b"odd")
    assert pair.here.get_one(Prediction, 4, b"nobody knows") is None


def test_control_messages_are_answered_by_every_process(pair: Pair) -> None:
    pair.there.declare_queryable(FleetState, lambda *_: [(EXAMPLES[FleetState], None)])
    pair.here.declare_queryable(FleetState, lambda *_: [(EXAMPLES[FleetState], None)])
    assert asked(pair.here, FleetState, "*", 2) == [(EXAMPLES[FleetState], None)] * 2


def test_nobody_to_ask_is_an_empty_answer(pair: Pair) -> None:
    assert pair.here.get(GatewayCounters) == []


def test_newest_prefers_the_epoch_then_the_time() -> None:
    early, late = about(1, t=1.0), about(1, t=2.0)
    assert select_latest([(late, Stamp(1, 1)), (early, Stamp(2, 1))]) == [(early, Stamp(2, 1))]
    assert select_latest([(early, Stamp(2, 1)), (late, Stamp(2, 2))]) == [(late, Stamp(2, 2))]
    assert select_latest([(late, None), (early, Stamp(1, 1))]) == [(early, Stamp(1, 1))]
    assert select_latest([]) == []


def test_newest_keeps_every_kind_of_alert() -> None:
    both = [(Alert(uav=1, t=1.0, kind=kind), None) for kind in (AlertKind.CONFLICT, AlertKind.GROUND)]
    assert select_latest(both) == both
    near = [(Alert(uav=1, t=1.0, kind=AlertKind.CONFLICT, other=other), None) for other in (2, 3)]
    assert select_latest(near) == near


# --- zenoh alone -----------------------------------------------------------------------------------------------------


def test_selector_parameters_and_payload_reach_the_queryable_and_a_refusal_its_asker(router: tuple) -> None:
    seen: SimpleQueue = SimpleQueue()

    def reply(*given: object) -> list[tuple[Prediction, Stamp | None]]:
        seen.put(given)
        raise ValueError("prediction: found horizon=30, expected at most 10; ask for less")

    at, raw = router
    with connect(at) as bus:
        bus.declare_queryable(Prediction, reply)
        replies: list[zenoh.Reply] = []
        asked = key_of(Prediction, 7) + "?horizon=30;step=0.5"
        given = told(seen, lambda: replies.extend(raw.get(asked, payload=b"route")))
        assert given == (7, {"horizon": "30", "step": "0.5"}, b"route")
        assert replies[0].err is not None and replies[0].err.payload.to_string().endswith("ask for less")


def test_a_process_is_present_until_it_leaves(router: tuple) -> None:
    at, raw = router
    gone, came = threading.Event(), threading.Event()

    def changed(sample: zenoh.Sample) -> None:
        (came if sample.kind == zenoh.SampleKind.PUT else gone).set()

    watch = raw.liveliness().declare_subscriber("parauav/@live/**", changed)
    with connect(at) as bus:
        bus.declare_liveliness("worker/w1")
        assert came.wait(PATIENCE_S) and not gone.is_set()
    assert gone.wait(PATIENCE_S)
    watch.undeclare()


def test_the_router_of_deploy_listens_on_loopback_alone() -> None:
    config = zenoh.Config.from_file(str(ROOT / "deploy" / "zenohd.json5"))
    assert config.get_json("listen/endpoints") == '["tcp/127.0.0.1:7447"]'
    assert config.get_json("mode") == '"router"'
    assert config.get_json("scouting/multicast/enabled") == "false"


# --- keys and endpoints ----------------------------------------------------------------------------------------------


def test_keys() -> None:
    assert key_of(Sample, 7) == "parauav/7/sample" and key_of(Sample, "*") == "parauav/*/sample"
    assert (
        key_of(FleetState, "ab") == "parauav/@fleet/state/ab" and key_of(GatewayCounters, "*") == "parauav/@gateway/*"
    )
    assert uav_of_key("parauav/7/sample") == 7
    for name in ("parauav/*/sample", "parauav/@fleet/state/7", "parauav/-7/sample", "parauav/²/sample", "7", ""):
        assert uav_of_key(name) is None, name


@pytest.mark.parametrize("text", ["", "udp/127.0.0.1:7447", "tcp/:7447", "tcp/h:0", "tcp/h:65536", "tcp/h:x", "h:7447"])
def test_an_endpoint_that_is_none_is_refused_in_a_sentence(text: str) -> None:
    for use in (parse_endpoint, accepts_connections, connect, open_router):
        with pytest.raises(ValueError, match=r"--router: found .*, expected e\.g\. tcp/127\.0\.0\.1:7447; name"):
            use(text)


def test_endpoints() -> None:
    assert parse_endpoint("tcp/127.0.0.1:7447") == ("127.0.0.1", 7447)
    assert parse_endpoint("tls/[::1]:7447") == ("::1", 7447)


def test_reachable_follows_the_router(free_port: int) -> None:
    router = f"tcp/127.0.0.1:{free_port}"
    assert not accepts_connections(router)
    with pytest.raises(ConnectionError, match=r"no response; start `zenohd` or `fleet up`"):
        connect(router)
    with open_router(router):
        assert accepts_connections(router)
    assert not accepts_connections(router)


LISTENER = """
import sys, threading
from pathlib import Path
from fleet.bus.session import connect, receive_on_one_thread
from fleet.contract import Status
receive_on_one_thread()
received = threading.Event()
with connect(sys.argv[1]) as bus:
    bus.subscribe(Status, lambda message, stamp: received.set())
    bus.publish(Status(uav=7, t=1.0))
    names = [(task / "comm").read_text() for task in Path("/proc/self/task").iterdir()]
    print(received.wait(10), any(name.startswith("rx") for name in names))
"""


def test_a_listener_receives_without_threads_of_its_own_for_it(router: tuple[str, zenoh.Session]) -> None:
    run = subprocess.run([sys.executable, "-c", LISTENER, router[0]], capture_output=True, text=True, timeout=60)
    assert run.stdout.split() == ["True", "False"], run.stderr
