import lzma
import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav
from talker import ARDU, PLANE, T0, Talker, recording

from fleet.contract import COLUMNS, Link, Mission, Params, Sample, Status
from fleet.telemetry.clock import WRAP_BOOT_S, WRAP_USEC_S, Clock, Clocks
from fleet.telemetry.decode import Decoder
from fleet.telemetry.dialects.mavlink import HIGHEST, ROWS, TABLE, Tick, believable
from fleet.telemetry.intake import Intake
from fleet.telemetry.recordings import records, replay_messages
from fleet.telemetry.restamp import backlog_offset, boot_s, restamped

S02 = "sitl/s02_nominal_light_wind.tlog.xz"


def of(kind, messages):
    return [m for m in messages if isinstance(m, kind)]


def columns(message: str, field: str, sent, autopilot: str = "ardupilot") -> dict[str, float]:
    """Send one message through the wire and the table."""
    (heard,) = Decoder().feed(Talker().pack(sent))
    (row,) = [r for r in ROWS[message] if r.field == field and (not r.autopilots or autopilot in r.autopilots)]
    return dict(zip([name for name, _ in COLUMNS[field]], row.columns(heard), strict=True))


# ---- the table -------------------------------------------------------------------------------------------------


def test_every_row_names_a_message_and_fills_its_columns():
    for row in TABLE:
        kind = next(k for k in mav.mavlink_map.values() if k.msgname == row.message)
        blank = kind(
            *[
                b"" if t == "char" else 0 if n <= 1 else [0] * n
                for t, n in zip(kind.fieldtypes, _array_lengths(kind), strict=True)
            ]
        )
        assert len(row.columns(blank)) == len(COLUMNS[row.field]) == len(HIGHEST[row.field])


def _array_lengths(kind):
    return [kind.array_lengths[kind.ordered_fieldnames.index(name)] for name in kind.fieldnames]


def test_attitude_is_in_radians():
    got = columns("ATTITUDE", "attitude", mav.MAVLink_attitude_message(5, 0.5, -0.25, 3.0, 0.125, -1.0, 2.0))
    assert got == {"phi": 0.5, "theta": -0.25, "psi": 3.0, "p": 0.125, "q": -1.0, "r": 2.0}


def test_milli_g_and_millirad_become_si():
    got = columns("RAW_IMU", "imu", mav.MAVLink_raw_imu_message(1, 1000, -500, -1000, 100, -200, 1500, 0, 0, 0))
    assert got == pytest.approx({"a_x": 9.80665, "a_y": -4.903325, "a_z": -9.80665, "p": 0.1, "q": -0.2, "r": 1.5})


def test_position_stays_integer_and_velocity_becomes_metres():
    sent = mav.MAVLink_global_position_int_message(9, -353632610, 1491652301, 584123, 1000, 1234, -567, 89, 0)
    assert columns("GLOBAL_POSITION_INT", "position", sent) == {"lat": -353632610, "lon": 1491652301, "alt": 584123}
    got = columns("GLOBAL_POSITION_INT", "velocity", sent)
    assert got == pytest.approx({"v_n": 12.34, "v_e": -5.67, "v_d": 0.89})


def test_hud_throttle_is_a_share():
    got = columns("VFR_HUD", "air", mav.MAVLink_vfr_hud_message(22.5, 20.0, 90, 55, 100.0, -1.5))
    assert got == pytest.approx({"Va": 22.5, "delta_t": 0.55, "climb": -1.5})


@pytest.mark.parametrize(("autopilot", "error"), [("ardupilot", 1.5), ("px4", 150.0)])
def test_commands_are_radians_and_ardupilot_speaks_centimetres(autopilot, error):
    sent = mav.MAVLink_nav_controller_output_message(30.0, -10.0, 0, 0, 0, 4.0, 150.0, -7.0)
    got = columns("NAV_CONTROLLER_OUTPUT", "command", sent, autopilot)
    want = {"phi_c": math.pi / 6, "theta_c": -math.pi / 18, "xtrack_error": -7.0, "alt_error": 4.0, "Va_error": error}
    assert got == pytest.approx(want)


def test_only_servo_port_0_counts():
    intake, talker = Intake(), Talker()
    intake.hear(T0, talker.heartbeat() + talker.attitude(5.0))
    for port in (0, 1):
        pulses = [1100 + 100 * port + i for i in range(8)]
        intake.hear(T0, talker.pack(mav.MAVLink_servo_output_raw_message(5_010_000 + port, port, *pulses)))
    (sample,) = of(Sample, intake.flush(T0 + 0.1))
    assert sample.servo.x.numpy().tolist() == [[1100 + i for i in range(8)]]


