"""Whatever comes from outside: nothing raises, the others keep flowing, counters and sentences tell."""

import math
import struct

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.contract import MAX_ITEMS, Mission, Params, Sample, Status
from fleet.telemetry.mavlink.arrays.pack import MAX_ROWS
from fleet.telemetry.mavlink.intake import MavlinkReceiver
from fleet.telemetry.mavlink.parsing.decode import MAX_SENDERS
from tests.support.talker import T0, Talker, of

DO_JUMP, LAND = 177, 21
NAN = math.nan


class Air:
    """One link with a good aircraft 8 that must keep flowing, and a bad one, 7."""

    def __init__(self):
        self.intake, self.bad, self.good = MavlinkReceiver(), Talker(7), Talker(8)
        self.t, self.news = T0, []
        self.hear(self.bad.heartbeat(), 0.0)

    def hear(self, data: bytes, passed: float = 0.1, source=None) -> list:
        """Let bytes arrive from the bad one, then the good one's, then publish."""
        self.t += passed
        self.intake.receive(self.t, data, source)
        self.intake.receive(self.t, self.good.heartbeat() + self.good.attitude(self.t - T0), "good")
        news = self.intake.flush(self.t)
        self.news += news
        assert of(Sample, news, 8), "the good aircraft stopped flowing"
        return news


def test_a_megabyte_of_random_bytes_disturbs_nobody():
    air, junk = Air(), np.random.default_rng(2024).bytes(1_000_000)
    for start in range(0, len(junk), 5000):
        air.hear(junk[start : start + 5000], source=("10.0.0.9", start))  # every time another sender
    assert {m.uav for m in air.news} == {7, 8}
    assert air.intake.decoder.counters()["bad_bytes"] > 950_000
    assert of(Status, air.news, 8)[-1].rejected == 0
    assert of(Status, air.news, 8)[-1].missed == 0


def test_random_bytes_between_the_frames_of_one_stream():
    air, rng, sent = Air(), np.random.default_rng(7), 0
    for step in range(200):
        air.hear(rng.bytes(1000) + air.bad.attitude(step * 0.1) + rng.bytes(300))
        sent += 1
    assert sum(len(s.attitude.t.numpy()) for s in of(Sample, air.news, 7)) >= sent - 1


def test_endless_senders_do_not_fill_the_memory():
    intake = MavlinkReceiver()
    for port in range(3 * MAX_SENDERS):
        intake.receive(T0, b"\xfd\xff\0", ("10.0.0.9", port))
    intake.flush(T0)
    assert len(intake.decoder._carry) == MAX_SENDERS


def test_a_flood_from_one_aircraft_is_cut():
    air = Air()
    for step in range(20):
        air.hear(air.bad.attitude(1 + step * 0.1))
    flood = b"".join(air.bad.attitude(3 + i * 1e-3) for i in range(MAX_ROWS + 500))
    air.hear(flood)
    (status,) = of(Status, air.hear(b"", 1.0), 7)
    assert status.rejected == 500


def mission_of(air, data) -> Mission:
    missions = of(Mission, air.hear(data), 7)
    assert len(missions) == 1
    return missions[0]


def test_a_mission_without_items():
    air = Air()
    mission = mission_of(air, air.bad.count(0))
    assert (mission.items, mission.complete) == ((), True)
    assert "uav-7: the mission has no items" in mission.sentence


@pytest.mark.parametrize("lost", ["x", "y", "z", "inf"])
def test_a_mission_with_nan_keeps_its_numbering(lost):
    air = Air()
    place = {"x": (NAN, 8.0, 50.0), "y": (47.0, NAN, 50.0), "z": (47.0, 8.0, NAN), "inf": (47.0, 8.0, math.inf)}[lost]
    bad = mav.MAVLink_mission_item_message(255, 190, 1, 3, 16, 0, 1, 0, 0, 0, 0, *place)
    mission = mission_of(air, air.bad.mission(air.bad.item(0), air.bad.pack(bad), air.bad.item(2)))
    assert [i.seq for i in mission.items] == [0, 1, 2]
    assert mission.items[1].command == 0  # nobody flies to a place that was made up
    assert mission.items[1].lat_e7 == mission.items[1].lon_e7 == mission.items[1].alt_m == 0
    assert "item 1 has an invalid coordinate" in mission.sentence
    assert of(Status, air.hear(b"", 1.0), 7)[0].rejected == 1


def test_a_mission_parameter_that_is_nan():
    air = Air()
    bad = mav.MAVLink_mission_item_int_message(255, 190, 1, 3, 18, 0, 1, NAN, 0, NAN, NAN, 1, 2, 3.0)
    mission = mission_of(air, air.bad.mission(air.bad.item(0), air.bad.pack(bad)))
    assert (mission.items[1].param1, mission.items[1].param3, mission.items[1].command) == (0, 0, 18)
    assert "item 1 has a non-finite parameter" in mission.sentence


