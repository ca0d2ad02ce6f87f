"""Copies of recorded aircraft: ids, places and times of their own, all else as recorded; on the bus and as MAVLink."""

import ipaddress
import os
import signal
import socket
import subprocess
import sys
import threading
import time

import msgspec
import numpy as np
import pytest
from conftest import ROOT
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.bus.codec import decode, encode
from fleet.cli import main
from fleet.contract import COLUMNS, Array, GatewayCounters, Item, Mission, Params, Rows, Sample, Status
from fleet.frames import Origin, to_geodetic, to_ned
from fleet.telemetry.mavlink.intake import MavlinkReceiver
from fleet.telemetry.mavlink.steps import STEP_S
from fleet.telemetry.recording.ids import IdAllocator
from fleet.telemetry.replay.broadcaster import Broadcaster, loopback_address
from fleet.telemetry.replay.offset_copies import (
    GROUP_COUNT,
    SPACING_M,
    GridOffset,
    MessageTemplate,
    OffsetCopies,
)
from gateway.link_spec import read_spec
from gateway.links.recorded import ReplayLink
from gateway.pipeline import Pipeline
from tests.support.examples import EXAMPLES
from tests.support.memory_bus import MemoryBus
from tests.support.talker import T0, Talker, of

HOME = Origin(470_000_000, 80_000_000, 500_000)
PATIENCE_S = 60.0


def path_of(t):
    """Where a circling aircraft is, NED, (n, 3) [m]."""
    t = np.asarray(t, float)
    return np.stack([200 * np.sin(t / 10), 300 * np.cos(t / 10), np.full_like(t, -100.0)], axis=-1)


def sample(uav, t0, dtype="<i4"):
    t = t0 + np.arange(3) * 0.03
    places = Rows(t=Array.of(t, "<f8"), x=Array.of(to_geodetic(HOME, path_of(t - T0)), dtype))
    attitude = Rows(t=Array.of(t, "<f8"), x=Array.of(np.outer(t - T0, np.arange(6))))
    return Sample(uav=uav, t=float(t[-1]), position=places, attitude=attitude, target=places)


# --- patching --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["<i4", "<i8"])
def test_patched_bytes_are_those_of_a_message_made_anew(dtype):
    message = sample(7, T0, dtype)
    ids, lag = np.array([8, 300, 70_000]), 0.4
    aside = GridOffset(np.array([1, 2, 3]), 4, HOME)
    there = aside.move(*message.position.x.numpy()[:, :2].T)
    for k, payload in enumerate(MessageTemplate(message).copies(ids, aside, lag)):
        copy = decode(Sample, payload)
        assert (copy.uav, copy.t) == (ids[k], message.t + lag)
        assert (copy.attitude.t.numpy() == message.attitude.t.numpy() + lag).all()
        assert (copy.attitude.x.numpy() == message.attitude.x.numpy()).all()
        for rows, was in ((copy.position, message.position), (copy.target, message.target)):
            assert (rows.x.numpy()[:, 0] == there[0][k]).all() and (rows.x.numpy()[:, 1] == there[1][k]).all()
            assert (rows.x.numpy()[:, 2] == was.x.numpy()[:, 2]).all() and rows.x.dtype == dtype
        assert copy.imu is None


@pytest.mark.parametrize("kind", [Sample, Status, Params], ids=lambda kind: kind.__name__)
def test_every_kind_keeps_everything_but_id_and_times(kind):
    message = EXAMPLES[kind]
    (payload,) = MessageTemplate(message).copies(np.array([123_456]), None, 0.0)
    assert encode(msgspec.structs.replace(decode(kind, payload), uav=message.uav)) == encode(message)


def test_copies_fly_the_same_shape_half_a_kilometre_apart():
    total = 100
    aside = GridOffset(np.arange(total), total, HOME)
    t = np.linspace(0, 60, 50)
    flown = to_geodetic(HOME, path_of(t))
    lat, lon = aside.move(flown[:, 0], flown[:, 1])
    assert (lat[0] == flown[:, 0]).all() and (lon[0] == flown[:, 1]).all()
    first = []
    for k in range(total):
        home = Origin(int(lat[k, 0]), int(lon[k, 0]), HOME.alt_mm)
        shape = to_ned(home, lat[k], lon[k], flown[:, 2])[:, :2]
        assert np.abs(shape - (path_of(t) - path_of(0))[:, :2]).max() < 0.15  # of 600 m: as true as a tangent plane
        first.append(to_ned(HOME, lat[k, :1], lon[k, :1], flown[:1, 2])[0, :2])
    apart = np.linalg.norm(np.array(first)[:, None] - np.array(first)[None], axis=2) + 1e9 * np.eye(total)
    assert 0.99 * SPACING_M < apart.min() < 1.01 * SPACING_M


