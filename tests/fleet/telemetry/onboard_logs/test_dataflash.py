"""The DataFlash reader: the quirks of every generation, on recorded flights; what a log says in words."""

import json
import lzma
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from pymavlink import DFReader

from fleet.contract import COLUMNS
from fleet.telemetry.onboard_logs.dataflash.clock import counted_times
from fleet.telemetry.onboard_logs.dataflash.reader import DataflashLog, gps_to_utc
from fleet.telemetry.onboard_logs.dataflash.rows import rates_between
from tests.support.dataflash_writer import Writer, log_of, rate, read, values

SITL = {"s01_nominal_calm": 2, "s02_nominal_light_wind": 3, "s05_engine_75": 6, "s09_quadplane_nominal": 9}
DEG = np.pi / 180


def sitl_log(recordings: Path, name: str) -> DataflashLog:
    return DataflashLog(lambda: lzma.open(recordings / "sitl" / f"{name}.BIN.xz"), name)


@pytest.fixture(scope="module")
def s02(recordings: Path) -> bytes:
    with lzma.open(recordings / "sitl" / "s02_nominal_light_wind.BIN.xz") as stream:
        return stream.read()


@pytest.mark.parametrize("name", SITL)
def test_a_simulated_flight_is_known_and_read(recordings: Path, name: str) -> None:
    flights = json.loads((recordings / "sitl" / "manifest.json").read_text())
    flight = next(f for f in flights.get("recordings", flights.get("flights", [])) if f["name"] == name)
    craft = flight["vehicles"][0]
    log = sitl_log(recordings, name)
    rows, said, _ = read(log)
    assert (log.system, log.autopilot) == (SITL[name], "ardupilot")
    assert log.vehicle == ("quadplane" if craft["model"] == "quadplane" else "fixed_wing")
    assert log.firmware == "ArduPlane V4.7.0-dev (d55cb382)"
    assert log.epoch_s == pytest.approx(flight["start_time_unix"], abs=1.0)
    assert values(said, "mode") == ["AUTO"] and values(said, "armed") == [True, False]
    (items,) = values(said, "mission")
    assert [i.seq for i in items] == list(range(craft["mission_items"])) and items[0].frame == 0
    assert len(dict(values(said, "param"))) > 900
    assert set(rows) == set(COLUMNS) - {"height", "bearing", "battery"} and not log.skipped
    flown = {seq: t for t, seq in craft["waypoint_times_boot_s"] if t > 40}
    legs = {int(v[0]): t for t, v in zip(*rows["leg"], strict=True)}
    assert {seq: pytest.approx(t, abs=2.0) for seq, t in flown.items()} == {s: t for s, t in legs.items() if s in flown}
    assert all(items[s].command <= 95 for s in legs)


def test_rows_agree_with_the_truth_of_the_simulation(recordings: Path) -> None:
    log = sitl_log(recordings, "s01_nominal_calm")
    rows, _, _ = read(log)
    with lzma.open(recordings / "sitl" / "s01_nominal_calm.truth.csv.xz", "rt") as stream:
        truth = np.genfromtxt(stream, delimiter=",", names=True)
    t = truth["time_us"] * 1e-6
    inside = (t > 60) & (t < 480)

    def at(field: str, column: int) -> np.ndarray:
        return np.interp(t[inside], rows[field][0], rows[field][1][:, column])

    assert np.median(np.abs(at("attitude", 0) - truth["roll_deg"][inside] * DEG)) < 0.02
    assert np.median(np.abs(at("attitude", 1) - truth["pitch_deg"][inside] * DEG)) < 0.02
    assert np.median(np.abs(at("position", 0) - truth["lat_deg"][inside] * 1e7)) < 200  # 2 m
    assert np.median(np.abs(at("position", 2) - truth["alt_amsl_m"][inside] * 1e3)) < 2000
    assert np.median(np.abs(at("velocity", 0) - truth["vn"][inside])) < 0.5
    assert np.median(np.abs(at("velocity", 2) - truth["vd"][inside])) < 0.5
    assert np.median(np.abs(at("air", 2) + truth["vd"][inside])) < 0.5
    assert 15 < np.median(at("air", 0)) < 30 and 0.2 < np.median(at("air", 1)) < 1.0
    p = rates_between(*[x[::5] for x in (rows["attitude"][0], rows["attitude"][1][:, :3])])
    gyro = np.interp(p[0], rows["attitude"][0], rows["attitude"][1][:, 3])
    assert np.corrcoef(gyro, p[1][:, 0])[0, 1] > 0.9  # the gyroscope and the angles tell of one aircraft
    assert rate(rows, "attitude") == pytest.approx(24.5, abs=1) and rate(rows, "imu") == pytest.approx(24.8, abs=1)


