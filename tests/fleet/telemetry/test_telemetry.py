import math

import msgspec
import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.bus.codec import encode
from fleet.contract import COLUMNS, ROW_WIDTHS, Sample, Status
from fleet.telemetry.mavlink.arrays.row_arbiter import RANK_COUNT, SOURCE_TIMEOUT_S
from fleet.telemetry.mavlink.intake import MavlinkReceiver
from fleet.telemetry.mavlink.parsing.decode import IDS, Decoder
from fleet.telemetry.mavlink.parsing.received import ReceivedBytes
from fleet.telemetry.tables.mavlink import TABLE, own_seconds
from fleet.telemetry.tables.row import MAX_MAGNITUDE, is_plausible
from tests.support.talker import ARDU, T0, Ears, Talker, assert_finite, of


def columns(message: str, field: str, sent, autopilot: str = "ardupilot") -> dict[str, float]:
    """Send one message through the wire and the table."""
    frames = Decoder().decode(ReceivedBytes.from_pieces([(T0, None, Talker().pack(sent))]))
    named = [r for r in TABLE if r.message == message and r.field == field]
    (row, *_) = [r for r in named if not r.autopilots or autopilot in r.autopilots]
    columns = row.columns(frames.fields(np.array([0]), message))[: len(COLUMNS[field])]
    return dict(zip([name for name, _ in COLUMNS[field]], [float(np.ravel(c)[0]) for c in columns], strict=True))


def test_every_row_names_a_message_and_fills_its_columns():
    for row in TABLE:
        assert row.message in IDS
        kind = mav.mavlink_map[IDS[row.message]]
        frame = _frame(7, kind, bytes([1]) * kind.unpacker.size)
        fields = Decoder().decode(ReceivedBytes.from_pieces([(T0, None, frame)])).fields(np.array([0]), row.message)
        assert len(row.columns(fields)) == ROW_WIDTHS[row.field][-1] == len(MAX_MAGNITUDE[row.field])
        assert 0 <= row.rank < RANK_COUNT and row.requires in ("", *COLUMNS)
        assert np.isfinite(own_seconds(row, fields)).all()


def test_fields_and_messages_are_those_of_pymavlink_for_every_message():
    rng = np.random.default_rng(5)
    for number, kind in mav.mavlink_map.items():
        said = _frame(7, kind, rng.bytes(kind.unpacker.size))
        frames = Decoder().decode(ReceivedBytes.from_pieces([(T0, None, said)]))
        assert len(frames.headers) == 1, kind.msgname
        expected, (got,) = mav.MAVLink(None).decode(bytearray(said)), frames.messages(np.array([0]))
        fields = frames.fields(np.array([0]), kind.msgname)
        assert fields.rows.dtype.itemsize == kind.unpacker.size
        for name, letter in zip(kind.fieldnames, kind.fieldtypes, strict=True):
            if letter != "char":
                np.testing.assert_array_equal(np.ravel(getattr(fields, name)), np.ravel(getattr(expected, name)))
                np.testing.assert_array_equal(np.ravel(getattr(got, name)), np.ravel(getattr(expected, name)))
            else:
                assert getattr(got, name) == getattr(expected, name)
        assert (number, got.get_type()) == (IDS[kind.msgname], kind.msgname)
        assert (got.get_srcSystem(), got.get_srcComponent()) == (expected.get_srcSystem(), expected.get_srcComponent())


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


def heard(*sent) -> Sample:
    """What an aircraft's rows are after one heartbeat, one attitude and these."""
    intake, talker = MavlinkReceiver(), Talker()
    intake.receive(T0, talker.heartbeat() + talker.attitude(5.0) + b"".join(map(talker.pack, sent)))
    (sample,) = of(Sample, intake.flush(T0 + 0.1))
    return sample


def highres(pressure: float, flags: int) -> mav.MAVLink_highres_imu_message:
    return mav.MAVLink_highres_imu_message(5_010_000, 0, 0, -9.5, *[0.0] * 6, pressure, 0.0, 0.0, 0.0, flags)


def test_static_pressure_becomes_pascal():
    got = columns("SCALED_PRESSURE", "pressure", mav.MAVLink_scaled_pressure_message(5010, 945.5, 20.0, 2540))
    assert got == {"static": 94550.0}
    assert heard(mav.MAVLink_scaled_pressure_message(5010, 0.0, 20.0, 2540)).pressure is None, "no barometer"


@pytest.mark.parametrize(
    ("pressure", "flags", "told"),
    [(945.5, 63 | 512, True), (945.5, 63, False), (0.0, 575, False), (math.nan, 575, False)],
)
def test_pressure_beside_an_imu_counts_where_it_is_filled(pressure, flags, told):
    sample = heard(highres(pressure, flags))
    assert sample.imu is not None
    assert (sample.pressure.x.numpy().tolist() if sample.pressure else None) == ([[94550.0]] if told else None)


