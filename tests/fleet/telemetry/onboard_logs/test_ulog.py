"""The ULog reader: a real log, the table release by release, and the same numbers as plain pyulog."""

import csv
import io
import tarfile
from itertools import pairwise

import numpy as np
import pytest
from pyulog import ULog

from fleet.contract import COLUMNS
from fleet.telemetry.onboard_logs.topic import Topic, time_order
from fleet.telemetry.onboard_logs.topic_log import extract_rows
from fleet.telemetry.onboard_logs.ulog import sieve
from fleet.telemetry.onboard_logs.ulog.reader import UlogLog
from fleet.telemetry.tables.ulog import ROWS, TABLE, TOPICS, mode_name
from tests.support.ulog_writer import START_US, TRUTH, UTC_US, flight, read, release, rows, said, topic, ulog

VERSIONS = ((1, 6), (1, 8), (1, 11), (1, 13), (1, 14), (1, 16))
SAMPLE = "real/px4_vtol_cubeorange_6s_reader_test.ulg"


# --- the real log -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sample_bytes(recordings) -> bytes:
    return (recordings / SAMPLE).read_bytes()


@pytest.fixture(scope="module")
def sample(sample_bytes) -> UlogLog:
    return read(sample_bytes)


def test_the_sample_says_who_it_is(sample):
    assert (sample.system, sample.autopilot, sample.vehicle) == (1, "px4", "quadplane")
    assert sample.firmware == "PX4 v1.11.2"
    assert sample.epoch_s == pytest.approx(1_618_986_638.14, abs=0.1)  # 2021-04-21, though time_ref_utc is zero


def test_the_sample_has_980_parameters(sample):
    params = dict(said(sample, "param"))
    assert len(params) == 980
    assert (params["MAV_TYPE"], params["VT_TYPE"], params["SYS_AUTOSTART"]) == (22, 2, 13014)


def test_the_sample_has_its_rates(sample):
    rates = {field: (len(t) - 1) / (t[-1] - t[0]) for field, (t, _) in rows(sample).items()}
    expected = {"attitude": 205, "imu": 200, "position": 5.2, "velocity": 5.2, "air": 94, "servo": 10}
    expected |= {"pressure": 18.35, "gnss": 5.0}
    assert rates == pytest.approx(expected, rel=0.05)


def test_the_sample_flies_the_quicker_of_its_airspeed_topics(sample, sample_bytes):
    """Airspeed_validated trickles at 1 Hz, airspeed flows at 91 Hz."""
    air = rows(sample)["air"][1]
    raw = ULog(io.BytesIO(sample_bytes)).get_dataset("airspeed").data["indicated_airspeed_m_s"]
    assert len(raw) - 5 <= len(air) <= len(raw)
    assert np.isin(air[:, 0], raw.astype(float)).all()


def test_the_sample_lands_and_disarms(sample):
    texts = said(sample, "text")
    assert (6, "[commander] Landing detected") in texts
    assert said(sample, "armed") == [True, False]
    assert said(sample, "mode") == ["MANUAL"]
    landed, disarmed = (
        next(s.t for c in sample.chunks() for s in c.events if s.value == value)
        for value in ((6, "[commander] Landing detected"), (6, "[commander] Disarmed by landing"))
    )
    assert (landed - 20.309, disarmed - 20.309) == pytest.approx((3.5, 5.5), abs=0.1)


def test_stamps_before_the_start_and_the_bogus_last_one_do_not_stretch_the_sample(sample, sample_bytes):
    assert ULog(io.BytesIO(sample_bytes)).last_timestamp > 1e9
    chunks = list(sample.chunks())
    times = [t for chunk in chunks for t, _ in chunk.rows.values()]
    assert len(chunks) == 1
    assert min(t[0] for t in times) > 19.3
    assert max(t[-1] for t in times) < 27.0
    assert any("mission with an implausible stamp" in sentence for sentence in sample.skipped)


