"""ROS 2 bags of MAVROS and px4_msgs, as MCAP and SQLite, and what is refused of them."""

from pathlib import Path

import numpy as np
import pytest

from fleet.contract import Mission, Status
from tests.fleet.telemetry.onboard_logs.test_table_logs import check_steady_flight, read, rows
from tests.support import tables as made
from tests.support.talker import of

WRITERS = {"flight.mcap": made.write_mcap, "flight.db3": made.write_sqlite}


@pytest.mark.parametrize("name", WRITERS)
def test_a_bag_of_mavros_is_the_flight(tmp_path: Path, name: str) -> None:
    news, skipped, _ = read(WRITERS[name](tmp_path / name))
    check_steady_flight(news)
    np.testing.assert_allclose(rows(news, "imu")[1][0], (0.5, 0.2, -9.8, made.P, made.Q, made.R), atol=1e-9)
    np.testing.assert_allclose(rows(news, "air")[1][0], (14.0, 0.6, 1.0), atol=1e-6)
    np.testing.assert_allclose(rows(news, "servo")[1][0], 1500 + 10 * np.arange(8))
    status, mission = of(Status, news)[-1], of(Mission, news)[-1]
    assert (status.uav, status.mode, status.armed, status.vehicle) == (7, "AUTO", True, "fixed_wing")
    assert mission.complete and (rows(news, "leg")[1] == 2).all()
    assert [(i.seq, i.frame, i.lat_e7) for i in mission.items[:2]] == [(0, 0, 474000000), (1, 3, 474100000)]
    assert len(skipped) == 1 and "fixed wing assumed" in skipped[0]


@pytest.mark.parametrize("name", WRITERS)
def test_a_bag_of_px4_is_read_by_the_table_of_its_logs(tmp_path: Path, name: str) -> None:
    news, _, _ = read(WRITERS[name](tmp_path / name, px4=True))
    t, attitude = rows(news, "attitude")
    truth = (made.ROLL, made.PITCH, made.YAW, made.P, made.Q, made.R)
    np.testing.assert_allclose(attitude, np.tile(truth, (len(t), 1)), atol=1e-6)
    assert np.diff(t) == pytest.approx(made.DT, abs=1e-4)  # stamps of the autopilot, not arrival in the bag
    assert t[0] == pytest.approx(made.T0 + 0.002, abs=0.01)
    status = of(Status, news)[-1]
    assert (status.mode, status.armed, status.autopilot, status.vehicle) == ("MISSION", True, "px4", "fixed_wing")


def test_a_bag_without_definitions_is_refused_with_the_way_out(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"without definition in the bag .*ros2 bag convert"):
        read(made.write_sqlite(tmp_path / "humble.db3", definitions=False))


def test_a_damaged_bag_is_used_up_to_the_damage(tmp_path: Path) -> None:
    path = made.write_mcap(tmp_path / "flight.mcap")
    whole = path.read_bytes()
    for n in (len(whole) // 2, len(whole) - 40, 60):
        path.write_bytes(whole[:n])
        try:
            _, skipped, _ = read(path)
        except ValueError as error:
            skipped = [str(error)]
        assert skipped


def test_a_bag_of_something_else_names_its_topics(tmp_path: Path) -> None:
    path = tmp_path / "flight.db3"
    made.write_sqlite(path)
    path.write_bytes(path.read_bytes().replace(b"/uas7/mavros/", b"/car7/driver/"))
    with pytest.raises(ValueError, match="expected those of MAVROS or /fmu/out/"):
        read(path)


@pytest.mark.parametrize(("name", "head"), [("a.px4log", b"x" * 100), ("a.bag", b"#ROSBAG V2.0\n")])
def test_what_is_not_read_is_refused_by_name(tmp_path: Path, name: str, head: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(head)
    with pytest.raises(ValueError, match="which is not read; convert it"):
        read(path)


def test_an_old_px4_log_is_known_by_its_content(tmp_path: Path) -> None:
    def fmt(number: int, length: int, name: bytes, codes: bytes, labels: bytes) -> bytes:
        return (
            b"\xa3\x95\x80"
            + bytes((number, length))
            + name.ljust(4, b"\0")
            + codes.ljust(16, b"\0")
            + labels.ljust(64, b"\0")
        )

    path = tmp_path / "flight.bin"
    path.write_bytes(
        fmt(128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Labels") + fmt(129, 11, b"TIME", b"Q", b"StartTime")
    )
    with pytest.raises(ValueError, match="SDLOG2"):
        read(path)
