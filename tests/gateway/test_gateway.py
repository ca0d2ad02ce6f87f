import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from conftest import ROOT, unused_port

from fleet.bus.session import connect
from fleet.contract import GatewayCounters, Mission, Params, Sample, Status
from fleet.telemetry.mavlink.parsing.received import ReceivedBytes
from fleet.telemetry.recording.recordings import replay_messages
from gateway.__main__ import compile_decoder
from gateway.link_spec import read_spec
from gateway.links.link import Batch
from gateway.links.receive import Udp
from gateway.links.recorded import ReplayLink
from gateway.pipeline import Pipeline
from tests.support.fake_link import FakeLink, beside_compiling, untimed
from tests.support.memory_bus import MemoryBus
from tests.support.talker import ITEMS, T0, Aircraft, Talker

PATIENCE_S = 30.0  # an upper bound; every wait ends with its condition


class Ear:
    """Collect from a bus and wake whoever waits for a condition."""

    def __init__(self, bus):
        self.news = []
        self._changed = threading.Condition()
        for kind in (Sample, Status, Mission, Params, GatewayCounters):
            bus.subscribe(kind, self._hear)

    def _hear(self, message, _stamp):
        with self._changed:
            self.news.append(message)
            self._changed.notify_all()

    def of(self, kind, uav=None):
        return [m for m in list(self.news) if isinstance(m, kind) and uav in (None, getattr(m, "uav", None))]

    def wait(self, condition):
        with self._changed:
            assert self._changed.wait_for(lambda: condition(self), PATIENCE_S), "waited in vain"


# ---- links


def test_a_link_is_read():
    spec = read_spec("udpin:0.0.0.0:14550#offset=-1")
    assert (spec.kind, spec.address, spec.port, spec.offset) == ("udpin", "0.0.0.0", 14550, -1)
    assert read_spec("udpin::14550", 3)[2:6] == ("127.0.0.1", 14550, 1.0, 3)
    assert read_spec("replay:/a b/c.tlog.xz?speed=max")[1:5] == ("replay", "/a b/c.tlog.xz", 0, float("inf"))
    assert read_spec("replay:c.tlog?speed=4").speed == 4
    assert read_spec("replay:a%3F%23.bin?copies=50")[2:8] == ("a?#.bin", 0, 1.0, 0, 50, False)
    assert read_spec("replay:c.parauav?results=1").results


@pytest.mark.parametrize(
    "text",
    [
        "",
        "udpin:",
        "udpin:14550:x",
        "udpin:h:0",
        "udpin:h:99999",
        "ftp:h:1",
        "tcp::1",
        "serial:",
        "serial:/dev/x:0",
        "udpin:h:1#sign=maybe",
        "udpin:h:1#key=a",
        "replay:x.tlog#systems=1",
        "replay:",
        "udpin:h:1#offset=x",
        "udpin:h:1#a=1",
        "replay:x.tlog?sped=4",
        "replay:x.tlog?copies=0",
        "replay:x.tlog?copies=2&results=1",
        "replay:x.tlog?results=yes",
    ],
)
def test_what_is_no_link_stops_at_start(text):
    with pytest.raises(ValueError, match=r"--link: found .*, expected .*(udpin|tcp|serial)"):
        read_spec(text)


@pytest.mark.parametrize("speed", ["0", "-1", "nan", "fast"])
def test_what_is_no_speed_stops_at_start(speed):
    with pytest.raises(ValueError, match=r"found .*, expected"):
        read_spec(f"replay:x.tlog?speed={speed}")


def test_a_busy_port_is_one_sentence():
    link = Udp(read_spec(f"udpin:127.0.0.1:{unused_port()}"))
    try:
        with pytest.raises(OSError, match=r"^link udpin:\S+:\d+: .*; stop the process on this port or name another$"):
            Udp(read_spec(link.spec.text))
    finally:
        link.close()


# ---- pump and publisher