@pytest.mark.parametrize("fix_type", range(7))
def test_the_receivers_height_counts_with_a_fix_in_three_dimensions(fix_type):
    epoch_us = 1_700_000_000_000_000  # the receiver's own clock must not upset that of the inertial unit
    sent = mav.MAVLink_gps_raw_int_message(epoch_us, fix_type, -353632610, 1491652301, 584123, 0, 0, 0, 0, 9)
    sample = heard(highres(0.0, 63), sent, highres(0.0, 63))
    assert len(sample.imu.t.numpy()) == 1 and sample.imu.t.numpy() == pytest.approx(T0 + 0.01, abs=1e-3)
    if fix_type < 3:
        assert sample.gnss is None
    else:
        assert sample.gnss.x.dtype == "<i4" and sample.gnss.x.numpy().tolist() == [[584123]]


def test_hud_throttle_is_a_share():
    got = columns("VFR_HUD", "air", mav.MAVLink_vfr_hud_message(22.5, 20.0, 90, 55, 100.0, -1.5))
    assert got == pytest.approx({"Va": 22.5, "delta_t": 0.55, "climb": -1.5})


@pytest.mark.parametrize(
    ("autopilot", "height", "speed"), [("ardupilot", 4.0, 1.5), ("px4", -4.0, -150.0), ("generic", 4.0, 150.0)]
)
def test_commands_are_radians_and_each_autopilot_has_its_units_and_signs(autopilot, height, speed):
    sent = mav.MAVLink_nav_controller_output_message(30.0, -10.0, 0, 0, 0, 4.0, 150.0, -7.0)
    got = columns("NAV_CONTROLLER_OUTPUT", "command", sent, autopilot)
    want = {
        "phi_c": math.pi / 6,
        "theta_c": -math.pi / 18,
        "xtrack_error": -7.0,
        "alt_error": height,
        "Va_error": speed,
    }
    assert got == pytest.approx(want)


def test_the_attitude_target_of_px4_is_a_command_that_leaves_errors_untold():
    half = [math.cos(0.25), math.sin(0.25), 0.0, 0.0]  # phi 0.5 rad
    sent = mav.MAVLink_attitude_target_message(900, 0, half, 0.0, 0.0, 0.0, 0.6)
    got = columns("ATTITUDE_TARGET", "command", sent, "px4")
    assert (got.pop("phi_c"), got.pop("theta_c")) == pytest.approx((0.5, 0.0), abs=1e-6)
    assert all(math.isnan(value) for value in got.values())
    assert is_plausible("command", np.array([0.1, 0.1, np.nan, np.nan, np.nan]))
    assert not is_plausible("command", np.array([np.nan, 0.1, 0.0, 0.0, 0.0]))


FIRST, LAST = [1100 + i for i in range(8)], [1300 + i for i in range(8)]
PX4 = mav.MAV_AUTOPILOT_PX4


def servo_sample(autopilot: int, *messages: tuple[int, list[int]]) -> Sample:
    """The sample of an aircraft that sends these outputs, (port, pulses), a second apart."""
    intake, talker = MavlinkReceiver(), Talker()
    intake.receive(T0, talker.heartbeat(autopilot=autopilot) + talker.attitude(5.0))
    for k, (port, pulses) in enumerate(messages, 1):
        message = mav.MAVLink_servo_output_raw_message(5_000_000 + 1_000_000 * k, port, *pulses)
        intake.receive(T0 + k, talker.attitude(5.0 + k) + talker.pack(message))
    return of(Sample, intake.flush(T0 + len(messages) + 0.1))[0]


def test_outputs_9_to_16_make_wider_rows_only_where_there_are_any():
    wide = servo_sample(ARDU, (0, FIRST + LAST)).servo.x
    assert wide.shape == (1, 16) and wide.numpy().tolist() == [FIRST + LAST]
    for pulses in (FIRST, FIRST + [0] * 8, FIRST + [65535] * 8):
        narrow = servo_sample(ARDU, (0, pulses)).servo.x
        assert narrow.shape == (1, 8) and narrow.numpy().tolist() == [FIRST]


def test_the_wire_is_plain_msgpack_either_way():
    for sample, width in ((servo_sample(ARDU, (0, FIRST)), 8), (servo_sample(ARDU, (0, FIRST + LAST)), 16)):
        x = msgspec.msgpack.decode(encode(sample))["servo"]["x"]
        assert x["shape"] == [1, width] and len(x["data"]) == 4 * width
        assert np.frombuffer(x["data"], "<f4")[:8].tolist() == FIRST


