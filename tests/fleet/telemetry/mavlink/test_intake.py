import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.contract import Link, Mission, Params, Sample, Status
from fleet.telemetry.mavlink.aircraft_link import AircraftLink
from fleet.telemetry.mavlink.intake import SECOND_SENDER, MavlinkReceiver
from tests.support.talker import ARDU, PLANE, T0, Talker, of


@pytest.mark.parametrize(
    ("beat", "mode", "vehicle", "name"),
    [
        ((PLANE, ARDU, 0x81, 10), "AUTO", "fixed_wing", "ardupilot"),
        ((PLANE, ARDU, 0x01, 5), "FBWA", "fixed_wing", "ardupilot"),
        ((mav.MAV_TYPE_QUADROTOR, ARDU, 0x81, 3), "AUTO", "multirotor", "ardupilot"),
        ((mav.MAV_TYPE_HELICOPTER, ARDU, 0x81, 6), "RTL", "helicopter", "ardupilot"),
        ((mav.MAV_TYPE_VTOL_DUOROTOR, mav.MAV_AUTOPILOT_PX4, 0x81, 0x04040000), "MISSION", "quadplane", "px4"),
        ((mav.MAV_TYPE_FIXED_WING, mav.MAV_AUTOPILOT_GENERIC, 0x80, 0), None, "fixed_wing", "generic"),
    ],
)
def test_heartbeats_name_mode_vehicle_and_autopilot(beat, mode, vehicle, name):
    intake = MavlinkReceiver(offset=-1)
    intake.receive(T0, Talker(7).heartbeat(*beat))
    (status,) = of(Status, intake.flush(T0))
    assert (status.uav, status.vehicle, status.autopilot, status.armed) == (6, vehicle, name, beat[2] > 0x7F)
    assert mode is None or status.mode == mode


@pytest.mark.parametrize(
    "kind",
    [mav.MAV_TYPE_GCS, mav.MAV_TYPE_GIMBAL, mav.MAV_TYPE_CAMERA, mav.MAV_TYPE_ADSB, mav.MAV_TYPE_GROUND_ROVER, 99],
)
def test_what_does_not_fly_is_no_uav(kind):
    intake = MavlinkReceiver()
    intake.receive(T0, Talker().heartbeat(kind) + Talker(9).attitude(1.0))
    intake.receive(T0, Talker().heartbeat(PLANE, mav.MAV_AUTOPILOT_INVALID))
    assert intake.flush(T0 + 5) == []
    assert intake.rejected == {"not an aircraft": 2, "no aircraft heartbeat yet": 1}


def test_a_gimbal_on_the_same_system_is_not_the_aircraft():
    intake = MavlinkReceiver()
    intake.receive(
        T0, Talker().heartbeat() + Talker(7, 154).heartbeat(mav.MAV_TYPE_GIMBAL) + Talker(7, 154).attitude(1)
    )
    assert of(Sample, intake.flush(T0 + 0.1)) == []


def test_losses_are_counted_from_gaps():
    intake, talker = MavlinkReceiver(), Talker()
    intake.receive(T0, talker.heartbeat())
    frames = [talker.attitude(1 + i * 0.1) for i in range(300)]
    for i, frame in enumerate(frames):
        if i % 10:
            intake.receive(T0 + i * 0.1, frame)
    (status,) = of(Status, intake.flush(T0 + 30))
    assert (status.received, status.missed) == (271, 30)


def test_status_once_a_second_and_on_change():
    intake, talker = MavlinkReceiver(), Talker()
    told = []
    for step in range(100):
        if step % 10 == 0:
            intake.receive(T0 + step * 0.1, talker.heartbeat(custom=10 if step < 45 else 11))
        told += of(Status, intake.flush(T0 + step * 0.1))
    assert 10 <= len(told) <= 12
    assert [s.mode for s in told][-1] == "RTL"
    assert told[-1].rates_hz["HEARTBEAT"] == pytest.approx(1.0, abs=0.15)


def test_a_lost_link_is_told_and_comes_back():
    intake, talker = MavlinkReceiver(), Talker()
    intake.receive(T0, talker.heartbeat())
    links = []
    for step in range(80):
        if step == 60:
            intake.receive(T0 + 6.0, talker.heartbeat())
        links += [(step, s.link, s.sentence) for s in of(Status, intake.flush(T0 + step * 0.1))]
    lost = [step for step, link, _ in links if link is Link.LOST]
    assert 30 <= lost[0] <= 32
    assert 50 <= lost[-1] <= 59
    assert links[-1][1] is Link.LIVE
    assert "no message for" in next(sentence for step, _, sentence in links if step == lost[-1])


def test_a_second_sender_for_a_live_id_is_refused_until_the_first_is_silent():
    claims: dict = {}
    one, two = MavlinkReceiver(0, claims), MavlinkReceiver(0, claims)
    one.receive(T0, Talker().heartbeat(), "a")
    one.receive(T0 + 0.1, Talker().attitude(50.0), "b")
    two.receive(T0 + 0.2, Talker().heartbeat(), "c")
    two.receive(T0 + 0.2, Talker().attitude(70.0), "c")
    news = one.flush(T0 + 0.3) + two.flush(T0 + 0.3)
    assert one.rejected["second sender for a live id"] == 1
    assert two.rejected["second sender for a live id"] == 2
    assert of(Sample, news) == []
    assert "second sender" in of(Status, news)[0].sentence
    two.receive(T0 + 9.0, Talker().heartbeat(), "c")
    assert [s.uav for s in of(Status, two.flush(T0 + 9.1) + one.flush(T0 + 9.1))] == [7]