@pytest.mark.parametrize("listen_only", [False, True])
def test_latest_news_answer_and_only_listening_sends_nothing(listen_only):
    bus, link, talker = MemoryBus(), FakeLink("udpin:127.0.0.1:1#offset=-1"), Talker()
    pump, ear = Pipeline([link], bus, listen_only), Ear(bus)
    data = talker.heartbeat() + talker.attitude(1.0) + talker.mission(talker.item(0)) + talker.param("A", 2.0, 0, 1)
    pump.take(Batch(0, ReceivedBytes.from_pieces([(time.time(), "air", data)])))
    pump._tick(0.0)
    pump.run(threading.Event())
    assert {type(m) for m in ear.news} == {Sample, Status, Mission, Params, GatewayCounters}
    ((mission, _),) = bus.get(Mission)
    assert (mission.uav, len(mission.items)) == (6, 1)
    assert bus.get(Params, 6)[0][0].values == {"A": 2.0}
    assert bus.get(Status, 5) == []
    ((account, _),) = bus.get(GatewayCounters)
    assert (account.uavs, account.datagrams, account.messages, account.bad_bytes) == ((6,), 1, 5, 0)
    assert account.bytes_in == len(data)
    assert bool(link.sent) is not listen_only


def test_mission_and_parameters_are_said_again():
    bus, talker = MemoryBus(), Talker()
    pump, ear = Pipeline([FakeLink()], bus), Ear(bus)
    data = talker.heartbeat() + talker.mission(talker.item(0))
    pump.take(Batch(0, ReceivedBytes.from_pieces([(time.time(), "air", data)])))
    for mono in (0.0, 5.0, 11.0, 12.0, 22.0):
        pump._tick(mono)
    assert len(ear.of(Mission)) == 3


def flight(seconds=20.0, system=7):
    """Write a short recording's bytes."""
    talker, out = Talker(system), b""
    for step in range(round(seconds * 20)):
        frames = [talker.attitude(step * 0.05)] + ([talker.heartbeat()] if step % 20 == 0 else [])
        for frame in frames:
            out += round((T0 + step * 0.05) * 1e6).to_bytes(8, "big") + frame
    return out


def test_a_recording_played_live_says_what_it_says_offline(tmp_path):
    path = tmp_path / "flight.tlog"
    path.write_bytes(flight())
    bus = MemoryBus()
    ear = Ear(bus)
    Pipeline([ReplayLink(read_spec(f"replay:{path}?speed=max"))], bus).run(threading.Event())
    live = [m for m in ear.news if not isinstance(m, GatewayCounters)]
    assert live == list(replay_messages(path))
    assert len(live) > 200
    assert ear.of(GatewayCounters)[-1].t == pytest.approx(T0 + 20, abs=0.2)


def test_a_recording_keeps_its_pace(tmp_path):
    path = tmp_path / "flight.tlog"
    path.write_bytes(flight(10.0))
    began = time.monotonic()
    Pipeline([ReplayLink(read_spec(f"replay:{path}?speed=20"))], MemoryBus()).run(threading.Event())
    assert 0.45 <= time.monotonic() - began < 5.0


# ---- end to end


def udp_port() -> int:
    return unused_port(socket.SOCK_DGRAM)


def test_udp_to_zenoh_through_a_megabyte_of_noise(router):
    stop = threading.Event()
    with connect(router) as bus, connect(router) as mine:
        link, ear = Udp(read_spec(f"udpin:127.0.0.1:{udp_port()}")), Ear(mine)
        thread = threading.Thread(target=Pipeline([link], bus).run, args=(stop,))
        thread.start()
        try:
            with Radio(link.port) as radio:
                ear.wait(lambda e: e.of(Sample, 7) and any(p.complete for p in e.of(Params, 7)))
                ear.wait(lambda e: any(m.complete and m.items == ITEMS for m in e.of(Mission, 7)))
                noise = np.random.default_rng(1).bytes(1_000_000)
                before = len(ear.of(Sample, 7))
                for start in range(0, len(noise), 1000):
                    radio.noise(noise[start : start + 1000])
                ear.wait(lambda e: e.of(GatewayCounters) and e.of(GatewayCounters)[-1].bad_bytes > 100_000)
                ear.wait(lambda e: len(e.of(Sample, 7)) > before + 5)
                assert [m.uav for m, _ in mine.get(Status)] == [7]
                assert mine.get(Mission, 7)[0][0].items == ITEMS
                assert ear.of(GatewayCounters)[-1].uavs == (7,)
                assert abs(ear.of(Sample, 7)[-1].t - time.time()) < 5
        finally:
            stop.set()
            thread.join(PATIENCE_S)
        assert not thread.is_alive()