def test_the_better_imu_wins_and_the_other_returns_after_a_silence():
    intake, talker = Intake(), Talker()
    intake.hear(T0, talker.heartbeat())

    def raw(t):
        return talker.pack(mav.MAVLink_raw_imu_message(round(t * 1e6), 0, 0, -1000, 0, 0, 0, 0, 0, 0))

    def high(t):
        return talker.pack(mav.MAVLink_highres_imu_message(round(t * 1e6), 0, 0, -9.5, *[0.0] * 10, 63))

    intake.hear(T0, talker.attitude(5.0) + high(5.0) + raw(5.1))
    for step in range(1, 40):
        intake.hear(T0 + 0.1 * step, talker.attitude(5.0 + 0.1 * step))
    intake.hear(T0 + 4.0, raw(9.0))
    (sample,) = of(Sample, intake.flush(T0 + 4.1))
    assert sample.imu.x.numpy()[:, 2] == pytest.approx([-9.5, -9.80665], abs=1e-5)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e30])
def test_unbelievable_values_are_refused_counted_and_said(bad):
    assert not believable("velocity", (0.0, bad, 0.0))
    intake, talker = Intake(), Talker()
    intake.hear(T0, talker.heartbeat() + talker.attitude(1.0, phi=bad) + talker.attitude(1.1))
    news = intake.flush(T0 + 0.1)
    (sample,), (status,) = of(Sample, news), of(Status, news)
    assert len(sample.attitude.t.numpy()) == 1
    assert status.rejected == 1
    assert "uav-7: ATTITUDE" in status.sentence


def test_no_fix_is_no_position():
    intake, talker = Intake(), Talker()
    intake.hear(
        T0, talker.heartbeat() + talker.pack(mav.MAVLink_global_position_int_message(9, 0, 0, 5, 5, 0, 0, 0, 0))
    )
    assert of(Sample, intake.flush(T0 + 0.1)) == []


# ---- decoding --------------------------------------------------------------------------------------------------


def test_both_versions_in_pieces_of_any_size():
    talker = Talker()
    stream = b"".join(talker.pack(mav.MAVLink_attitude_message(i, 0, 0, 0, 0, 0, 0), v1=i % 2 == 0) for i in range(50))
    for size in (1, 3, 17, 1000):
        decoder = Decoder()
        found = [m for i in range(0, len(stream), size) for m in decoder.feed(stream[i : i + size])]
        assert [m.time_boot_ms for m in found] == list(range(50))
        assert decoder.bad_bytes == decoder.bad_frames == 0


def test_frames_inside_garbage_are_all_found():
    rng = np.random.default_rng(3)
    talker, decoder, found = Talker(), Decoder(), []
    for i in range(200):
        junk = rng.bytes(int(rng.integers(0, 60)))
        found += decoder.feed(junk + talker.pack(mav.MAVLink_attitude_message(i, 0, 0, 0, 0, 0, 0)))
    found += decoder.feed(b"\0" * 600)
    times = [m.time_boot_ms for m in found if m.get_type() == "ATTITUDE"]
    assert times == list(range(200))
    assert decoder.bad_bytes > 1000


def test_a_broken_checksum_costs_one_frame():
    talker, decoder = Talker(), Decoder()
    frames = [bytearray(talker.attitude(float(i))) for i in range(5)]
    frames[2][15] ^= 0x40
    assert [m.time_boot_ms for m in decoder.feed(b"".join(frames))] == [0, 1000, 3000, 4000]
    assert decoder.bad_frames == 1


def test_every_message_with_random_content_passes_through():
    rng = np.random.default_rng(11)
    intake = Intake()
    intake.hear(T0, Talker().heartbeat() + Talker(8).heartbeat(mav.MAV_TYPE_QUADROTOR, mav.MAV_AUTOPILOT_PX4))
    sender = mav.MAVLink(None, srcSystem=7, srcComponent=1)
    for step, kind in enumerate(list(mav.mavlink_map.values()) * 3):
        payload = rng.bytes(kind.unpacker.size)
        for sender.srcSystem in (7, 8, 255):
            frame = _frame(sender.srcSystem, kind, payload)
            intake.hear(T0 + step * 0.01, frame)
        for news in intake.flush(T0 + step * 0.01):
            assert_finite(news)


