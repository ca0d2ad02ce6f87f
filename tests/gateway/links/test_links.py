"""Every kind of link brings what was sent, answers, comes back after it was down, and counts what it loses."""

import contextlib
import os
import pty
import queue
import selectors
import socket
import threading
import time
import tty

import numpy as np
import pytest
from conftest import unused_port

from fleet.contract import GatewayCounters
from fleet.telemetry.mavlink.parsing.received import ReceivedBytes
from fleet.telemetry.recording.ids import IdAllocator
from gateway.link_spec import read_spec
from gateway.links import receive, stream, tcp_listener
from gateway.links.link import Batch, wall
from gateway.links.opening import open_link
from gateway.links.stream import MAX_BYTES, Stream
from gateway.onboard import RequestSender
from gateway.pipeline import Pipeline
from tests.support.fake_link import PATIENCE_S, pieces, until
from tests.support.memory_bus import MemoryBus
from tests.support.talker import Talker

DROPPED = "dropped: decoding fell behind"
HELLO, ANSWER = Talker().heartbeat(), Talker(255, 190).heartbeat(6, 8)


class Line:
    """A started link and what came through it."""

    def __init__(self, text, room=0):
        self.queue, self.stop = queue.Queue(room), threading.Event()
        self.link = open_link(read_spec(text), IdAllocator())
        self.link.start(3, self.queue, self.stop)

    def next(self) -> Batch:
        batch = self.queue.get(timeout=PATIENCE_S)
        assert batch.link == 3
        return batch

    def hear(self, size):
        """Everything up to so many bytes: (sender, bytes) of the last piece, all bytes."""
        told, sender = b"", None
        while len(told) < size:
            batch = self.next()
            got = [] if batch.received is None else pieces(batch.received)
            told += b"".join(data for _, _, data in got)
            sender = got[-1][1] if got else sender
        return sender, told

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.stop.set()
        self.link.close()


def udp(bound=True):
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.settimeout(PATIENCE_S)
    if bound:
        sock.bind(("127.0.0.1", 0))
    return sock


def test_udpin_answers_who_spoke():
    with Line(f"udpin:127.0.0.1:{udp_port()}") as line, udp() as air:
        air.sendto(HELLO, ("127.0.0.1", line.link.port))
        sender, told = line.hear(len(HELLO))
        assert (sender, told) == (air.getsockname(), HELLO)
        line.link.send(sender, ANSWER)
        assert air.recv(1000) == ANSWER


def udp_port():
    with udp() as sock:
        return port_of(sock)


def test_udpout_speaks_first_and_hears_only_the_far_end():
    with udp() as air, udp() as stranger, Line(f"udpout:127.0.0.1:{port_of(air)}") as line:
        assert until(lambda: line.link.known_peers) == (air.getsockname(),)
        line.link.send(line.link.known_peers[0], ANSWER)
        greeting, gateway = air.recvfrom(1000)
        assert greeting == ANSWER
        stranger.sendto(b"x" * 50, gateway)
        air.sendto(HELLO, gateway)
        assert line.hear(len(HELLO)) == (air.getsockname(), HELLO)


def port_of(sock):
    return sock.getsockname()[1]


def test_udpout_to_a_name_nobody_knows_yet_tries_again(monkeypatch):
    tries, real = [], socket.getaddrinfo

    def lookup(*given, **named):
        tries.append(given)
        if len(tries) < 2:
            raise socket.gaierror(-2, "Name or service not known")
        return real("127.0.0.1", *given[1:], **named)

    monkeypatch.setattr(socket, "getaddrinfo", lookup)
    with udp() as air, Line(f"udpout:plane.invalid:{port_of(air)}") as line:
        line.link.send("anywhere", HELLO, 2)
        line.link.send(until(lambda: line.link.known_peers)[0], ANSWER)
        assert air.recv(1000) == ANSWER
        assert (line.link.unsent, len(tries)) == (2, 2)


