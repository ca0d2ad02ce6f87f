"""Who is a UAV, and whose: alarms for a second sender, a limit, foreign recordings, three kinds of link at once."""

import json
import lzma
import os
import pty
import socket
import threading
import tty
from pathlib import Path

import pytest
from conftest import unused_port
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.contract import Alert, AlertKind, GatewayCounters, Status
from fleet.telemetry.mavlink.heartbeat import CLEAR_AFTER_S
from fleet.telemetry.mavlink.intake import MavlinkReceiver
from fleet.telemetry.recording.ids import IdAllocator
from gateway.link_spec import read_spec
from gateway.links.opening import open_link
from gateway.pipeline import Pipeline
from tests.support.fake_link import PATIENCE_S, until
from tests.support.memory_bus import MemoryBus
from tests.support.oracle import framed, ours, raw
from tests.support.talker import ARDU, PLANE, T0, Talker, of


def test_a_second_sender_raises_one_alarm_which_ends_when_it_is_silent():
    intake, genuine, spoofer, told = MavlinkReceiver(), Talker(), Talker(), []
    for step in range(400):
        t = T0 + step * 0.1
        intake.receive(t, genuine.heartbeat() if step % 10 == 0 else genuine.attitude(step * 0.1), ("10.0.0.2", 14550))
        if 50 <= step < 200:
            intake.receive(t, spoofer.attitude(900.0 + step), ("10.0.0.66", 999))
        told += [(step, alert) for alert in of(Alert, intake.flush(t))]
    (first, raised), (last, over) = told
    assert (first, raised.kind, raised.active, raised.uav) == (50, AlertKind.SECOND_SENDER, True, 7)
    assert "second sender (10.0.0.66:999)" in raised.sentence and "first (10.0.0.2:14550)" in raised.sentence
    assert not over.active and last == pytest.approx(199 + 10 * CLEAR_AFTER_S, abs=2)
    assert intake.rejected == {"second sender for a live id": 150}


def test_two_links_with_one_id_are_told_and_offsets_keep_them_apart():
    for offset, uavs in ((0, [7]), (100, [7, 107])):
        claims: dict = {}
        one, two = MavlinkReceiver(0, claims), MavlinkReceiver(offset, claims)
        one.receive(T0, Talker().heartbeat(), "a")
        two.receive(T0 + 0.1, Talker().heartbeat(), "b")
        news = one.flush(T0 + 0.2) + two.flush(T0 + 0.2)
        assert sorted(claims) == uavs
        assert bool(of(Alert, news)) is (offset == 0)


def test_a_caller_that_took_its_leave_may_call_again_at_once():
    intake, talker = MavlinkReceiver(), Talker()
    intake.receive(T0, talker.heartbeat(), ("h", 1))
    intake.release_sender(("h", 1))
    intake.receive(T0 + 0.2, talker.attitude(1.0), ("h", 2))
    assert of(Alert, intake.flush(T0 + 0.3)) == []
    assert (intake.aircraft[7].source, intake.rejected) == (("h", 2), {})


def test_no_more_uavs_than_allowed_over_all_links():
    claims: dict = {}
    one, two = MavlinkReceiver(0, claims, max_uavs=3), MavlinkReceiver(1000, claims, max_uavs=3)
    for intake in (one, two):
        intake.receive(T0, b"".join(Talker(system).heartbeat() for system in (1, 2)), "a")
        intake.flush(T0)
    assert sorted(claims) == [1, 2, 1001]
    assert two.rejected == {"more than 3 aircraft; raise --most-uavs": 1}