def _frame(system, kind, payload):
    head = bytes([len(payload), 0, 0, 0, system, 1]) + kind.id.to_bytes(3, "little")
    crc = mav.x25crc(head + payload + bytes([kind.crc_extra])).crc
    return b"\xfd" + head + payload + crc.to_bytes(2, "little")


def assert_finite(news):
    assert math.isfinite(news.t)
    if isinstance(news, Sample):
        for field in COLUMNS:
            rows = getattr(news, field)
            if rows is not None:
                assert np.isfinite(rows.t.numpy()).all()
                assert np.isfinite(rows.x.numpy()).all()
                assert (np.diff(rows.t.numpy()) > 0).all()
    elif isinstance(news, Params):
        assert all(map(math.isfinite, news.values.values()))
    elif isinstance(news, Mission):
        for i in news.items:
            assert all(map(math.isfinite, (i.param1, i.param2, i.param3, i.param4, i.alt_m)))


# ---- clocks ----------------------------------------------------------------------------------------------------


def test_the_fastest_message_tells_the_offset():
    rng = np.random.default_rng(1)
    clock, boot = Clock(), 100.0
    for _ in range(2000):
        boot += 0.04
        t = clock.fleet(boot, T0 + boot + 0.01 + rng.exponential(0.05))
    assert t == pytest.approx(T0 + boot + 0.01, abs=5e-3)
    assert clock.jumps == 0


def test_drift_is_followed():
    clock, t = Clock(), 0.0
    for step in range(10_000):
        true = step * 0.1
        t = clock.fleet(true * (1 - 100e-6), T0 + true)
    assert t == pytest.approx(T0 + true, abs=5e-3)  # 0.1 s would have built up


def test_32_bits_wrap_without_a_jump():
    for wrap in (WRAP_BOOT_S, WRAP_USEC_S):
        clock = Clock(wrap)
        times = [clock.fleet((wrap - 5 + s * 0.1) % wrap, T0 + s * 0.1) for s in range(100)]
        assert np.diff(times) == pytest.approx(0.1, abs=1e-3)
        assert clock.jumps == 0


@pytest.mark.parametrize("jump", [-50.0, -1e4, 40.0, 1e6])
def test_a_jump_is_counted_once_and_time_goes_on(jump):
    clock, times = Clock(), []
    for step in range(400):
        boot = 2e4 + step * 0.05 + (jump if step >= 200 else 0.0)
        times.append(clock.fleet(boot, T0 + step * 0.05))
    assert clock.jumps == 1
    kept = [t for t in times if t is not None]
    assert len(kept) >= 398
    assert (np.diff(kept) > 0).all()
    assert kept[-1] == pytest.approx(T0 + 399 * 0.05, abs=0.05)


def test_one_late_message_is_no_jump():
    clock = Clock()
    for step in range(100):
        clock.fleet(50 + step * 0.05, T0 + step * 0.05)
    assert clock.fleet(40.0, T0 + 5.0) is None
    assert clock.fleet(55.0, T0 + 5.0) == pytest.approx(T0 + 5.0, abs=1e-2)
    assert clock.jumps == 0


def test_a_stalled_radio_is_no_jump():
    clock = Clock()
    for step in range(100):
        clock.fleet(step * 0.05, T0 + step * 0.05)
    late = [clock.fleet(5 + step * 0.05, T0 + 10.0 + step * 1e-3) for step in range(100)]
    assert np.diff(late) == pytest.approx(0.05, abs=1e-3)
    assert clock.jumps == 0


def test_usec_counts_from_boot_or_from_1970_and_is_cut_to_32_bits():
    clocks = Clocks()
    boot = 3 * WRAP_USEC_S + 100
    t = clocks.fleet(Tick.BOOT_MS, boot, T0)
    assert clocks.fleet(Tick.USEC32, (boot + 0.02) % WRAP_USEC_S, T0 + 0.02) == pytest.approx(t + 0.02)
    assert clocks.fleet(Tick.USEC, boot + 0.03, T0 + 0.03) == pytest.approx(t + 0.03)
    unix = 1.6e9
    times = [clocks.fleet(Tick.USEC, unix + s * 0.1, T0 + 1 + s * 0.1) for s in range(50)]
    assert np.diff(times) == pytest.approx(0.1, abs=1e-6)
    assert times[0] == pytest.approx(T0 + 1)
    assert clocks.jumps == 0