def test_a_copter_of_2015_counts_milliseconds(recordings: Path) -> None:
    log = DataflashLog(recordings / "real" / "dronekit_copter_log171_crash.bin")
    rows, said, _ = read(log)
    assert (log.vehicle, log.firmware) == ("multirotor", "APM:Copter V3.3-dev (ae3192b8)")
    assert log.epoch_s == pytest.approx(1448149420.3, abs=0.5)  # 2015-11-21, 17 leap seconds
    assert values(said, "mode") == ["LOITER", "ACRO"] and values(said, "armed") == [True]
    assert len(values(said, "param")) == 491 and not log.skipped
    assert (3, "ERR subsystem 16 code 2 (EKF check)") in values(said, "text")
    assert rate(rows, "imu") == pytest.approx(49.1, abs=0.2) and rate(rows, "servo") == pytest.approx(49.1, abs=0.2)
    assert rate(rows, "attitude") == pytest.approx(9.8, abs=0.2)
    assert "command" not in rows and "air" not in rows and "wind" not in rows  # no cross-track error, no airspeed
    t, servo = rows["servo"]
    assert (servo[:, 4:] == 0).all() and servo[t > 100, :4].min() >= 900
    t, attitude = rows["attitude"]
    assert np.abs(attitude[(t > 225 + 11) & (t < 245)][:, 0]).max() > 2.5  # it tumbles


def test_a_text_log_of_2014_has_its_time_counted(recordings: Path) -> None:
    log = DataflashLog(recordings / "real" / "ardupilot_mechanical_fail_quad.log")
    rows, said, counts = read(log)
    assert (log.vehicle, log.firmware) == ("multirotor", "ArduCopter V3.1 (5c6503e2)")
    assert (counts["ATT"], counts["MOT"], counts["GPS"]) == (1100, 1100, 551)
    t, attitude = rows["attitude"]
    assert len(t) >= 1098 and rate(rows, "attitude") == pytest.approx(10.0, abs=0.05)
    assert np.abs(np.diff(t) - 0.1).max() < 0.06  # steady, through 2845 lines of other things
    assert t[0] == pytest.approx(66.99, abs=0.1) and t[-1] == pytest.approx(177.03, abs=0.1)
    tilt = t[np.abs(attitude[:, :2]).max(axis=1) > 45 * DEG][0]
    assert tilt - 66.9 == pytest.approx(91.8, abs=0.5)  # as the manifest says
    # its first fix is 7 s stale, so single fixes do not set the epoch
    assert log.epoch_s == pytest.approx(315964800 + 1774 * 604800 + 109214.4 - 16 - 67.338, abs=0.3)
    assert values(said, "armed") == [True, False] and values(said, "mode")[:3] == ["STABILIZE", "RTL", "STABILIZE"]
    assert (3, "ERR subsystem 9 code 1 (fence failsafe)") in values(said, "text")
    assert any("no gyroscope" in s for s in log.skipped)


def test_nothing_differs_from_the_library_of_the_format(recordings: Path, tmp_path: Path, s02: bytes) -> None:
    path = tmp_path / "s02.bin"
    path.write_bytes(s02)
    rows, said, counts = read(DataflashLog(path))
    theirs, att, params = Counter(), [], {}
    with DFReader.DFReader_binary(str(path)) as reader:
        while (m := reader.recv_msg()) is not None:
            theirs[m.get_type()] += 1
            if m.get_type() == "ATT":
                att.append((m.TimeUS * 1e-6, m.Roll * DEG, m.Pitch * DEG))
            elif m.get_type() == "PARM":
                params[m.Name] = m.Value
    assert counts == theirs
    np.testing.assert_allclose(np.column_stack([rows["attitude"][0], rows["attitude"][1][:, :2]]), att, atol=1e-12)
    assert dict(values(said, "param")) == params