@pytest.mark.parametrize("lon", [1_799_999_000, -1_799_999_000, 0])
def test_the_date_line_and_nowhere_are_minded(lon):
    home = Origin(470_000_000, lon, 0)
    lat, moved = GridOffset(np.arange(9), 9, home).move(np.array([home.lat_e7, 0]), np.array([lon, 0]))
    assert (np.abs(moved) <= 1_800_000_000).all()
    assert (lat[:, 1] == 0).all() and (moved[:, 1] == 0).all()
    back = to_ned(home, lat[:, 0], moved[:, 0], np.zeros(9))
    assert np.abs(back[:, 1] - np.arange(9) % 3 * SPACING_M).max() < 1.0


def test_ids_are_nobody_elses():
    ids = IdAllocator(1, 5)
    assert [ids.allocate(who, wanted) for who, wanted in (("a", 4), ("b", 4), ("c", 4), ("a", 9), ("d", 0))] == [
        4,
        5,
        1,
        4,
        2,
    ]
    assert ids.allocate("e", 2) == 3
    with pytest.raises(ValueError, match="all 5 taken"):
        ids.allocate("f", 2)


# --- on the bus ------------------------------------------------------------------------------------------------------


def test_copies_lag_behind_move_their_missions_and_say_their_own_names():
    n = 25
    copies = OffsetCopies(n)
    copies.set_ids(7, range(8, 7 + n))
    items = (Item(seq=0, command=16, frame=0, lat_e7=470_000_000, lon_e7=80_000_000), Item(seq=1, command=177))
    local = Item(seq=2, command=16, frame=1, lat_e7=5, lon_e7=6)
    mission = Mission(uav=7, t=T0, items=(*items, local), seq=1, complete=True, sentence="uav-7: fine")
    said = copies.step([mission]) + copies.step([sample(7, T0)])
    said += [wire for k in range(5) for wire in copies.step([sample(7, T0 + (k + 1) * STEP_S)])]
    said += [wire for step in copies.remaining() for wire in step]
    told = [wire.message() for wire in said]
    samples = {uav: of(Sample, told, uav) for uav in range(8, 7 + n)}
    for uav, mine in samples.items():
        lag = (uav - 8) % GROUP_COUNT * STEP_S
        assert [m.t for m in mine] == pytest.approx([T0 + 0.06 + k * STEP_S + lag for k in range(6)])
    missions = {m.uav: m for m in of(Mission, told)}  # the last of each: said before it was known where they fly
    assert set(missions) == set(samples)
    for uav, m in missions.items():
        assert m.sentence == f"uav-{uav}: fine" and m.items[1:] == mission.items[1:]
        away = to_ned(HOME, np.array([m.items[0].lat_e7]), np.array([m.items[0].lon_e7]), np.array([HOME.alt_mm]))
        expected = divmod(uav - 7, 5)
        assert np.abs(away[0, :2] / SPACING_M - expected).max() < 0.01


def log_of(system=7, seconds=12.0):
    """The bytes of a recording of one aircraft that circles, has a mission and parameters."""
    talker, out = Talker(system), []
    for step in range(round(seconds * 20)):
        t = step * 0.05
        lat, lon, alt = (int(v) for v in to_geodetic(HOME, path_of(t)[None])[0])
        place = mav.MAVLink_global_position_int_message(round(t * 1e3), lat, lon, alt, 0, 10, 20, 0, 65535)
        frames = [talker.attitude(t), talker.pack(place)]
        if step % 20 == 0:
            frames.insert(0, talker.heartbeat())
        if step == 1:
            frames += [talker.count(2), talker.item(0), talker.item(1), talker.param("A", 2.0, 0, 1)]
        out += [round((T0 + t) * 1e6).to_bytes(8, "big") + frame for frame in frames]
    return b"".join(out)


class Ear:
    def __init__(self, bus):
        self.news = []
        for kind in (Sample, Status, Mission, Params, GatewayCounters):
            bus.subscribe(kind, lambda message, _: self.news.append(message))