def test_a_message_without_time_takes_the_newest():
    clocks = Clocks()
    assert clocks.fleet(Tick.NONE, 0.0, T0) == T0
    t = clocks.fleet(Tick.BOOT_MS, 9.0, T0 + 0.1)
    assert clocks.fleet(Tick.NONE, 0.0, T0 + 0.13) == pytest.approx(t + 0.03)
    assert clocks.fleet(Tick.NONE, 0.0, T0 + 60.0) == pytest.approx(t + 0.5)


# ---- intake ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "autopilot", "base", "custom", "mode", "vehicle", "name"),
    [
        (PLANE, ARDU, 0x81, 10, "AUTO", "fixed_wing", "ardupilot"),
        (PLANE, ARDU, 0x01, 5, "FBWA", "fixed_wing", "ardupilot"),
        (mav.MAV_TYPE_QUADROTOR, ARDU, 0x81, 3, "AUTO", "multirotor", "ardupilot"),
        (mav.MAV_TYPE_HELICOPTER, ARDU, 0x81, 6, "RTL", "helicopter", "ardupilot"),
        (mav.MAV_TYPE_VTOL_DUOROTOR, mav.MAV_AUTOPILOT_PX4, 0x81, 0x04040000, "MISSION", "quadplane", "px4"),
        (mav.MAV_TYPE_FIXED_WING, mav.MAV_AUTOPILOT_GENERIC, 0x80, 0, None, "fixed_wing", "generic"),
    ],
)
def test_heartbeats_name_mode_vehicle_and_autopilot(kind, autopilot, base, custom, mode, vehicle, name):
    intake = Intake(offset=-1)
    intake.hear(T0, Talker(7).heartbeat(kind, autopilot, base, custom))
    (status,) = of(Status, intake.flush(T0))
    assert (status.uav, status.vehicle, status.autopilot, status.armed) == (6, vehicle, name, base > 0x7F)
    assert mode is None or status.mode == mode


@pytest.mark.parametrize(
    "kind",
    [mav.MAV_TYPE_GCS, mav.MAV_TYPE_GIMBAL, mav.MAV_TYPE_CAMERA, mav.MAV_TYPE_ADSB, mav.MAV_TYPE_GROUND_ROVER, 99],
)
def test_what_does_not_fly_is_no_uav(kind):
    intake = Intake()
    intake.hear(T0, Talker().heartbeat(kind) + Talker(9).attitude(1.0))
    intake.hear(T0, Talker().heartbeat(PLANE, mav.MAV_AUTOPILOT_INVALID))
    assert intake.flush(T0 + 5) == []
    assert intake.refused == {"not an aircraft": 2, "no aircraft heartbeat yet": 1}


def test_a_gimbal_on_the_same_system_is_not_the_aircraft():
    intake = Intake()
    intake.hear(T0, Talker().heartbeat() + Talker(7, 154).heartbeat(mav.MAV_TYPE_GIMBAL) + Talker(7, 154).attitude(1))
    assert of(Sample, intake.flush(T0 + 0.1)) == []


def test_losses_are_counted_from_gaps():
    intake, talker = Intake(), Talker()
    intake.hear(T0, talker.heartbeat())
    frames = [talker.attitude(1 + i * 0.1) for i in range(300)]
    for i, frame in enumerate(frames):
        if i % 10:
            intake.hear(T0 + i * 0.1, frame)
    (status,) = of(Status, intake.flush(T0 + 30))
    assert (status.received, status.missed) == (271, 30)


def test_status_once_a_second_and_on_change():
    intake, talker = Intake(), Talker()
    told = []
    for step in range(100):
        if step % 10 == 0:
            intake.hear(T0 + step * 0.1, talker.heartbeat(custom=10 if step < 45 else 11))
        told += of(Status, intake.flush(T0 + step * 0.1))
    assert 10 <= len(told) <= 12
    assert [s.mode for s in told][-1] == "RTL"
    assert told[-1].rates_hz["HEARTBEAT"] == pytest.approx(1.0, abs=0.15)


def test_a_lost_link_is_told_and_comes_back():
    intake, talker = Intake(), Talker()
    intake.hear(T0, talker.heartbeat())
    links = []
    for step in range(80):
        if step == 60:
            intake.hear(T0 + 6.0, talker.heartbeat())
        links += [(step, s.link, s.sentence) for s in of(Status, intake.flush(T0 + step * 0.1))]
    lost = [step for step, link, _ in links if link is Link.LOST]
    assert 30 <= lost[0] <= 32
    assert 50 <= lost[-1] <= 59
    assert links[-1][1] is Link.LIVE
    assert "nothing heard for" in next(sentence for step, _, sentence in links if step == lost[-1])