def test_the_sample_reads_equal_to_plain_pyulog(sample_bytes):
    plain = ULog(io.BytesIO(sample_bytes), sorted(TOPICS - {"mission"}))
    sieved = ULog(sieve.UlogFilter(lambda: io.BytesIO(sample_bytes), TOPICS, []), sorted(TOPICS))
    assert plain.data_list == sieved.data_list
    assert plain.initial_parameters == sieved.initial_parameters
    assert plain.logged_messages == sieved.logged_messages
    assert plain.msg_info_dict == sieved.msg_info_dict
    assert plain.dropouts == sieved.dropouts


# --- the table ----------------------------------------------------------------------------------------------------


def agrees(row, values: np.ndarray) -> None:
    truth = TRUTH[row.field] if row.message != "actuator_motors" else (1600, 1400, 1500, 2000, 0, 0, 0, 0)
    truth = np.tile([*truth, *[0.0] * (values.shape[1] - len(truth))], (len(values), 1))  # outputs 9 to 16
    if row.field == "command" and np.isnan(values[:, 2]).all():  # a row without the path topic
        truth[:, 2] = np.nan
    np.testing.assert_allclose(values, truth, rtol=1e-6, atol=2e-5, err_msg=str(row))


@pytest.mark.parametrize("version", [(1, 6), (1, 9), (1, 12)])
def test_set_points_are_read_without_the_path_topic(version):
    topics = flight(version)
    topics.pop("fw_pos_ctrl_status", None)
    topics.pop("position_controller_status", None)
    _, command = rows(read(ulog(topics, info=[release(*version, 2)])))["command"]
    assert np.isnan(command[:, 2]).all()
    assert np.allclose(command[:, :2], (0.15, 0.05)) and np.isfinite(command[:, 3:]).all()


@pytest.mark.parametrize("version", VERSIONS)
def test_a_release_is_read_with_its_own_names_and_units(version):
    log = read(ulog(flight(version), info=[release(*version, 2)], params={"MAV_SYS_ID": 7, "FW_P": 1.5}))
    got = rows(log)
    assert set(got) == set(COLUMNS) - {"height", "bearing", "battery"}
    for field, (t, values) in got.items():
        truth = np.tile([*TRUTH[field], *[0.0] * (values.shape[1] - len(TRUTH[field]))], (len(t), 1))
        np.testing.assert_allclose(values, truth, rtol=1e-6, atol=2e-5, err_msg=field)
        assert (np.diff(t) > 0).all()
        assert t[0] >= START_US * 1e-6
    assert (log.system, log.vehicle, log.firmware) == (7, "fixed_wing", f"PX4 v{version[0]}.{version[1]}.2")
    assert log.epoch_s == pytest.approx(UTC_US * 1e-6, abs=1e-3)
    assert said(log, "mode") == ["MISSION"]
    assert dict(said(log, "param")) == {"MAV_SYS_ID": 7.0, "FW_P": 1.5}
    assert all(sentence.startswith(("servo: calculated", "mission: no list")) for sentence in log.skipped)


def test_every_row_of_the_table_is_exercised_and_tells_the_truth():
    applied = set()
    between = flight((1, 14)) | {"airspeed_validated": flight((1, 11))["airspeed_validated"]}
    between["actuator_outputs"] = flight((1, 11))["actuator_outputs"]
    between["actuator_outputs.1"] = topic(10.0, len(between["actuator_outputs"]) / 10.0, output=[0.0] * 16)
    for said_as in (*(flight(version) for version in VERSIONS), between):
        topics = read(ulog(said_as)).topics
        for field in ROWS:
            for row in ROWS[field]:
                laid = extract_rows(row, topics[row.message]) if row.message in topics else None
                if laid is not None and len(laid[0]):
                    applied.add(id(row))
                    if row.message not in ("actuator_motors",):
                        agrees(row, laid[1])
    missing = [(row.message, row.field, row.rank) for row in TABLE if id(row) not in applied]
    assert not missing


def test_motors_alone_are_one_to_two_milliseconds_and_it_is_said():
    topics = flight((1, 14))
    del topics["actuator_servos"]
    log = read(ulog(topics))
    np.testing.assert_allclose(rows(log)["servo"][1][0], (1600, 1400, 1500, 2000, *[0] * 12), atol=1e-3)
    assert any("actuator_motors" in sentence for sentence in log.skipped)