def test_a_recording_with_copies_is_played_by_as_many_aircraft(tmp_path):
    path = tmp_path / "one.tlog"
    path.write_bytes(log_of())
    bus, n = MemoryBus(), 12
    ear = Ear(bus)
    Pipeline([ReplayLink(read_spec(f"replay:{path}?speed=max&copies={n}"))], bus).run(threading.Event())
    rows = {
        uav: sum(len(getattr(s, f).t.numpy()) for s in of(Sample, ear.news, uav) for f in COLUMNS if getattr(s, f))
        for uav in range(7, 7 + n)
    }
    assert len(set(rows.values())) == 1 and rows[7] > 400
    assert [m for m in ear.news if isinstance(m, GatewayCounters)][-1].uavs == tuple(range(7, 7 + n))
    assert {m.uav for m, _ in bus.get(Mission)} == {m.uav for m, _ in bus.get(Params)} == set(range(7, 7 + n))
    assert len({bus.get(Mission, uav)[0][0].items[0].lat_e7 * 10**9 + uav for uav in rows}) == n
    places = [of(Sample, ear.news, uav)[1].position.x.numpy()[0, :2].tolist() for uav in rows]
    assert len({tuple(place) for place in places}) == n


def test_two_recordings_of_one_id_are_two_aircraft(tmp_path, caplog):
    links, ids = [], IdAllocator()
    for name in ("one.tlog", "two.tlog"):
        (tmp_path / name).write_bytes(log_of())
        links.append(ReplayLink(read_spec(f"replay:{tmp_path / name}?speed=max&copies=2"), ids))
    bus = MemoryBus()
    ear = Ear(bus)
    Pipeline(links, bus).run(threading.Event())
    counts = {uav: len(of(Sample, ear.news, uav)) for uav in (7, 8, 9, 10)}
    assert len(set(counts.values())) == 1 and counts[7] > 100
    assert {m.uav for m in of(Sample, ear.news)} == set(counts)
    assert "two.tlog: uav-7 is in use, replayed as uav-9" in caplog.text


@pytest.mark.recordings
def test_copies_of_a_recorded_flight_of_three_keep_formation(recordings):
    replay = ReplayLink(read_spec(f"replay:{recordings / 'sitl/s10_multi3_nominal.tlog.xz'}?speed=max&copies=3"))
    stop = threading.Event()
    replay.read_ahead(stop)
    assert replay._uav_ids == {21: 21, 22: 22, 23: 23}
    assert {uav: ids.tolist() for uav, ids in replay._copies._ids.items()} == {
        21: [24, 27],
        22: [25, 28],
        23: [26, 29],
    }


# --- on the air ------------------------------------------------------------------------------------------------------