def test_a_second_sender_for_a_live_id_is_refused_until_the_first_is_silent():
    claims: dict = {}
    one, two = Intake(0, claims), Intake(0, claims)
    one.hear(T0, Talker().heartbeat(), "a")
    one.hear(T0 + 0.1, Talker().attitude(50.0), "b")
    two.hear(T0 + 0.2, Talker().heartbeat(), "c")
    two.hear(T0 + 0.2, Talker().attitude(70.0), "c")
    assert one.refused["second sender for a live id"] == 1
    assert two.refused["second sender for a live id"] == 2
    news = one.flush(T0 + 0.3) + two.flush(T0 + 0.3)
    assert of(Sample, news) == []
    assert "second sender" in of(Status, news)[0].sentence
    two.hear(T0 + 9.0, Talker().heartbeat(), "c")
    assert [s.uav for s in of(Status, one.flush(T0 + 9.1) + two.flush(T0 + 9.1))] == [7]


def test_a_download_and_an_upload_are_overheard():
    plane, station = Talker(), Talker(255, 190)
    intake = Intake()
    intake.hear(T0, plane.heartbeat())
    intake.hear(T0 + 1, plane.mission(plane.item(0), plane.item(1, 22), plane.item(2, x=470010000)))
    (mission,) = of(Mission, intake.flush(T0 + 1.1))
    assert (mission.complete, [i.command for i in mission.items], mission.seq) == (True, [16, 22, 16], -1)
    intake.hear(T0 + 2, plane.pack(mav.MAVLink_mission_current_message(1)))
    assert of(Mission, intake.flush(T0 + 2.1))[0].seq == 1
    upload = [
        mav.MAVLink_mission_count_message(7, 1, 1),
        mav.MAVLink_mission_item_message(7, 1, 0, 3, 16, 0, 1, 0, 0, 0, math.nan, 47.5, -8.25, 99.0),
    ]
    intake.hear(T0 + 3, station.pack(*upload))
    assert of(Mission, intake.flush(T0 + 3.1)) == []  # not accepted yet
    intake.hear(T0 + 4, plane.pack(mav.MAVLink_mission_ack_message(255, 190, 0)))
    (mission,) = of(Mission, intake.flush(T0 + 4.1))
    assert [(i.lat_e7, i.lon_e7, i.alt_m) for i in mission.items] == [(475000000, -82500000, 99.0)]
    assert mission.sentence == ""  # param4 = nan keeps the yaw; that is legal


def test_a_part_of_a_mission_is_shown_as_such():
    intake, plane = Intake(), Talker()
    intake.hear(T0, plane.heartbeat() + plane.count(3) + plane.item(0) + plane.item(2))
    (mission,) = of(Mission, intake.flush(T0 + 2.5))
    assert not mission.complete
    assert "2 of 3" in mission.sentence


def test_parameters_of_px4_hide_integers_in_floats():
    intake, talker = Intake(), Talker()
    intake.hear(T0, talker.heartbeat(PLANE, mav.MAV_AUTOPILOT_PX4))
    as_float = float(np.frombuffer(np.int32(-7).tobytes(), "<f4")[0])
    packed = bytearray(talker.param("NAV_ACC", 1.0, 0, 1, mav.MAV_PARAM_TYPE_INT32))
    assert math.isnan(as_float)  # which is why it may not be judged before it is read
    intake.hear(T0 + 1, _replace_payload(packed, np.int32(-7).tobytes()))
    (params,) = of(Params, intake.flush(T0 + 2))
    assert params.values == {"NAV_ACC": -7.0}
    assert params.complete


def _replace_payload(frame, value):
    frame[10:14] = value
    crc = mav.x25crc(bytes(frame[1:-2]) + bytes([mav.MAVLink_param_value_message.crc_extra])).crc
    return bytes(frame[:-2]) + crc.to_bytes(2, "little")


# ---- recordings ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def s02():
    intake = Intake()
    return list(replay_messages(recording(S02), intake=intake)), intake