def test_udpbcast_calls_all_and_hears_whoever_answers():
    port = udp_port()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as air, Line(f"udpbcast:127.255.255.255:{port}") as line:
        air.settimeout(PATIENCE_S)
        air.bind(("", port))
        line.link.send(until(lambda: line.link.known_peers)[0], ANSWER)
        greeting, gateway = air.recvfrom(1000)
        assert greeting == ANSWER
        air.sendto(HELLO, ("127.0.0.1", gateway[1]))
        sender, told = line.hear(len(HELLO))
        assert told == HELLO
        assert sender[1] == port


def test_tcpin_has_many_callers_and_says_who_left():
    with Line(f"tcpin:127.0.0.1:{unused_port()}") as line:
        where = ("127.0.0.1", line.link.port)
        with socket.create_connection(where, PATIENCE_S) as one, socket.create_connection(where, PATIENCE_S) as two:
            until(lambda: len(line.link.known_peers) == 2)
            one.sendall(HELLO[:7])
            one.sendall(HELLO[7:])
            sender, told = line.hear(len(HELLO))
            assert (sender, told) == (one.getsockname(), HELLO)
            line.link.send(two.getsockname(), ANSWER)
            assert two.recv(1000) == ANSWER
            left = one.getsockname()
        assert {line.next().left_peer, line.next().left_peer} >= {left}
        line.link.send(left, ANSWER, 5)
        assert line.link.unsent == 5


def test_tcpin_full_of_silent_callers_lets_the_next_one_in_and_keeps_who_speaks():
    with contextlib.ExitStack() as held, Line(f"tcpin:127.0.0.1:{unused_port()}") as line:
        where = ("127.0.0.1", line.link.port)

        def call():
            caller = held.enter_context(socket.create_connection(where, PATIENCE_S))
            until(lambda: caller.getsockname() in line.link.known_peers)
            return caller

        first, speaker = call(), call()
        silent = [call() for _ in range(tcp_listener.MOST - 2)]
        speaker.sendall(HELLO)
        assert line.hear(len(HELLO)) == (speaker.getsockname(), HELLO)
        for oldest in (first, *silent[:5]):
            rightful = call()
            assert oldest.recv(1) == b"" and line.next().left_peer == oldest.getsockname()
            rightful.sendall(HELLO)
            assert line.hear(len(HELLO)) == (rightful.getsockname(), HELLO)
        speaker.sendall(HELLO)
        assert line.hear(len(HELLO)) == (speaker.getsockname(), HELLO)
        assert len(line.link.known_peers) == tcp_listener.MOST


def test_tcpin_refuses_the_next_caller_where_all_speak(monkeypatch, caplog):
    monkeypatch.setattr(tcp_listener, "MOST", 2)
    monkeypatch.setattr(tcp_listener, "SPEAKING_S", PATIENCE_S)
    with contextlib.ExitStack() as held, Line(f"tcpin:127.0.0.1:{unused_port()}") as line:
        where = ("127.0.0.1", line.link.port)
        callers = [held.enter_context(socket.create_connection(where, PATIENCE_S)) for _ in range(2)]
        for caller in callers:
            caller.sendall(HELLO)
            assert line.hear(len(HELLO)) == (caller.getsockname(), HELLO)
        for _ in range(3):
            assert held.enter_context(socket.create_connection(where, PATIENCE_S)).recv(1) == b""
        assert set(line.link.known_peers) == {caller.getsockname() for caller in callers}
    assert caplog.text.count("refused another") == 1  # a flood of callers is no flood of log lines


def test_tcp_calls_again_when_the_far_end_goes_and_counts_what_it_could_not_send():
    port = unused_port()
    with Line(f"tcp:127.0.0.1:{port}") as line:
        (where,) = line.link.known_peers
        line.link.send(where, ANSWER, 3)
        assert line.link.unsent == 3
        for _ in range(2):  # it comes, goes, and comes again
            with socket.create_server(("127.0.0.1", port)) as server:
                server.settimeout(PATIENCE_S)
                with server.accept()[0] as air:
                    air.sendall(HELLO)
                    assert line.hear(len(HELLO)) == (where, HELLO)
                    line.link.send(where, ANSWER)
                    assert air.recv(1000) == ANSWER
            until(lambda: line.link._stream is None)
        line.link.send(where, ANSWER)
        assert line.link.unsent == 4