@pytest.mark.parametrize("targets", [(1, 1), (2, 1), (9, 9), (-3, 1)])
def test_a_mission_of_jumps_that_lead_nowhere(targets):
    air = Air()
    jumps = [air.bad.item(seq, DO_JUMP, x=0, y=0, z=0, p1=to) for seq, to in zip((1, 2), targets, strict=True)]
    mission = mission_of(air, air.bad.mission(air.bad.item(0), *jumps))
    assert len(mission.items) == 3
    assert "jump of item 1 never reaches a waypoint" in mission.sentence


def test_a_jump_back_to_a_waypoint_is_a_mission_like_any_other():
    air = Air()
    items = [air.bad.item(0), air.bad.item(1, x=1), air.bad.item(2, x=2), air.bad.item(3, DO_JUMP, x=0, y=0, z=0, p1=1)]
    assert mission_of(air, air.bad.mission(*items)).sentence == ""


def test_legs_without_length():
    air = Air()
    mission = mission_of(air, air.bad.mission(*[air.bad.item(seq) for seq in range(4)], air.bad.item(4, LAND)))
    assert "the leg from item 1 to 2 has no length" in mission.sentence
    assert len(mission.items) == 5


def test_a_mission_that_is_too_long_is_refused():
    air = Air()
    mission = mission_of(air, air.bad.count(MAX_ITEMS + 1))
    assert (mission.items, mission.complete) == ((), False)
    assert f"at most {MAX_ITEMS}" in mission.sentence
    assert air.hear(air.bad.item(60_000))


@pytest.mark.parametrize("jump", [-20.0, -1000.0, 500.0])
def test_a_clock_that_jumps(jump):
    air = Air()
    for step in range(200):
        air.hear(air.bad.attitude(2000 + step * 0.1 + (jump if step >= 100 else 0)))
    times = np.concatenate([s.attitude.t.numpy() for s in of(Sample, air.news, 7)])
    assert len(times) >= 197
    assert (np.diff(times) > 0).all()
    assert times[-1] == pytest.approx(air.t, abs=0.2)
    status = of(Status, air.news, 7)[-1]
    assert status.clock_jumps == 1
    assert "clock jumped" in status.sentence
    assert of(Status, air.news, 8)[-1].clock_jumps == 0


def test_a_clock_that_runs_wild():
    air, rng = Air(), np.random.default_rng(9)
    for _ in range(300):
        air.hear(air.bad.attitude(float(rng.uniform(0, 4e6))))
    times = [t for s in of(Sample, air.news, 7) for t in s.attitude.t.numpy()]
    assert (np.diff(times) > 0).all()
    assert of(Status, air.news, 7)[-1].clock_jumps > 0


def test_parameters_that_are_no_numbers():
    air = Air()
    values = (("GOOD", 1.5), ("BAD", NAN), ("WORSE", -math.inf))
    air.hear(b"".join(air.bad.param(name, value, i, 3) for i, (name, value) in enumerate(values)))
    (params,) = of(Params, air.news, 7)
    assert params.values == {"GOOD": 1.5}
    assert "BAD, WORSE is not a number" in params.sentence
    assert params.complete
    air.hear(air.bad.param("BAD", 2.0) + air.bad.param("WORSE", 3.0), 1.1)
    params = of(Params, air.news, 7)[-1]
    assert (params.values, params.sentence) == ({"GOOD": 1.5, "BAD": 2.0, "WORSE": 3.0}, "")
    air.hear(air.bad.param("GOOD", NAN), 1.1)
    assert "GOOD" not in of(Params, air.news, 7)[-1].values  # what is no longer known is not kept alive


def test_parameter_names_that_are_no_text():
    air = Air()
    air.hear(air.bad.pack(mav.MAVLink_param_value_message(b"\x01\xff\xfe", 1.0, 9, 2, 0)))
    assert of(Params, air.news, 7)[0].values == {}


def test_every_telemetry_field_that_is_nan_is_refused():
    air = Air()
    sent = [
        mav.MAVLink_attitude_message(1, *[NAN] * 6),
        mav.MAVLink_highres_imu_message(1, *[NAN] * 13, 63),
        mav.MAVLink_vfr_hud_message(NAN, 1, 0, 50, 1, NAN),
        mav.MAVLink_nav_controller_output_message(NAN, 0, 0, 0, 0, NAN, 0, 0),
        mav.MAVLink_global_position_int_message(1, 2**31 - 1, 2**31 - 1, 2**31 - 1, 0, 0, 0, 0, 0),
    ]
    air.hear(air.bad.pack(*sent))
    (status,) = of(Status, air.hear(b"", 1.0), 7)
    assert status.rejected == 5
    (sample,) = of(Sample, air.news, 7)
    assert [f for f in ("attitude", "imu", "position", "air", "command") if getattr(sample, f)] == []
    assert sample.velocity is not None


def test_a_signed_frame_and_a_truncated_one():
    air = Air()
    frame = bytearray(air.bad.attitude(1.0))
    frame[2] |= 1
    crc = mav.x25crc(bytes(frame[1:-2]) + bytes([mav.MAVLink_attitude_message.crc_extra])).crc
    signed = bytes(frame[:-2]) + struct.pack("<H", crc) + bytes(13)
    air.hear(signed + air.bad.attitude(1.1)[:20])
    air.hear(b"")
    assert len(of(Sample, air.news, 7)) == 1