def test_a_recorded_flight_comes_out_whole(s02):
    news, intake = s02
    missions, params, status = of(Mission, news), of(Params, news), of(Status, news)
    assert {m.uav for m in news} == {3}
    assert missions[-1].complete
    assert len(missions[-1].items) == 17
    assert [m.seq for m in missions[2:]] == [1, 2, 3, 4, 5, 7, 8, 9, 11, 14, 15, 16]
    assert params[-1].complete
    assert len(params[-1].values) > 1000
    assert params[-1].values["AIRSPEED_CRUISE"] == 22.0
    modes = [(s.t - news[0].t, s.mode) for s in status]
    assert next(t for t, mode in modes if mode == "AUTO") == pytest.approx(35.1, abs=0.5)
    assert status[-1].vehicle == "fixed_wing"
    assert status[-1].clock_jumps == 0
    assert intake.counters()["bad_bytes"] == 0


def test_a_recorded_flight_is_finite_in_order_and_on_its_own_time(s02):
    news, _ = s02
    last = dict.fromkeys(COLUMNS, 0.0)
    for message in news:
        assert_finite(message)
        for field in COLUMNS if isinstance(message, Sample) else ():
            rows = getattr(message, field)
            if rows is not None:
                assert rows.t.numpy()[0] > last[field]
                last[field] = rows.t.numpy()[-1]
    samples = of(Sample, news)
    assert samples[0].t == pytest.approx(1763607200, abs=1)
    assert samples[-1].t - samples[0].t == pytest.approx(446, abs=1)
    airspeed = np.concatenate([s.air.x.numpy()[:, 0] for s in samples if s.air and s.t - samples[0].t > 60])
    error = np.concatenate([s.command.x.numpy()[:, 4] for s in samples if s.command and 60 < s.t - samples[0].t < 330])
    assert 15 < np.median(airspeed) < 30
    assert np.median(np.abs(error)) < 2.0  # m/s, were it not for the centimetres of ArduPilot


def test_three_aircraft_in_one_recording():
    seen: dict[int, set] = {}
    for message in replay_messages(recording("sitl/s10_multi3_nominal.tlog.xz"), offset=-1):
        seen.setdefault(message.uav, set()).add(type(message))
        if len(seen) == 3 and all(len(kinds) == 4 for kinds in seen.values()):
            break
    assert seen == {uav: {Sample, Status, Mission, Params} for uav in (20, 21, 22)}


def log_of(frames, t0=T0, step=0.05):
    stamps = [round((t0 + i * step) * 1e6).to_bytes(8, "big") for i in range(len(frames))]
    return b"".join(stamp + frame for stamp, frame in zip(stamps, frames, strict=True))


def test_a_damaged_recording_keeps_what_is_good(tmp_path, caplog):
    talker = Talker()
    frames = [talker.attitude(i * 0.05) for i in range(400)]
    half = log_of(frames[:200])
    data = half + np.random.default_rng(5).bytes(3000) + log_of(frames[200:], T0 + 10) + b"\0\0\x06"
    path = tmp_path / "damaged.tlog"
    path.write_bytes(data)
    found = list(records(path))
    assert sum(frame in frames for _, frame in found) >= 396
    assert "damaged bytes skipped" in caplog.text


def test_a_cut_archive_keeps_what_came_before(tmp_path, caplog):
    talker = Talker()
    data = lzma.compress(log_of([talker.attitude(i * 0.05, phi=math.sin(i)) for i in range(20_000)]))
    path = tmp_path / "cut.tlog.xz"
    path.write_bytes(data[: len(data) // 2])
    assert len(list(records(path))) > 1000
    path.write_bytes(data[:-200] + bytes(100))
    assert len(list(records(path))) > 1000
    assert "damaged" in caplog.text


@pytest.mark.parametrize(
    ("name", "data"), [("a.tlog", b""), ("a.tlog", b"hello" * 99), ("a.csv", b""), ("a.tlog.xz", b"no")]
)
def test_what_is_no_recording_is_named(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(ValueError, match=name):
        list(records(tmp_path / name))


def test_a_backlog_is_played_in_the_time_of_the_flight():
    talker = Talker()
    frames = [talker.attitude(100 + i * 0.1) for i in range(1000)]
    rushed = [(T0 + i * 0.01, frame) for i, frame in enumerate(frames)]
    offset = backlog_offset(rushed)
    assert offset is not None
    times = [t for t, _ in restamped(rushed, offset)]
    assert np.diff(times) == pytest.approx(0.1, abs=1e-6)
    assert times[-1] == pytest.approx(rushed[-1][0], abs=1e-3)
    assert backlog_offset([(T0 + i * 0.1, frame) for i, frame in enumerate(frames)]) is None
    assert boot_s(frames[5]) == 100.5