@contextlib.contextmanager
def modem():
    """The far end of a serial line, and the name of the near one."""
    far, near = pty.openpty()
    try:
        tty.setraw(near)
        yield far, os.ttyname(near)
    finally:
        os.close(far)
        with contextlib.suppress(OSError):
            os.close(near)


def test_a_serial_line_is_read_written_and_missed():
    with modem() as (far, name), Line(f"serial:{name}:57600") as line:
        (where,) = line.link.known_peers
        until(lambda: line.link._stream)
        os.write(far, HELLO)
        assert line.hear(len(HELLO)) == (where, HELLO)
        line.link.send(where, ANSWER)
        assert os.read(far, 1000) == ANSWER
    with Line("serial:/dev/no-such-line") as line:
        line.link.send(where, ANSWER)
        assert line.link.unsent == 1


def test_a_serial_device_that_is_not_there_is_said_once_a_minute(caplog, monkeypatch):
    monkeypatch.setattr(stream, "FIRST_RETRY_S", 0.01)
    monkeypatch.setattr(stream, "LAST_RETRY_S", 0.01)
    said = "found no device '/dev/ttyNOPE'"
    with Line("serial:/dev/ttyNOPE") as line:
        until(lambda: line.link._wait_s and len(caplog.records) == 1)
        monkeypatch.setattr(stream, "LOG_PERIOD_S", 0.0)
        until(lambda: len(caplog.records) > 2)
    assert all(said in record.message and "correct the link" in record.message for record in caplog.records)


def test_a_slow_stream_takes_whole_messages_or_none(monkeypatch):
    taken, room = bytearray(), [10]

    def write(_, data):
        n = min(room[0], len(data))
        room[0] -= n
        taken.extend(data[:n])
        return n

    monkeypatch.setattr(stream.os, "write", write)
    far, near = socket.socketpair()
    box = Stream(near)
    frames = [Talker().attitude(k * 0.1) for k in range(2000)]
    fits = sum(box.put(frame, 1) for frame in frames)
    assert 0 < fits < 2000 and fits * len(frames[0]) <= MAX_BYTES + 10
    room[0] = 10**9
    box.serve(selectors.EVENT_WRITE)
    assert bytes(taken) == b"".join(frames)[: len(taken)] and len(taken) == fits * len(frames[0])
    room[0] = 0
    assert box.put(frames[0], 4) and box.close() == 4 and not box.put(frames[0], 1)
    assert far.recv(1) == b""
    far.close()


# ---- datagrams


@pytest.mark.parametrize("family", [socket.AF_INET, socket.AF_INET6])
def test_many_datagrams_at_once_are_what_one_by_one_are(family):
    rng, host = np.random.default_rng(3), "127.0.0.1" if family == socket.AF_INET else "::1"
    sent = [rng.bytes(int(n)) for n in (*rng.integers(1, 300, 200), 0, 9000, 65_000)]
    told = []
    for kind in (receive.BatchReceiver, receive.SingleReceiver):
        with contextlib.ExitStack() as held:
            far, *near = (held.enter_context(socket.socket(family, socket.SOCK_DGRAM)) for _ in range(3))
            for sock in (far, *near):
                sock.bind((host, 0))
            reader = kind(far)
            assert reader.receive() is None
            got = []
            for i, data in enumerate(sent):
                near[i % 2].sendto(data, far.getsockname())
                if i % 50 == 49 or i >= 200:  # within what any system's buffer holds
                    got += pieces(reader.receive())
            assert [data for _, _, data in got] == sent
            assert [near[i % 2].getsockname() for i in range(len(sent))] == [sender for _, sender, _ in got]
            told.append([data for _, _, data in got])
    assert told[0] == told[1]


def test_on_another_system_datagrams_come_one_by_one(monkeypatch):
    monkeypatch.setattr(receive.sys, "platform", "darwin")
    with udp() as sock:
        assert isinstance(receive.make_receiver(sock), receive.SingleReceiver)