def test_no_message_but_an_aircraft_s_heartbeat_makes_a_uav():
    everything = [
        framed(kind.id, bytes(kind.unpacker.size), kind.crc_extra)
        for kind in mav.mavlink_map.values()
        if kind.msgname != "HEARTBEAT"
    ]
    unknown = bytes([0xFD, 4, 0, 0, 0, 9, 1, 0xEE, 0xEE, 0x7F]) + bytes(6)
    for system, kind in (
        (20, mav.MAV_TYPE_GCS),
        (21, mav.MAV_TYPE_ADSB),
        (22, mav.MAV_TYPE_CAMERA),
        (23, mav.MAV_TYPE_GIMBAL),
    ):
        everything.append(Talker(system).heartbeat(kind, mav.MAV_AUTOPILOT_INVALID))
        everything.append(Talker(system, 100).heartbeat(kind, ARDU))
    everything.append(Talker(24).heartbeat(PLANE, mav.MAV_AUTOPILOT_INVALID))
    intake = MavlinkReceiver()
    for frame in (*everything, unknown):
        intake.receive(T0, frame, "a")
        intake.flush(T0)
    assert intake.aircraft == {}
    assert intake.decoder.counters()["messages"] == len(everything)


# ---- recordings


def heard(path: Path, size: int = 400_000) -> bytes:
    """The MAVLink at the begin of a .tlog, stamps left out."""
    opened = lzma.open if path.suffix == ".xz" else open
    with opened(path, "rb") as file:
        data = file.read(size)
    return b"".join(raw(ours([data])))


SWARM = ("sitl/s10_multi3_nominal.tlog.xz", "real/cuav_quadplane_20161112.tlog", "sitl/s09_quadplane_nominal.tlog.xz")


def test_every_recording_has_the_uavs_that_flew(recordings):
    flights = json.loads((recordings / "sitl" / "manifest.json").read_text())["flights"]
    flown = {f"sitl/{one['name']}.tlog.xz": {v["sysid"] for v in one["vehicles"]} for one in flights}
    flown |= {"real/cuav_quadplane_20161112.tlog": {2}, "real/alfa_20180718_155331_1_engine_failure.tlog": {1}}
    assert len(flown) == 12
    for name, systems in flown.items():
        intake = MavlinkReceiver()
        intake.receive(T0, heard(recordings / name), "a")
        assert {status.uav for status in of(Status, intake.flush(T0))} == systems, name


def test_a_mixed_swarm_over_three_kinds_of_link_has_the_right_uavs(recordings):
    """Three flight-stack aircraft by UDP, a real quadplane by TCP, a simulated one by a serial line, all at once."""
    told = [heard(recordings / name, 100_000) for name in SWARM]
    far, near = pty.openpty()
    tty.setraw(near)
    texts = ("udpin:127.0.0.1:{}", "tcpin:127.0.0.1:{}", f"serial:{os.ttyname(near)}#offset=100")
    links = [open_link(read_spec(text.format(unused_port())), IdAllocator()) for text in texts]
    bus, stop, done = MemoryBus(), threading.Event(), threading.Event()
    accounts: list[GatewayCounters] = []

    def hear(account, _):
        accounts.append(account)
        if len(account.uavs) == 5 and account.bytes_in == sum(map(len, told)):
            done.set()

    bus.subscribe(GatewayCounters, hear)
    pump = threading.Thread(target=Pipeline(links, bus, listen_only=True).run, args=(stop,))
    pump.start()
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
            for start in range(0, len(told[0]), 1000):
                udp.sendto(told[0][start : start + 1000], ("127.0.0.1", links[0].port))
            with socket.create_connection(("127.0.0.1", links[1].port)) as tcp:
                tcp.sendall(told[1])
                until(lambda: links[2]._stream)  # what lies there before it is opened is not for us
                line = memoryview(told[2])
                while line:
                    line = line[os.write(far, line) :]
                assert done.wait(PATIENCE_S), accounts[-1]
    finally:
        stop.set()
        pump.join(PATIENCE_S)
        os.close(far)
        os.close(near)
    assert accounts[-1].uavs == (2, 21, 22, 23, 109)
    assert (accounts[-1].bad_bytes, accounts[-1].bad_frames) == (0, 0)
    assert accounts[-1].messages == sum(len(ours([data]).headers) for data in told)