def test_a_download_and_an_upload_are_overheard():
    plane, station = Talker(), Talker(255, 190)
    intake = MavlinkReceiver()
    intake.receive(T0, plane.heartbeat())
    intake.receive(T0 + 1, plane.mission(plane.item(0), plane.item(1, 22), plane.item(2, x=470010000)))
    (mission,) = of(Mission, intake.flush(T0 + 1.1))
    assert (mission.complete, [i.command for i in mission.items], mission.seq) == (True, [16, 22, 16], -1)
    intake.receive(T0 + 2, plane.pack(mav.MAVLink_mission_current_message(1)))
    assert of(Mission, intake.flush(T0 + 2.1))[0].seq == 1
    upload = [
        mav.MAVLink_mission_count_message(7, 1, 1),
        mav.MAVLink_mission_item_message(7, 1, 0, 3, 16, 0, 1, 0, 0, 0, math.nan, 47.5, -8.25, 99.0),
    ]
    intake.receive(T0 + 3, station.pack(*upload))
    assert of(Mission, intake.flush(T0 + 3.1)) == []  # not accepted yet
    intake.receive(T0 + 4, plane.pack(mav.MAVLink_mission_ack_message(255, 190, 0)))
    (mission,) = of(Mission, intake.flush(T0 + 4.1))
    assert [(i.lat_e7, i.lon_e7, i.alt_m) for i in mission.items] == [(475000000, -82500000, 99.0)]
    assert mission.sentence == ""  # param4 = nan keeps the yaw; that is legal


def test_a_part_of_a_mission_is_shown_as_such():
    intake, plane = MavlinkReceiver(), Talker()
    intake.receive(T0, plane.heartbeat() + plane.count(3) + plane.item(0) + plane.item(2))
    (mission,) = of(Mission, intake.flush(T0 + 2.5))
    assert not mission.complete
    assert "2 of 3" in mission.sentence


def test_parameters_of_px4_hide_integers_in_floats():
    intake, talker = MavlinkReceiver(), Talker()
    intake.receive(T0, talker.heartbeat(PLANE, mav.MAV_AUTOPILOT_PX4))
    as_float = float(np.frombuffer(np.int32(-7).tobytes(), "<f4")[0])
    packed = bytearray(talker.param("NAV_ACC", 1.0, 0, 1, mav.MAV_PARAM_TYPE_INT32))
    assert math.isnan(as_float)  # which is why it may not be judged before it is read
    intake.receive(T0 + 1, _replace_payload(packed, np.int32(-7).tobytes()))
    (params,) = of(Params, intake.flush(T0 + 2))
    assert params.values == {"NAV_ACC": -7.0}
    assert params.complete


def _replace_payload(frame, value):
    frame[10:14] = value
    crc = mav.x25crc(bytes(frame[1:-2]) + bytes([mav.MAVLink_param_value_message.crc_extra])).crc
    return bytes(frame[:-2]) + crc.to_bytes(2, "little")


def test_state_that_is_sent_again_is_not_processed_again_and_a_change_is(monkeypatch):
    intake, talker, processed = MavlinkReceiver(), Talker(), []
    monkeypatch.setattr(AircraftLink, "process", lambda link, message, now: processed.append(message.get_type()))
    item = [talker.pack(mav.MAVLink_mission_current_message(seq)) for seq in (1, 1, 2)]
    beats = [talker.heartbeat(custom=mode) for mode in (10, 10, 11, 10)]
    intake.receive(T0 - 1, talker.heartbeat())
    intake.flush(T0 - 1)  # registers
    processed.clear()
    for k, data in enumerate((beats[0] + item[0], beats[1] + item[1], beats[2] + item[2], beats[3])):
        intake.receive(T0 + k, data)
    intake.flush(T0 + 10)  # in one batch
    assert processed == ["HEARTBEAT", "MISSION_CURRENT", "HEARTBEAT", "MISSION_CURRENT", "HEARTBEAT"]
    processed.clear()
    for k, data in enumerate((beats[3], item[2], beats[2])):  # in a batch each
        intake.receive(T0 + 11 + k, data)
        intake.flush(T0 + 11 + k)
    assert processed == ["HEARTBEAT"]
    intake.aircraft[7].observer = lambda *_: None
    intake.receive(T0 + 15, beats[2] + item[2])
    intake.flush(T0 + 15)
    assert processed == ["HEARTBEAT"] * 2 + ["MISSION_CURRENT"]


def test_state_that_is_sent_again_keeps_an_aircraft_alive_and_is_counted():
    intake, talker = MavlinkReceiver(), Talker()
    for k in range(20):
        intake.receive(T0 + k, talker.heartbeat())
        news = intake.flush(T0 + k)
    (status,) = of(Status, news)
    assert (status.received, status.link, status.mode) == (20, Link.LIVE, "AUTO")
    assert status.rates_hz["HEARTBEAT"] == pytest.approx(1.0, abs=0.05)


def test_the_state_of_a_second_sender_is_no_repetition():
    intake, talker = MavlinkReceiver(), Talker()
    for source in ("a", "a", "b", "a", "b"):
        intake.receive(T0, talker.heartbeat(), source)
    intake.flush(T0 + 0.1)
    assert intake.rejected == {SECOND_SENDER: 2}