@pytest.mark.parametrize(
    ("main", "expected"), [([0.0] * 8, (1300, 1700, 0, 0, 0, 0, 0, 0)), ([1550.0] * 8, (1550,) * 8)]
)
def test_outputs_of_aux_follow_those_of_main_that_has_none_of_its_own(main, expected):
    topics = flight((1, 11))
    topics["actuator_outputs"]["output"][:] = [1600.0, 1400.0, 1500.0, 2000.0, *[0.0] * 4, *main]
    topics["actuator_outputs.1"] = topic(10.0, 10.0, output=[1300.0, 1700.0, 8191.0, *[0.0] * 13])
    _, servo = rows(read(ulog(topics)))["servo"]
    np.testing.assert_allclose(servo[5], (1600, 1400, 1500, 2000, 0, 0, 0, 0, *expected), atol=1e-3)


@pytest.mark.parametrize("outputs", [[0.0] * 16, [4000.0, 8191.0] + [0.0] * 14, [float("nan")] * 16])
def test_outputs_that_are_no_pulse_widths_are_left_out(outputs):
    topics = flight((1, 11))
    topics["actuator_outputs"]["output"][:] = outputs
    assert "servo" not in rows(read(ulog(topics)))


def test_without_a_global_position_the_local_one_and_its_origin_serve():
    topics = flight((1, 11))
    del topics["vehicle_global_position"], topics["vehicle_gps_position"], topics["sensor_gps"]
    np.testing.assert_allclose(rows(read(ulog(topics)))["position"][1][0], TRUTH["position"], atol=2)


def test_what_a_log_lacks_is_not_invented():
    topics = flight((1, 11))
    for name in ("actuator_controls_0", "tecs_status", "vehicle_attitude"):
        del topics[name]
    assert not {"air", "command", "attitude"} & set(rows(read(ulog(topics))))


def test_a_sister_topic_that_pauses_leaves_a_hole_instead_of_a_guess():
    topics = flight((1, 11), seconds=10.0)
    velocity = topics["vehicle_angular_velocity"]
    seconds = (velocity["timestamp"] - START_US) * 1e-6
    topics["vehicle_angular_velocity"] = {k: v[(seconds < 3) | (seconds > 7)] for k, v in velocity.items()}
    t = rows(read(ulog(topics)))["attitude"][0] - START_US * 1e-6
    assert not ((t > 3) & (t < 7)).any()
    assert (t < 3).any() and (t > 7).any()


def test_a_vtol_tells_its_transitions_and_a_changed_parameter_its_time():
    changed = [(START_US + 2_000_000, "FW_P", 2.5), (START_US + 2_500_000, "BAD", float("nan"))]
    texts = [(START_US + 1_500_000, 4, "low battery")]
    log = read(ulog(flight((1, 16)), params={"FW_P": 1.0}, changed=changed, texts=texts))
    assert said(log, "text") == [
        (6, "VTOL: hovers"),
        (4, "low battery"),
        (6, "VTOL: transition to fixed wing"),
        (6, "VTOL: flies as a fixed wing"),
    ]
    times = [(s.t, s.value) for c in log.chunks() for s in c.events if s.kind == "param"]
    assert [value for _, value in times] == [("FW_P", 1.0), ("FW_P", 2.5)]
    assert times[1][0] == pytest.approx(START_US * 1e-6 + 2.0, abs=0.11)


@pytest.mark.parametrize(
    ("status", "params", "expected"),
    [
        ({"is_vtol": 1, "system_type": 1}, {}, "quadplane"),
        ({"system_type": 13}, {}, "multirotor"),
        ({"system_type": 0, "is_rotary_wing": 0}, {}, "fixed_wing"),
        ({"vehicle_type": 1}, {}, "multirotor"),
        ({}, {"MAV_TYPE": 4}, "helicopter"),
        ({}, {"SYS_AUTOSTART": 2100}, "fixed_wing"),
        ({}, {}, "unknown"),
    ],
)
def test_the_kind_of_vehicle_is_found_wherever_it_stands(status, params, expected):
    topics = flight((1, 11))
    n = len(topics["vehicle_status"]["timestamp"])
    for name in ("system_type",):
        del topics["vehicle_status"][name]
    topics["vehicle_status"] |= {name: np.full(n, value, "u1") for name, value in status.items()}
    assert read(ulog(topics, params=params)).vehicle == expected


