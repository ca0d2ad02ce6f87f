"""The voice of the pretend aircraft: rates, protocols, recordings and UDP as ArduPlane would."""

import socket
import struct
from collections import Counter
from itertools import pairwise
from math import pi
from threading import Event

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.frames import to_ned
from fleet.simulator.flight import drive
from fleet.simulator.flight.drive import RadioLink
from fleet.simulator.flight.mavlink import MavlinkEndpoint
from fleet.simulator.flight.mavlink_messages import ARDUPLANE_MODES, TELEMETRY
from fleet.simulator.flight.tuning import tuned_parameters
from fleet.simulator.flight.uav import SimulatedUav
from fleet.simulator.vehicle.jsbsim import DT
from fleet.simulator.vehicle.sensors import servo_commands, servo_pulses


def heard(frames: list[bytes]) -> list:
    ear = mav.MAVLink(None)
    return [message for frame in frames for message in (ear.parse_buffer(frame) or [])]


def ask(message: mav.MAVLink_message) -> bytes:
    return bytes(message.pack(mav.MAVLink(None, srcSystem=255, srcComponent=190)))


@pytest.fixture(scope="module")
def flown() -> tuple[SimulatedUav, list]:
    """Forty seconds of one aircraft, and everything it said."""
    uav = SimulatedUav(4, seed=11, wind=3.0, turbulence=2)
    frames = [frame for k in range(4_000) for frame in uav.step((k + 1) * DT)]
    return uav, heard(frames)


def test_frames_come_at_their_rates(flown: tuple[SimulatedUav, list]) -> None:
    uav, said = flown
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in said} == {(uav.uav_id + 1, 1)}
    counts = Counter(m.get_type() for m in said)
    wanted = {
        "ATTITUDE": 25,
        "HIGHRES_IMU": 25,
        "SERVO_OUTPUT_RAW": 20,
        "GLOBAL_POSITION_INT": 10,
        "VFR_HUD": 10,
        "NAV_CONTROLLER_OUTPUT": 5,
        "MISSION_CURRENT": 1,
        "HEARTBEAT": 1,
        "SYS_STATUS": 1,
    }
    assert counts == {name: rate * 40 for name, rate in wanted.items()}
    assert len(TELEMETRY) == len(wanted) + 1  # a destination only outside the mission


def test_sequence_numbers_count_and_clocks_run(flown: tuple[SimulatedUav, list]) -> None:
    _, said = flown
    assert {(b.get_seq() - a.get_seq()) % 256 for a, b in pairwise(said)} == {1}
    boots = np.array([m.time_boot_ms for m in said if m.get_type() == "ATTITUDE"])
    assert set(np.diff(boots)) == {40}
    assert 60_000 <= boots[0] <= 601_000


def test_what_it_says_agrees_with_where_it_is(flown: tuple[SimulatedUav, list]) -> None:
    uav, said = flown
    x = uav.aircraft.truth()
    last = {m.get_type(): m for m in said}
    place = last["GLOBAL_POSITION_INT"]
    ned = to_ned(uav.origin, *np.array([[place.lat, place.lon, place.alt]]).T)[0]
    assert np.abs(ned - x.p).max() < 6
    assert place.relative_alt * 1e-3 == pytest.approx(-ned[2], abs=0.01)
    assert [place.vx / 100, place.vy / 100, place.vz / 100] == pytest.approx(x.v, abs=1.5)
    assert abs((last["ATTITUDE"].yaw - x.euler[2] + pi) % (2 * pi) - pi) < 0.1
    assert last["VFR_HUD"].airspeed == pytest.approx(x.Va * np.sqrt(x.rho / 1.225), abs=3)
    assert last["HIGHRES_IMU"].zacc == pytest.approx(x.force[2], abs=8)
    beat = last["HEARTBEAT"]
    assert (beat.type, beat.autopilot, beat.custom_mode) == (1, 3, ARDUPLANE_MODES["AUTO"])
    assert beat.base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED


def test_mission_protocol(flown: tuple[SimulatedUav, list]) -> None:
    uav, _ = flown
    (count,) = heard(uav.receive(ask(mav.MAVLink_mission_request_list_message(5, 1))))
    assert (count.get_type(), count.count, count.target_system) == ("MISSION_COUNT", len(uav.items), 255)
    for item in uav.items:
        (sent,) = heard(uav.receive(ask(mav.MAVLink_mission_request_int_message(5, 1, item.seq))))
        assert (sent.seq, sent.command, sent.frame, sent.x, sent.y) == (
            *(item.seq, item.command, item.frame),
            *(item.lat_e7, item.lon_e7),
        )
        assert [sent.param1, sent.param2, sent.param3, sent.z] == pytest.approx(
            [item.param1, item.param2, item.param3, item.alt_m], rel=1e-5
        )
    (old,) = heard(uav.receive(ask(mav.MAVLink_mission_request_message(5, 1, 1))))
    assert (old.get_type(), old.x) == ("MISSION_ITEM", pytest.approx(uav.items[1].lat_e7 * 1e-7, abs=1e-5))
    (refused,) = heard(uav.receive(ask(mav.MAVLink_mission_request_int_message(5, 1, 999))))
    assert (refused.get_type(), refused.type) == ("MISSION_ACK", mav.MAV_MISSION_INVALID_SEQUENCE)


def test_parameter_protocol() -> None:
    params = tuned_parameters(3)
    voice = MavlinkEndpoint(7, (), params)
    assert voice.receive(ask(mav.MAVLink_param_request_list_message(7, 1)), 1.0) == []
    sent = heard(voice.stream_parameters(10_000))
    assert {m.param_id: m.param_value for m in sent} == {k: np.float32(v) for k, v in params.items()}
    assert [m.param_index for m in sent] == list(range(len(params)))
    assert {m.param_count for m in sent} == {len(params)}
    (named,) = heard(voice.receive(ask(mav.MAVLink_param_request_read_message(7, 1, b"WP_RADIUS", -1)), 1.0))
    assert (named.param_id, named.param_value) == ("WP_RADIUS", params["WP_RADIUS"])
    (third,) = heard(voice.receive(ask(mav.MAVLink_param_request_read_message(7, 1, b"", 3)), 1.0))
    assert (third.param_index, third.param_id) == (3, sorted(params)[3])
    for index, name in ((9_999, b""), (-1, b"NO_SUCH")):
        assert voice.receive(ask(mav.MAVLink_param_request_read_message(7, 1, name, index)), 1.0) == []


def test_parameters_are_streamed_while_it_flies() -> None:
    uav = SimulatedUav(0, 5)
    uav.receive(ask(mav.MAVLink_param_request_list_message(1, 1)))
    counts = Counter(m.get_type() for m in heard(uav.step(1.0)))
    assert counts["PARAM_VALUE"] == len(uav.params)
    assert counts["ATTITUDE"] == 25


def test_servo_parameters_say_what_is_wired_where() -> None:
    params = tuned_parameters(0)
    assert [params[f"SERVO{i}_FUNCTION"] for i in (1, 2, 3, 4)] == [4, 19, 70, 21]
    assert servo_pulses(-1.0, 0.5, 2.0, 0.25) == (1100, 1700, 1250, 1900)
    assert servo_commands((1100, 1700, 1250, 1900)) == (-1.0, 0.5, 1.0, 0.25)
    assert tuned_parameters(0) == params
    assert tuned_parameters(1) != params