def test_a_log_can_be_read_again(s02: bytes) -> None:
    log = log_of(s02)
    first, second = read(log), read(log)
    assert first[1] == second[1] and first[2] == second[2]
    assert all((first[0][f][1] == second[0][f][1]).all() for f in first[0])


def test_the_better_source_wins_where_it_flows_and_only_there() -> None:
    def with_better(every: int) -> str:
        writer = Writer().fmt("EKF1", "Qfff", "TimeUS,VN,VE,VD").fmt("XKF1", "QBfff", "TimeUS,C,VN,VE,VD")
        for i in range(100):
            writer.say("EKF1", 1_000_000 + 100_000 * i, 1.0, 1.0, 1.0)
            if not i % every:
                writer.say("XKF1", 1_000_000 + 100_000 * i, 0, 2.0, 2.0, 2.0)
        return writer.log().sources["velocity"].message

    assert (with_better(1), with_better(2), with_better(50)) == ("XKF1", "XKF1", "EKF1")


def test_only_the_first_instance_counts() -> None:
    writer = Writer().fmt("IMU", "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ")
    for i in range(20):
        writer.say("IMU", 1_000_000 + 10_000 * i, i % 2, float(i % 2), 0.0, 0.0, 0.0, 0.0, -9.8)
    t, found = read(writer.log())[0]["imu"]
    assert len(t) == 10 and (found[:, 3] == 0).all()


def test_without_a_gyroscope_rates_are_differences_and_that_is_said() -> None:
    t = np.arange(0, 10, 0.05)
    angles = np.stack([0.3 * np.sin(t), 0.2 * np.cos(t), 0.5 * t], axis=-1)
    middle, rates = rates_between(t, angles)
    phi, theta = 0.3 * np.sin(middle), 0.2 * np.cos(middle)
    np.testing.assert_allclose(rates[:, 0], 0.3 * np.cos(middle) - 0.5 * np.sin(theta), atol=1e-3)
    q = -0.2 * np.sin(middle) * np.cos(phi) + 0.5 * np.sin(phi) * np.cos(theta)
    np.testing.assert_allclose(rates[:, 1], q, atol=1e-3)
    writer = Writer().fmt("ATT", "Qfff", "TimeUS,Roll,Pitch,Yaw")
    for s, (a, b, c) in zip(t, angles, strict=True):
        writer.say("ATT", round(s * 1e6) + 1, a / DEG, b / DEG, c / DEG % 360)
    log = writer.log()
    found = read(log)[0]["attitude"][1]
    assert np.abs(found[5:-5, 5] - np.interp(t[5:-5], middle, rates[:, 2])).max() < 1e-3
    assert [s for s in log.skipped if "no gyroscope" in s]


def test_modes_arming_errors_and_events_are_said_in_words() -> None:
    writer = Writer().fmt("MSG", "QZ", "TimeUS,Message").fmt("MODE", "QMB", "TimeUS,Mode,ModeNum")
    writer.fmt("EV", "QB", "TimeUS,Id").fmt("ERR", "QBB", "TimeUS,Subsys,ECode").fmt("ARM", "QBH", "TimeUS,ArmState,A")
    writer.fmt("PARM", "QNf", "TimeUS,Name,Value")
    writer.say("MSG", 10**6, "ArduCopter V4.5.1").say("MODE", 2 * 10**6, 5, 5).say("EV", 3 * 10**6, 10)
    writer.say("ARM", 3 * 10**6, 1, 0).say("MODE", 4 * 10**6, 100, 100).say("ERR", 4 * 10**6, 9, 1)
    writer.say("PARM", 4 * 10**6, "MAV_SYSID", 7.0).say("PARM", 4 * 10**6, "bad\x01", 7.0)
    writer.say("PARM", 4 * 10**6, "NAN", float("nan")).say("EV", 5 * 10**6, 11)
    log = writer.log()
    _, said, _ = read(log)
    assert (log.system, log.vehicle, log.firmware) == (7, "multirotor", "ArduCopter V4.5.1")
    assert values(said, "mode") == ["LOITER", "Mode(100)"] and values(said, "armed") == [True, False]
    assert values(said, "param") == [("MAV_SYSID", 7.0)]
    texts = ["ArduCopter V4.5.1", "EV 10 armed", "ERR subsystem 9 code 1 (fence failsafe)", "EV 11 disarmed"]
    assert [text for _, text in values(said, "text")] == texts
    assert [severity for severity, _ in values(said, "text")] == [6, 6, 3, 6]