def test_what_a_full_queue_cannot_take_is_counted():
    with Line(f"udpin:127.0.0.1:{udp_port()}", room=1) as line, udp() as air:
        for _ in range(50):
            air.sendto(HELLO, ("127.0.0.1", line.link.port))
        until(lambda: line.link.dropped + (line.queue.queue[0].received.start.size if line.queue.queue else 0) == 50)


# ---- nothing is lost silently


def test_what_was_sent_is_what_was_counted_however_far_decoding_falls_behind(monkeypatch):
    monkeypatch.setattr("gateway.pipeline.QUEUE", 2)
    link, bus = open_link(read_spec(f"udpin:127.0.0.1:{udp_port()}"), IdAllocator()), MemoryBus()
    stop, done = threading.Event(), threading.Event()
    talker, sent, accounts = Talker(), 3000, []

    def hear(account, _):
        accounts.append(account)
        if account.datagrams + account.refused.get(DROPPED, 0) == sent:
            done.set()

    bus.subscribe(GatewayCounters, hear)
    pump = Pipeline([link], bus, listen_only=True)
    busy, take = threading.Event(), pump.take
    monkeypatch.setattr(pump, "take", lambda batch: (busy.wait(0.2), take(batch)))
    thread = threading.Thread(target=pump.run, args=(stop,))
    thread.start()
    with udp() as air:
        for k in range(sent):
            air.sendto(talker.attitude(k * 0.01), ("127.0.0.1", link.port))
            if k % 100 == 99:
                busy.wait(0.005)  # within what any system's buffer holds
    try:
        assert done.wait(PATIENCE_S), accounts[-1]
    finally:
        stop.set()
        thread.join(PATIENCE_S)
    assert accounts[-1].refused[DROPPED] > 0
    assert accounts[-1].messages == accounts[-1].datagrams < sent


def test_messages_to_a_link_that_is_down_are_counted_every_one():
    bus, link = MemoryBus(), open_link(read_spec(f"tcp:127.0.0.1:{unused_port()}"), IdAllocator())
    pump, accounts = Pipeline([link], bus), []
    bus.subscribe(GatewayCounters, lambda account, _: accounts.append(account))
    pump.take(Batch(0, ReceivedBytes.from_pieces([(wall(), link.spec.text, HELLO)])))
    pump._tick(0.0)
    questions = RequestSender().tick(wall(), pump.intakes[0].aircraft.values(), link.known_peers)
    pump._publish_statistics()
    assert len(questions) > 1
    assert accounts[-1].refused == {"not sent: no peer, or send queue full": len(questions)}


def test_a_datagram_came_when_the_system_got_it_not_when_it_was_fetched():
    with udp() as sock, udp() as air:
        bulk = receive.BatchReceiver(sock)

        def is_stamped() -> bool:
            air.sendto(HELLO, sock.getsockname())
            sent = wall()
            until(lambda: wall() > sent + 0.02)
            return bulk.receive().arrival[-1] < sent + 0.01

        until(is_stamped)  # Linux begins to stamp datagrams a moment after the first socket has asked for it
        begun = wall()
        air.sendto(HELLO, sock.getsockname())
        air.sendto(HELLO, sock.getsockname())
        sent = wall()
        until(lambda: wall() > sent + 0.05)
        heard = bulk.receive()
    assert len(heard.start) == 2 and (np.diff(heard.arrival) >= 0).all()
    assert begun - 5e-3 <= heard.arrival[0] <= heard.arrival[1] <= sent + 5e-3


def test_a_system_clock_that_was_set_makes_no_datagram_early_or_very_late(monkeypatch):
    with udp() as sock, udp() as air:
        bulk = receive.BatchReceiver(sock)
        for step in (3600.0, -3600.0):
            with monkeypatch.context() as patched:
                patched.setattr(receive.time, "time", lambda step=step: time.time_ns() * 1e-9 + step)
                air.sendto(HELLO, sock.getsockname())
                (arrival,) = bulk.receive().arrival
            assert wall() - 1.5 < arrival <= wall()
