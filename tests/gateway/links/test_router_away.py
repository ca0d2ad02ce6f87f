"""A router that is away: said, counted, waited for, while everything else goes on."""

import os
import signal
import socket
import subprocess
import sys
import threading

import pytest
from conftest import ROOT, unused_port
from pymavlink import mavutil

from fleet.bus.codec import EncodedMessage, encode
from fleet.bus.session import connect, open_router
from fleet.contract import GatewayCounters, Mission, Status
from gateway.publication import LEASE_S, Publisher, RouterSession
from tests.gateway.test_gateway import PATIENCE_S, Ear, udp_port
from tests.support.fake_link import beside_compiling, untimed
from tests.support.memory_bus import MemoryBus
from tests.support.talker import T0, Talker

STATUS = EncodedMessage(Status, 7, encode(Status(uav=7, t=T0)))


class Flaky(MemoryBus):
    router = "one"


def test_every_message_is_published_unsent_or_unsure_and_the_way_back_is_noticed(caplog):
    bus, now = Flaky(), [0.0]
    way, heard = RouterSession(bus, lambda: now[0]), []
    bus.subscribe(Status, lambda message, _: heard.append(message))

    def fly(seconds):
        came = []
        for _ in range(round(seconds * 10)):
            now[0] += 0.1
            came.append(way.poll())
            for _ in range(3):
                way.send([STATUS])
        return came

    assert not any(fly(10.0))
    bus.router = ""
    assert not any(fly(4.0))
    assert (way.published, way.unsent) == (300, 120)
    assert 30 * LEASE_S <= way.unconfirmed <= 30 * (LEASE_S + 0.2)
    bus.router = "two"
    assert fly(1.0).count(True) == 1
    assert (way.published, way.unsent, len(heard)) == (330, 120, 330)
    bus.router = "three"  # restarted so fast that nobody noticed it gone
    assert fly(0.1) == [True] and way.unconfirmed > 60
    assert ["disconnected" in record.message for record in caplog.records] == [True, False, True, False]


def test_missions_are_said_again_as_soon_as_the_router_is_back():
    bus = Flaky()
    publisher, said = Publisher(bus), []
    bus.subscribe(Mission, lambda message, _: said.append(message))
    publisher.repeat(100.0)
    bus.router = ""
    publisher.repeat(100.1)
    publisher.publish([Mission(uav=7, t=T0)])
    assert said == []
    bus.router = "two"
    publisher.repeat(100.2)
    assert [mission.uav for mission in said] == [7]


def test_a_gateway_that_records_begins_without_a_router_and_joins_it_later(tmp_path):
    router, port, talker, stop = f"tcp/127.0.0.1:{unused_port()}", udp_port(), Talker(), threading.Event()
    sent = []

    def fly():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as air:
            boot = 0.0
            while not stop.wait(0.02):
                boot += 0.02
                frame = talker.heartbeat() if len(sent) % 25 == 0 else talker.attitude(boot)
                air.sendto(frame, ("127.0.0.1", port))
                sent.append(frame)

    command = [sys.executable, "-m", "gateway", "--router", router, "--link", f"udpin:127.0.0.1:{port}"]
    command += ["--record", str(tmp_path), "--listen-only"]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        command, cwd=ROOT, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as child:
        assert untimed(child.stdout.readline())[0].startswith("gateway: ")
        radio = threading.Thread(target=fly)
        radio.start()
        try:
            for gone in (False, True):  # first it comes late, then it dies and another takes its place
                session = open_router(router)
                with connect(router) as bus:
                    ear = Ear(bus)
                    ear.wait(
                        lambda e: e.of(GatewayCounters) and e.of(GatewayCounters)[-1].messages > 100 and e.of(Status, 7)
                    )
                    last = ear.of(GatewayCounters)[-1]
                session.close()
                assert last.unsent > 0 and last.router
                assert (last.unconfirmed > 0) is gone
        finally:
            stop.set()
            radio.join(PATIENCE_S)
            child.send_signal(signal.SIGTERM)
            _, errors = child.communicate(timeout=PATIENCE_S)
    assert child.returncode == 0
    assert (
        beside_compiling(errors).startswith("gateway: no router is connected yet")
        and "the router is connected" in errors
        and "the router is disconnected" in errors
    )
    (path,) = tmp_path.glob("*.tlog")
    stream = mavutil.mavlink_connection(str(path), dialect="ardupilotmega", robust_parsing=False)
    kept = []
    while (message := stream.recv_msg()) is not None:
        kept.append(bytes(message.get_msgbuf()))
    stream.close()
    said = iter(sent)
    assert len(kept) > 100 and all(frame in said for frame in kept), "in the order it was sent"


def test_without_a_recording_a_missing_router_stops_the_start():
    with pytest.raises(ConnectionError, match="no response"):
        connect(f"tcp/127.0.0.1:{unused_port()}")