class Radio:
    """A pretend aircraft on a socket, in a thread of its own."""

    def __init__(self, port):
        self._socket, self._noise = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        self._to = ("127.0.0.1", port)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def noise(self, data):
        self._noise.sendto(data, self._to)

    def _run(self):
        aircraft, began = Aircraft(0.0), time.monotonic()
        self._socket.settimeout(0.02)
        while not self._stop.is_set():
            now = time.monotonic() - began
            frames = [aircraft.talker.heartbeat(), aircraft.talker.attitude(now), *aircraft.stream()]
            with contextlib.suppress(OSError):
                frames += aircraft.hear(self._socket.recv(4096), now)
            for frame in frames:
                self._socket.sendto(frame, self._to)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()
        self._socket.close()
        self._noise.close()


def start(*arguments):
    return subprocess.Popen(
        [sys.executable, *arguments],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_the_gateway_stops_cleanly(router, number):
    child = start("-m", "gateway", "--router", router, "--link", f"udpin:127.0.0.1:{udp_port()}")
    with child:
        assert untimed(child.stdout.readline())[0].startswith("gateway: udpin")
        child.send_signal(number)
        _, errors = child.communicate(timeout=PATIENCE_S)
    assert (child.returncode, beside_compiling(errors)) == (0, "")


def test_a_port_in_use_and_a_missing_router_end_with_a_sentence(router):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as held:
        held.bind(("127.0.0.1", 0))
        with start("-m", "gateway", "--router", router, "--link", f"udpin:127.0.0.1:{held.getsockname()[1]}") as child:
            _, errors = child.communicate(timeout=PATIENCE_S)
    assert child.returncode == 2
    text = beside_compiling(errors)
    assert text.startswith("gateway: link udpin:") and text.count("\n") == 1
    with start("-m", "gateway", "--router", f"tcp/127.0.0.1:{unused_port()}") as child:
        _, errors = child.communicate(timeout=PATIENCE_S)
    assert child.returncode == 2
    assert "no response" in errors


def test_fleet_replay_joins_a_running_fleet(router, tmp_path):
    path = tmp_path / "flight.tlog"
    path.write_bytes(flight(system=9))
    with connect(router) as mine:
        ear = Ear(mine)
        with start(
            "-m", "fleet.cli", "replay", str(path), "--speed", "20", "--offset", "-1", "--router", router
        ) as child:
            _, errors = child.communicate(timeout=PATIENCE_S)
        assert (child.returncode, beside_compiling(errors)) == (0, "")
        ear.wait(lambda e: sum(len(s.attitude.t.numpy()) for s in e.of(Sample, 8)) > 350)
    with start("-m", "fleet.cli", "replay", str(tmp_path / "none.tlog"), "--router", router) as child:
        _, errors = child.communicate(timeout=PATIENCE_S)
    assert child.returncode == 2
    assert "found no file" in errors


def test_compiling_that_takes_long_is_said(monkeypatch):
    monkeypatch.setattr("gateway.__main__.COLD_S", 0.0)
    said = threading.Event()
    monkeypatch.setattr("gateway.__main__._log.warning", lambda *_: said.set())
    monkeypatch.setattr("fleet.telemetry.mavlink.warm.warm_up", lambda: said.wait(PATIENCE_S))
    compile_decoder()
    assert said.is_set()