def test_the_second_port_of_px4_has_outputs_9_to_16():
    first, second = servo_sample(PX4, (1, LAST), (0, FIRST)), servo_sample(PX4, (0, FIRST), (1, LAST), (0, FIRST))
    assert first.servo.x.numpy().tolist() == [FIRST + LAST]
    assert second.servo.x.numpy().tolist() == [FIRST + [0] * 8, FIRST + LAST]
    own = servo_sample(PX4, (1, LAST), (0, FIRST + FIRST))
    assert own.servo.x.numpy().tolist() == [FIRST + FIRST]  # the first port has its own
    stopped = servo_sample(PX4, (1, LAST), *[(0, FIRST)] * 5)
    assert stopped.servo.x.numpy()[-1].tolist() == FIRST + [0] * 8  # the second port is silent for more than 3 s


def test_the_second_port_of_ardupilot_has_outputs_17_to_32_which_no_map_uses():
    assert servo_sample(ARDU, (1, LAST), (0, FIRST)).servo.x.numpy().tolist() == [FIRST]


def test_the_better_imu_wins_and_the_other_returns_after_a_silence():
    intake, talker = MavlinkReceiver(), Talker()
    intake.receive(T0, talker.heartbeat())

    def raw(t):
        return talker.pack(mav.MAVLink_raw_imu_message(round(t * 1e6), 0, 0, -1000, 0, 0, 0, 0, 0, 0))

    def high(t):
        return talker.pack(mav.MAVLink_highres_imu_message(round(t * 1e6), 0, 0, -9.5, *[0.0] * 10, 63))

    intake.receive(T0, talker.attitude(5.0) + high(5.0) + raw(5.1))
    for step in range(1, 40):
        intake.receive(T0 + 0.1 * step, talker.attitude(5.0 + 0.1 * step))
    intake.receive(T0 + 4.0, raw(9.0))
    (sample,) = of(Sample, intake.flush(T0 + 4.1))
    assert sample.imu.x.numpy()[:, 2] == pytest.approx([-9.5, -9.80665], abs=1e-5)


def ground(t: float, v_n: float, *, rounded: bool, lat: int = 474_000_000):
    """A velocity of one source or the other, for one boot time [s]."""
    if rounded:
        return mav.MAVLink_global_position_int_message(
            round(t * 1e3), lat, lat and 85_000_000, 0, 0, round(v_n * 1e2), 0, 0, 0
        )
    return mav.MAVLink_local_position_ned_message(round(t * 1e3), 0.0, 0.0, 0.0, v_n, 0.0, 0.0)


def flown(messages) -> tuple[np.ndarray, list[float], int]:
    """Boot times [s] and north velocities [m/s] made of (boot time, message); and how many rows were rejected."""
    intake, talker = MavlinkReceiver(), Talker()
    intake.receive(T0, talker.heartbeat() + talker.attitude(5.0))
    for t, message in messages:
        intake.receive(T0 + t - 5.0, talker.pack(message))
    news = intake.flush(T0 + 20.0)
    rows = [s.velocity for s in of(Sample, news) if s.velocity is not None]
    t = np.concatenate([r.t.numpy() for r in rows]) - T0 + 5.0 if rows else np.empty(0)
    v_n = [float(x) for r in rows for x in r.x.numpy()[:, 0]]
    return t, v_n, of(Status, news)[-1].rejected


@pytest.mark.parametrize(
    ("rounded_hz", "whole_hz", "whole_wins"), [(5, 10, True), (10, 10, True), (10, 4, False), (5, 1, False)]
)
def test_velocity_that_is_not_rounded_wins_unless_it_trickles(rounded_hz, whole_hz, whole_wins):
    said = [(t, ground(t, 12.346, rounded=True)) for t in 5.0 + np.arange(1, 8 * rounded_hz) / rounded_hz]
    said += [(t, ground(t, 12.344, rounded=False)) for t in 5.0 + np.arange(1, 8 * whole_hz) / whole_hz]
    t, v_n, rejected = flown(sorted(said, key=lambda one: one[0]))
    late = t > 6.5
    assert np.array(v_n)[late] == pytest.approx(12.344 if whole_wins else 12.35, abs=1e-5)
    assert np.diff(t[late]) == pytest.approx(1 / (whole_hz if whole_wins else rounded_hz), abs=2e-3)
    assert np.diff(t).max() < 1 / rounded_hz + 0.01 and rejected == 0


def test_velocity_that_ceases_is_taken_from_the_other_source_again():
    t = 5.0 + np.arange(1, 100) / 10
    said = [(at, ground(at, 1.0, rounded=True)) for at in t]
    said += [(at, ground(at, 2.0, rounded=False)) for at in t if at < 8.0]
    t, v_n, rejected = flown(sorted(said, key=lambda one: one[0]))
    assert v_n[-1] == 1.0 and 2.0 in v_n and rejected == 0
    assert t[v_n.index(2.0) + v_n.count(2.0)] == pytest.approx(7.9 + SOURCE_TIMEOUT_S, abs=0.11)