def test_a_listed_mission_is_no_leg_and_what_is_begun_is() -> None:
    writer = Writer().fmt("CMD", "QHHHffffLLfB", "TimeUS,CTot,CNum,CId,Prm1,Prm2,Prm3,Prm4,Lat,Lng,Alt,Frame")

    def cmd(t: float, seq: int, command: int = 16) -> None:
        writer.say("CMD", round(t * 1e6), 4, seq, command, 1.0, 0.0, 0.0, 0.0, 47.0 + seq, 8.5, 30.0, 3 if seq else 0)

    for seq in range(4):
        cmd(1.0 + seq * 0.02, seq)
    cmd(5.0, 1)
    cmd(9.0, 2, 178)  # an action, not a leg
    cmd(9.0, 3)
    for seq in range(4):
        cmd(12.0, seq)  # listed again, unchanged
    rows, said, _ = read(writer.log())
    (items,) = values(said, "mission")
    assert [(i.seq, i.frame, i.lat_e7, i.alt_m) for i in items[:2]] == [
        (0, 0, 470000000, 30.0),
        (1, 3, 480000000, 30.0),
    ]
    assert rows["leg"][0].tolist() == [5.0, 9.0] and rows["leg"][1].ravel().tolist() == [1.0, 3.0]


def test_without_a_time_since_boot_the_week_of_the_satellites_serves() -> None:
    writer = Writer(text=True).fmt("ATT", "ccc", "Roll,Pitch,Yaw")
    writer.fmt("GPS", "BIHLLeee", "Status,TimeMS,Week,Lat,Lng,Alt,Spd,GCrs")
    for i in range(30):
        writer.say("GPS", 3, 109_216_000 + 200 * i, 1774, 47.0, 8.5, 500.0, 1.0, 0.0)
        writer.say("ATT", 1.0, 2.0, 3.0).say("ATT", 1.0, 2.0, 3.0)
    log = writer.log()
    t, _ = read(log)[0]["attitude"]
    np.testing.assert_allclose(np.diff(t), 0.1, atol=1e-6)
    assert log.epoch_s == pytest.approx(315964800 + 1774 * 604800 - 16, abs=1e-3)


def test_the_vehicle_is_guessed_from_what_only_one_kind_logs() -> None:
    def kind(name: str, columns: str, *params: str) -> str:
        writer = Writer().fmt(name, "Q" + "f" * columns.count(","), columns).fmt("PARM", "QNf", "TimeUS,Name,Value")
        writer.say(name, 10**6, *(0.0,) * columns.count(","))
        for param in params:
            writer.say("PARM", 10**6, param, 1.0)
        return writer.log().vehicle

    assert kind("CTUN", "TimeUS,NavRoll,Roll") == "fixed_wing"
    assert kind("CTUN", "TimeUS,NavRoll,Roll", "Q_ENABLE") == "quadplane"
    assert kind("CTUN", "TimeUS,ABst,ThO") == kind("MOT", "TimeUS,Mot1") == "multirotor"
    assert kind("XYZ", "TimeUS,A", "FRAME_CLASS") == "multirotor" and kind("XYZ", "TimeUS,A") == "unknown"


@pytest.mark.parametrize(
    ("gps", "leap"),
    [(1448150400.0, 17), (1388989200.0, 16), (1763600000.0, 18), (1483228817.0, 17), (1483228818.0, 18)],
)
def test_leap_seconds_are_those_of_the_day(gps: float, leap: int) -> None:
    assert gps - gps_to_utc(gps) == leap


def test_counted_messages_lie_evenly_between_stamps() -> None:
    places, times = np.array([0, 10, 20]), np.array([5.0, 5.2, 5.4])
    t = counted_times(np.array([2, 7, 13, 14, 25]), places, times)
    np.testing.assert_allclose(t, [5.05, 5.15, 5.25, 5.35, 5.45])
    np.testing.assert_allclose(counted_times(np.array([1, 2]), np.array([5.0]), np.array([3.0])), [2.85, 2.95])