def test_version_and_unknown_commands_are_answered_politely() -> None:
    voice = MavlinkEndpoint(7, (), {})
    asked = mav.MAVLink_command_long_message(7, 1, mav.MAV_CMD_REQUEST_MESSAGE, 0, 148, 0, 0, 0, 0, 0, 0)
    ack, version = heard(voice.receive(ask(asked), 1.0))
    assert (ack.result, version.get_type()) == (mav.MAV_RESULT_ACCEPTED, "AUTOPILOT_VERSION")
    assert version.capabilities & mav.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    unknown = mav.MAVLink_command_long_message(7, 1, mav.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 0, 0)
    assert [m.result for m in heard(voice.receive(ask(unknown), 1.0))] == [mav.MAV_RESULT_UNSUPPORTED]
    for_another = mav.MAVLink_mission_request_list_message(8, 1)
    assert voice.receive(ask(for_another), 1.0) == []


def test_noise_is_passed_over() -> None:
    voice = MavlinkEndpoint(7, (), {"A": 1.0})
    rng = np.random.default_rng(1)
    assert voice.receive(rng.bytes(5_000), 1.0) == []
    voice.receive(b"\x00" * 300, 1.0)
    assert heard(voice.receive(ask(mav.MAVLink_param_request_read_message(7, 1, b"A", -1)), 1.0))[0].param_value == 1.0


def test_the_link_loses_delays_and_keeps_order() -> None:
    link = RadioLink(np.random.default_rng(4), 0.2)
    for k in range(1_000):
        link.send(k * 0.01, [struct.pack("<I", k)])
    arrived = link.receive(100.0)
    assert 700 < len(arrived) < 900
    numbers = [struct.unpack("<I", frame)[0] for _, frame in arrived]
    assert numbers == sorted(numbers)
    assert all(t > n * 0.01 for (t, _), n in zip(arrived, numbers, strict=True))
    assert link.receive(100.0) == []


def test_a_recording_stands_by_itself(tmp_path) -> None:
    path = tmp_path / "two.tlog"
    uavs = [SimulatedUav(i, 5) for i in (0, 1)]
    written = drive.to_tlog(path, uavs, seconds=2, loss=0.0, seed=5)
    data, at, stamps, frames = path.read_bytes(), 0, [], []
    while at < len(data):
        length = data[at + 9] + 12  # MAVLink 2, unsigned
        stamps.append(struct.unpack_from(">Q", data, at)[0])
        frames.append(data[at + 8 : at + 8 + length])
        at += 8 + length
    said = heard(frames)
    assert written == len(frames) == len(said)
    assert stamps == sorted(stamps)
    assert stamps[-1] - stamps[0] == pytest.approx(2e6, abs=3e4)
    for uav in uavs:
        own = Counter(m.get_type() for m in said if m.get_srcSystem() == uav.uav_id + 1)
        assert own["PARAM_VALUE"] == len(uav.params)
        assert own["MISSION_ITEM_INT"] == len(uav.items)
        assert own["ATTITUDE"] == pytest.approx(50, abs=1)


def test_it_flies_over_udp_and_answers() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ground:
        ground.bind(("127.0.0.1", 0))
        ground.settimeout(10)
        uavs = [SimulatedUav(i, 5) for i in (0, 1)]
        asked, said = set(), []

        class Answering(Event):
            """Stands for the pause between two rounds: here the ground reads and asks."""

            def wait(self, timeout: float | None = None) -> bool:
                ground.setblocking(False)
                try:
                    while True:
                        data, sender = ground.recvfrom(4_096)
                        said.extend(heard([data]))
                        if sender not in asked:
                            asked.add(sender)
                            system = said[-1].get_srcSystem()
                            ground.sendto(ask(mav.MAVLink_mission_request_list_message(system, 1)), sender)
                except BlockingIOError:
                    pass
                if sum(m.get_type() == "MISSION_COUNT" for m in said) == 2:
                    self.set()
                return super().wait(0.001)

        stop = Answering()
        drive.to_udp(uavs, ground.getsockname(), seconds=20, loss=0.0, seed=5, stop=stop)
    assert stop.is_set()
    assert {m.get_srcSystem() for m in said} == {1, 2}
    assert len(asked) == 2  # one socket each