@pytest.mark.parametrize("whole", [0.0, math.nan])
def test_velocity_of_an_estimator_that_has_not_started_is_no_truth(whole):
    said = [(t, ground(t, whole, rounded=False)) for t in 5.0 + np.arange(1, 30) / 10]
    said += [(t, ground(t, 3.0, rounded=True)) for t in 5.0 + np.arange(1, 30) / 5]
    t, v_n, rejected = flown(sorted(said, key=lambda one: one[0]))
    assert len(t) == 29 and set(v_n) == {3.0} and rejected == 0


def test_velocity_without_a_fix_is_not_taken():
    """Indoors, and before the first fix, there is no place the velocity could belong to."""
    said = [(t, ground(t, 0.5, rounded=False)) for t in 5.0 + np.arange(1, 100) / 10]
    said += [(t, ground(t, 0.5, rounded=True, lat=0)) for t in 5.0 + np.arange(1, 100) / 10]
    t, _, rejected = flown(sorted(said, key=lambda one: one[0]))
    assert len(t) == 0 and rejected == 0


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e30])
def test_unbelievable_values_are_refused_counted_and_said(bad):
    assert not is_plausible("velocity", np.array([0.0, bad, 0.0]))
    intake, talker = MavlinkReceiver(), Talker()
    intake.receive(T0, talker.heartbeat() + talker.attitude(1.0, phi=bad) + talker.attitude(1.1))
    news = intake.flush(T0 + 0.1)
    (sample,), (status,) = of(Sample, news), of(Status, news)
    assert len(sample.attitude.t.numpy()) == 1
    assert status.rejected == 1
    assert "uav-7: ATTITUDE" in status.sentence


def test_no_fix_is_no_position():
    intake, talker = MavlinkReceiver(), Talker()
    intake.receive(
        T0, talker.heartbeat() + talker.pack(mav.MAVLink_global_position_int_message(9, 0, 0, 5, 5, 0, 0, 0, 0))
    )
    assert of(Sample, intake.flush(T0 + 0.1)) == []


# ---- decoding


def test_both_versions_in_pieces_of_any_size():
    talker = Talker()
    stream = b"".join(talker.pack(mav.MAVLink_attitude_message(i, 0, 0, 0, 0, 0, 0), v1=i % 2 == 0) for i in range(50))
    for size in (1, 3, 17, 1000):
        decoder = Ears()
        found = [m for i in range(0, len(stream), size) for m in decoder.feed(stream[i : i + size])]
        assert [m.time_boot_ms for m in found] == list(range(50))
        assert decoder.decoder.counts[1:].tolist() == [0, 0, 0]


def test_frames_inside_garbage_are_all_found():
    rng = np.random.default_rng(3)
    talker, decoder, found = Talker(), Ears(), []
    for i in range(200):
        junk = rng.bytes(int(rng.integers(0, 60)))
        found += decoder.feed(junk + talker.pack(mav.MAVLink_attitude_message(i, 0, 0, 0, 0, 0, 0)))
    found += decoder.feed(b"\0" * 600)
    times = [m.time_boot_ms for m in found if m.get_type() == "ATTITUDE"]
    assert times == list(range(200))
    assert decoder.decoder.counts[1] > 1000


def test_a_broken_checksum_costs_one_frame():
    talker, decoder = Talker(), Ears()
    frames = [bytearray(talker.attitude(float(i))) for i in range(5)]
    frames[2][15] ^= 0x40
    assert [m.time_boot_ms for m in decoder.feed(b"".join(frames))] == [0, 1000, 3000, 4000]
    assert decoder.decoder.counts[2] == 1


def test_every_message_with_random_content_passes_through():
    rng = np.random.default_rng(11)
    intake = MavlinkReceiver()
    intake.receive(T0, Talker().heartbeat() + Talker(8).heartbeat(mav.MAV_TYPE_QUADROTOR, mav.MAV_AUTOPILOT_PX4))
    sender = mav.MAVLink(None, srcSystem=7, srcComponent=1)
    for step, kind in enumerate(list(mav.mavlink_map.values()) * 3):
        payload = rng.bytes(kind.unpacker.size)
        for sender.srcSystem in (7, 8, 255):
            frame = _frame(sender.srcSystem, kind, payload)
            intake.receive(T0 + step * 0.01, frame)
        for news in intake.flush(T0 + step * 0.01):
            assert_finite(news)


def _frame(system, kind, payload):
    head = bytes([len(payload), 0, 0, 0, system, 1]) + kind.id.to_bytes(3, "little")
    crc = mav.x25crc(head + payload + bytes([kind.crc_extra])).crc
    return b"\xfd" + head + payload + crc.to_bytes(2, "little")