def aired(path, copies):
    """Send a recording at full speed into a socket of our own; give the datagrams."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 24)
        ear.bind(("127.0.0.1", 0))
        ear.settimeout(0.5)
        airing, heard = Broadcaster(path, 8.0, range(copies), copies, IdAllocator(1, 250)), []
        thread = threading.Thread(target=airing.send, args=(ear.getsockname(), threading.Event()))
        thread.start()
        while True:
            try:
                heard.append(ear.recv(65_535))
            except TimeoutError:
                if not thread.is_alive():
                    break
        thread.join()
    assert len(heard) == airing.sent
    assert airing.problem == ""
    return airing, heard


def test_datagrams_are_sound_mavlink_of_as_many_systems(tmp_path):
    path, n = tmp_path / "one.tlog", 30
    path.write_bytes(log_of(seconds=5.0))
    airing, heard = aired(path, n)
    ears = {system: mav.MAVLink(None) for system in range(7, 7 + n)}
    said = {system: [] for system in ears}
    for datagram in heard:
        system = datagram[5]
        said[system] += ears[system].parse_buffer(datagram) or []
    assert len(heard) == airing.sent and "30 aircraft" in airing.progress_text()
    assert all(m.get_type() != "BAD_DATA" and m.get_srcSystem() == s for s, mine in said.items() for m in mine)
    names = {s: [m.get_type() for m in mine] for s, mine in said.items()}
    whole = names[7]
    assert whole.count("ATTITUDE") == 100 and whole.count("HEARTBEAT") == 5
    assert all(mine == whole for mine in names.values())
    for name, fields in (("GLOBAL_POSITION_INT", ("lat", "lon")), ("MISSION_ITEM_INT", ("x", "y"))):
        first = {s: next(m for m in mine if m.get_type() == name) for s, mine in said.items()}
        at = np.array([[getattr(m, field) for field in fields] for m in first.values()])
        away = to_ned(Origin(*at[0].tolist(), 0), at[:, 0], at[:, 1], np.zeros(n))[:, :2] / SPACING_M
        assert np.abs(away - np.array([divmod(k, 6) for k in range(n)])).max() < 0.02


def test_a_gateway_that_hears_them_tells_them_apart(tmp_path):
    path = tmp_path / "one.tlog"
    path.write_bytes(log_of(seconds=4.0))
    _, heard = aired(path, 5)
    intake = MavlinkReceiver()
    for k, datagram in enumerate(heard):
        intake.receive(T0 + k * 0.01, datagram, "one socket")
    news = intake.flush(T0 + 100)
    assert {m.uav for m in of(Sample, news)} == {7, 8, 9, 10, 11}
    assert intake.decoder.counters()["bad_bytes"] == intake.decoder.counters()["bad_frames"] == 0


def test_signatures_are_left_out_for_whoever_signed_did_not_sign_this(tmp_path):
    link = mav.MAVLink(None, srcSystem=9, srcComponent=1)
    link.signing.secret_key, link.signing.sign_outgoing, link.signing.link_id = bytes(32), True, 1
    link.signing.timestamp = 1
    beat = mav.MAVLink_heartbeat_message(1, 3, 0x81, 10, 4, 3)
    frame = bytes(beat.pack(link))
    assert frame[2] == 1
    path = tmp_path / "signed.tlog"
    path.write_bytes(b"".join(round((T0 + k) * 1e6).to_bytes(8, "big") + frame for k in range(4)))
    _, heard = aired(path, 1)
    assert {datagram[2] for datagram in heard} == {0}
    assert all(mav.MAVLink(None).parse_buffer(datagram)[0].get_srcSystem() == 9 for datagram in heard)


def test_more_aircraft_than_system_ids_are_refused(tmp_path):
    path = tmp_path / "one.tlog"
    path.write_bytes(log_of(seconds=1.0))
    airing = Broadcaster(path, 100.0, range(251), 251, IdAllocator(1, 250))
    airing.send(("127.0.0.1", 9), threading.Event())
    assert "found all 250 taken" in airing.problem


@pytest.mark.parametrize("to", ["192.0.2.7:14550", "0.0.0.0:14550", "[2001:db8::1]:14550"])
def test_only_this_machine_is_sent_to(to):
    with pytest.raises(ValueError, match=r"--to: found .* another machine, expected a loopback address.*;"):
        loopback_address(to)


@pytest.mark.parametrize("to", ["14550", "127.0.0.1:", "127.0.0.1:0", "no.such.host.invalid:14550"])
def test_what_is_no_address_is_refused(to):
    with pytest.raises(ValueError, match=r"--to: found"):
        loopback_address(to)


def test_loopback_has_several_names():
    assert loopback_address("127.0.0.1:14550") == ("127.0.0.1", 14550)
    assert ipaddress.ip_address(loopback_address("localhost:14550")[0]).is_loopback


# --- the command -----------------------------------------------------------------------------------------------------


def command(*arguments):
    return subprocess.Popen(
        [sys.executable, "-m", "fleet.cli", "replay", *map(str, arguments)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stderr=subprocess.PIPE,
        text=True,
    )


def test_the_command_sends_and_ctrl_c_ends_it(tmp_path):
    path = tmp_path / "one.tlog"
    path.write_bytes(log_of(seconds=60.0))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", 0))
        ear.settimeout(PATIENCE_S)
        with command(path, "--copies", "3", "--to", f"127.0.0.1:{ear.getsockname()[1]}") as child:
            systems = {ear.recv(65_535)[5] for _ in range(60)}
            began = time.monotonic()
            child.send_signal(signal.SIGINT)
            _, errors = child.communicate(timeout=PATIENCE_S)
    assert systems == {7, 8, 9}
    assert child.returncode == 0 and time.monotonic() - began < 20  # of 60 s
    assert "3 aircraft" in errors and "Traceback" not in errors


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--to", "192.0.2.7:14550"], "loopback"),
        (["--copies", "0"], "--copies: found 0"),
        (["--copies", "2", "--results"], "--results: found --copies too"),
        (["--speed", "fast"], "speed: found 'fast'"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_sentence(tmp_path, capsys, options, words):
    path = tmp_path / "one.tlog"
    path.write_bytes(log_of(seconds=1.0))
    code, errors = main(["replay", str(path), *options]), capsys.readouterr().err
    assert code == 2 and errors.count("\n") == 1 and words in errors