def test_a_nav_state_is_named_as_its_release_meant_it():
    assert [mode_name(6, v) for v in ((1, 8), (1, 15))] == ["RCRECOVER", "POSITION_SLOW"]
    assert [mode_name(s, (1, 13)) for s in (3, 4, 5, 2, 99)] == ["MISSION", "LOITER", "RTL", "POSCTL", "nav_state 99"]


def test_what_was_said_before_the_log_began_is_in_force_when_it_begins():
    topics = flight((1, 11))
    topics["mission_result"]["timestamp"] -= np.uint64(8_000_000)
    topics["position_setpoint_triplet"]["timestamp"] -= np.uint64(8_000_000)
    got = rows(read(ulog(topics)))
    assert got["leg"][0].tolist() == got["target"][0].tolist() == [START_US * 1e-6]


def test_chunks_are_half_a_minute_and_follow_each_other():
    log = read(ulog(flight((1, 11), seconds=95.0)))
    for _ in range(2):  # may be called again
        chunks = list(log.chunks())
        assert len(chunks) == 4
        assert sum(chunk.counts["sensor_combined"] for chunk in chunks) == 9500
        for early, late in pairwise(chunks):
            assert early.rows["imu"][0][-1] < late.rows["imu"][0][0]
            assert np.ptp(early.rows["imu"][0]) <= 30.0


def test_stray_stamps_do_not_take_good_rows_with_them():
    stamp = np.arange(0, 100_000_000, 100_000)
    stamp[[50, 300]] = stamp[500], 0
    order = time_order(stamp)
    assert len(order) == 998
    assert (np.diff(stamp[order]) > 0).all()


# --- a flight of PX4 1.13, as ulog2csv wrote it -----------------------------------------------------------------------


def test_the_table_reads_the_columns_of_a_px4_1_13_flight(recordings):
    names = {
        f"flight3_{name}_0.csv": name for name in ("vehicle_global_position", "airspeed_validated", "airspeed_wind")
    }
    names |= {f"flight3_{n}_0.csv": n for n in ("vehicle_local_position", "actuator_controls_0", "actuator_outputs")}
    names |= {f"flight3_{name}_0.csv": name for name in ("sensor_gps", "sensor_baro", "vehicle_air_data")}
    topics: dict[str, Topic] = {}
    with tarfile.open(recordings / "real/dawn_seaway_flight3_px4_csv.tar.xz") as tar:
        for member in tar:
            if member.name.rpartition("/")[2] in names:
                lines = io.TextIOWrapper(tar.extractfile(member))
                header = next(csv.reader([lines.readline()]))
                table = np.loadtxt(lines, delimiter=",", ndmin=2)
                fields = dict(zip(header, table.T, strict=True))
                topics[names[member.name.rpartition("/")[2]]] = Topic(fields["timestamp"] * 1e-6, fields, topics)
    best = {field: next((x for x in _all(ROWS[field], topics) if len(x[0])), None) for field in ROWS}
    airborne = {f: v[1][(v[0] > 1140) & (v[0] < 1360)] for f, v in best.items() if v is not None}
    flown = {"position", "velocity", "air", "wind", "pressure", "gnss"}  # outputs are all zero: nothing was driven
    assert set(airborne) == flown
    np.testing.assert_allclose(airborne["position"].mean(axis=0)[:2], (423.6e6, -710.9e6), atol=2e5)
    assert 5e3 < airborne["position"][:, 2].mean() < 2e5
    assert airborne["gnss"].mean() == pytest.approx(airborne["position"][:, 2].mean(), abs=1e4)
    fused, raw = (np.median(values) for _, values, _ in _all(ROWS["pressure"], topics))
    assert fused == pytest.approx(raw, abs=100.0)  # one in pascal, the other in millibar
    assert 6 < np.median(airborne["air"][:, 0]) < 15
    assert np.hypot(*airborne["velocity"][:, :2].T).mean() == pytest.approx(np.median(airborne["air"][:, 0]), abs=4)


def _all(candidates, topics) -> list:
    laid = [extract_rows(row, topics[row.message]) for row in candidates if row.message in topics]
    return [x for x in laid if x is not None]
