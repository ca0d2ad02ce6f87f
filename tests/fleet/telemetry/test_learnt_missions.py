"""Missions that no list was received of: logged items, set points, position targets, executed commands, files."""

import lzma
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.contract import Item, Mission, Params, Sample
from fleet.frames import Origin
from fleet.mission import LOITER_UNLIMITED, P_E, P_N, extends, route_items, unroll_route
from fleet.telemetry.mavlink.microservices.learned import LearnedMission
from fleet.telemetry.mavlink.microservices.parameter_file import read_parameters
from fleet.telemetry.mavlink.microservices.route import TARGET_AFTER_S, MissionCollector
from fleet.telemetry.recording.options import RecordingOptions
from fleet.telemetry.recording.recordings import Recording
from tests.support.dataflash_writer import Writer
from tests.support.flights import item
from tests.support.talker import of
from tests.support.ulog_writer import START_US, flight, read, said, ulog

HERE = Origin(474000000, 85000000, 400000)


# --- PX4 ------------------------------------------------------------------------------------------------------------


def item_rows(seconds: list[float], seqs: list[int], **changes: list[float]) -> dict:
    n = len(seqs)
    columns = {
        "timestamp": (START_US + 1e6 * np.array(seconds)).astype("<u8"),
        "latitude": 47.4 + 0.01 * np.array(seqs),
        "longitude": np.full(n, 8.5),
        "instance_count": np.zeros(n, "<u4"),
        "nav_cmd": np.full(n, 16, "<u2"),
        "sequence_current": np.array(seqs, "<i4"),
        "altitude": np.full(n, 100.0, "<f4"),
        "acceptance_radius": np.full(n, 20.0, "<f4"),
        "altitude_is_relative": np.ones(n, "u1"),
    }
    return columns | {name: np.array(values).astype(columns[name].dtype) for name, values in changes.items()}


def px4_log(**topics: dict):
    base = {name: columns for name, columns in flight((1, 13)).items() if name not in ("position_setpoint_triplet",)}
    return read(ulog(base | topics))


def test_items_logged_as_they_are_flown_are_the_mission() -> None:
    log = px4_log(navigator_mission_item=item_rows([0.5, 1.5, 3.0], [0, 1, 2]))
    ((items, total),) = said(log, "partial mission")
    assert total == 0 and [(i.seq, i.command, i.frame, i.lat_e7, i.alt_m, i.param2) for i in items] == [
        (k, 16, 3, 474000000 + 100000 * k, 100.0, 20.0) for k in range(3)
    ]
    assert any("assembled from 3 items" in sentence for sentence in log.skipped)


def test_a_jump_back_is_learnt_and_another_mission_begins_at_its_count() -> None:
    rows = item_rows(
        [0.2, 1.0, 2.0, 3.0, 4.0], [1, 3, 1, 0, 1], instance_count=[1, 1, 1, 2, 2], nav_cmd=[16, 17, 16, 16, 16]
    )
    first, second = said(px4_log(navigator_mission_item=rows), "partial mission")
    assert [(i.seq, i.command) for i in first[0]] == [(1, 16), (2, 95), (3, 17), (4, 177)]
    assert (first[0][-1].param1, first[0][-1].param2) == (1.0, -1.0)
    assert [i.seq for i in second[0]] == [0, 1]


def triplet(seconds: np.ndarray, current: list[tuple], following: list[tuple]) -> dict:
    def part(points: list[tuple]) -> dict:
        names = (
            ("lat", "<f8"),
            ("lon", "<f8"),
            ("alt", "<f4"),
            ("type", "u1"),
            ("valid", "u1"),
            ("cruising_speed", "<f4"),
        )
        columns = {
            name: np.array(values).astype(kind)
            for (name, kind), values in zip(names, zip(*points, strict=True), strict=True)
        }
        return columns | {"loiter_radius": np.full(len(points), 80.0, "<f4")}

    stamp = (START_US + 1e6 * seconds).astype("<u8")
    return {"timestamp": stamp, "current": part(current), "next": part(following)}


def test_set_points_become_a_list_that_grows_and_never_runs_ahead() -> None:
    t = np.arange(0.0, 4.8, 0.1)
    points = [(47.41, 8.5, 500.0, 0, 1, 15.0), (47.42, 8.5, 500.0, 0, 1, 15.0), (47.43, 8.5, 500.0, 2, 1, 18.0)]
    now = [min(int(s // 1.6), 2) for s in t]
    now[5] = 2  # one row between two items
    log = _log_of_set_points(t, [points[k] for k in now], [points[min(k + 1, 2)] for k in now])
    events = [event for event in log.events if event.kind == "partial mission"]
    assert [[(i.seq, i.command) for i in event.value[0]] for event in events] == [
        [(0, 178), (1, 16), (2, 16)],
        [(0, 178), (1, 16), (2, 16), (3, 17)],
        [(0, 178), (1, 16), (2, 16), (3, 178), (4, 17), (5, 17)],
    ]
    starts = [event.t - START_US * 1e-6 for event in events]
    assert starts == pytest.approx([0.3, 1.9, 3.5], abs=0.11)  # confirmed after 0.3 s, never before the set point
    assert events[2].value[0][4].param3 == 80.0
    t_leg, seq = log.rows["leg"]
    assert seq[:, 0].tolist() == [1, 1, 1, 1, 2, 2, 4, 4] and (np.diff(t_leg) > 0).all()


def _log_of_set_points(t: np.ndarray, current: list[tuple], following: list[tuple]):
    topics = flight((1, 13))
    for name in ("mission_result", "mission", "navigator_mission_item", "offboard_mission"):
        topics.pop(name, None)
    return read(ulog(topics | {"position_setpoint_triplet": triplet(t, current, following)}))


def test_the_mission_of_a_real_px4_flight_grows_along_its_set_points(recordings: Path) -> None:
    with lzma.open(recordings / "real/px4_proto_flt09.ulg.xz") as file:
        log = read(file.read())
    events = [event for event in log.events if event.kind == "partial mission"]
    assert [event.t for event in events][:4] == pytest.approx([631.2, 701.2, 761.3, 821.4], abs=0.2)
    circle = events[0].value[0][1]
    assert (circle.command, circle.param3, circle.lat_e7, round(circle.alt_m)) == (17, 100.0, 452223434, 352)
    assert [i.param2 for i in events[2].value[0] if i.command == 178] == [17.0, 20.0, 14.0]
    assert events[-1].value[0][-1].command == 21


# --- routes of incomplete lists -------------------------------------------------------------------------------------


def waypoints(*seqs: int) -> tuple[Item, ...]:
    return tuple(item(seq, north=500.0 * seq) for seq in seqs)


def test_an_incomplete_mission_is_flown_to_its_last_known_item_and_no_further() -> None:
    mission = Mission(uav=1, t=0.0, items=waypoints(0, 1, 2), seq=1, complete=False)
    route = unroll_route(route_items(mission), seq=1, origin=HERE, params={})
    last, before = route.legs[-1], route.legs[-2]
    assert int(last[0]) == LOITER_UNLIMITED and last[P_N] == before[P_N] and last[P_E] == before[P_E]
    assert any("item 3: not received" in sentence for sentence in route.sentences)
    complete = unroll_route(
        route_items(Mission(uav=1, t=0.0, items=mission.items, seq=1, complete=True)), seq=1, origin=HERE, params={}
    )
    assert complete.legs[-1][P_N] != before[P_N]


def test_a_gap_ends_what_is_predicted() -> None:
    route = unroll_route(waypoints(0, 1, 2, 5, 6), seq=1, origin=HERE, params={})
    assert route.legs[:, 8].tolist() == [1.0, 2.0, -1.0]
    beyond = unroll_route(waypoints(0, 1, 2, 5, 6), seq=6, origin=HERE, params={})
    assert beyond.legs[0, 8] == 6.0


def test_more_items_of_an_incomplete_mission_are_no_change() -> None:
    assert extends(waypoints(0, 1, 2), waypoints(0, 1)) and extends(waypoints(0, 1, 2, 3), waypoints(0, 3))
    assert not extends(waypoints(0, 1), waypoints(0, 1, 2)) and not extends(waypoints(0, 1), ())
    assert not extends((item(0), item(1, north=1.0)), waypoints(0, 1))


def test_what_is_between_learnt_items_follows_from_their_order() -> None:
    learned = LearnedMission()
    assert all(learned.add(each) for each in (item(1), item(2), item(4), item(1)))
    assert [(i.seq, i.command) for i in learned.items] == [(1, 16), (2, 16), (3, 95), (4, 16), (5, 177)]
    assert not any(learned.add(each) for each in (item(2), item(4), item(1)))


# --- MAVLink --------------------------------------------------------------------------------------------------------


def test_position_targets_with_the_current_item_become_waypoints() -> None:
    collector = MissionCollector(1)

    def at(t: float, seq: int, lat: int) -> Mission | None:
        collector.process(mav.MAVLink_mission_current_message(seq), is_upload=False, now=t)
        collector.add_target(lat, 85000000, 500.0, t)
        return collector.take_update(t)

    published = [at(0.5 * k, 1 if k < 60 else 3, 474000000 + (0 if k < 61 else 1000000)) for k in range(80)]
    assert not any(published[: round(TARGET_AFTER_S / 0.5)])  # the list may still arrive
    made = [mission for mission in published if mission and mission.items]
    first, last = made[0].items, made[-1].items
    assert [(i.seq, i.lat_e7, i.frame) for i in first] == [(1, 474000000, 0)] and not made[0].complete
    assert [(i.seq, i.command) for i in last] == [(1, 16), (2, 95), (3, 16)] and last[2].lat_e7 == 475000000
    assert "position targets" in made[-1].sentence
    collector.set_items(waypoints(0, 1))
    assert not collector.needs_targets and collector.take_update(99.0).items == waypoints(0, 1)


# --- DataFlash ------------------------------------------------------------------------------------------------------


def commands(*rows: tuple[float, int, int]):
    """A log with CMD messages: time [s], item, number of items."""
    writer = Writer().fmt("CMD", "QHHHffffLLfB", "TimeUS,CTot,CNum,CId,Prm1,Prm2,Prm3,Prm4,Lat,Lng,Alt,Frame")
    for t, seq, total in rows:
        writer.say("CMD", round(t * 1e6), total, seq, 16, 0.0, 0.0, 0.0, 0.0, 47.0 + seq, 8.5, 30.0, 3 if seq else 0)
    events = [event for chunk in writer.log().chunks() for event in chunk.events]
    return [(event.kind, event.value) for event in events if "mission" in event.kind]


def test_a_dataflash_log_begun_in_flight_learns_from_the_executed_items() -> None:
    events = commands((1.0, 2, 6), (20.0, 3, 6), (40.0, 4, 6))
    assert [kind for kind, _ in events] == ["partial mission"] * 3
    assert [([i.seq for i in items], total) for _, (items, total) in events][-1] == ([2, 3, 4], 6)


def test_an_incomplete_list_is_published_as_such_and_completed_in_flight() -> None:
    events = commands((1.0, 0, 4), (1.02, 1, 4), (8.0, 2, 4), (16.0, 3, 4), (17.0, 3, 4), (18.0, 3, 4))
    assert events[0][0] == "partial mission" and [i.seq for i in events[0][1][0]] == [0, 1]
    assert events[-1][0] == "mission" and [i.seq for i in events[-1][1]] == [0, 1, 2, 3]


# --- files ----------------------------------------------------------------------------------------------------------

WPL = "QGC WPL 110\n" + "".join(
    f"{k}\t0\t{0 if k == 0 else 3}\t16\t0\t0\t0\t0\t{47.4 + 0.01 * k}\t8.5\t100\t1\n" for k in range(3)
)


def test_mission_and_parameters_from_files_replace_the_recorded(tmp_path: Path, recordings: Path) -> None:
    (tmp_path / "a.waypoints").write_text(WPL)
    (tmp_path / "a.param").write_text("WP_RADIUS,90\n# a comment\nSERVO1_FUNCTION 4\n1 1 RTL_ALT 50.5 9\n")
    options = RecordingOptions(str(tmp_path / "a.waypoints"), str(tmp_path / "a.param"))
    path = recordings / "real/alfa_20180718_155331_1_engine_failure.tlog"
    news = [n for _, step in Recording(path, options=options).steps() for n in step]
    missions, params = of(Mission, news), of(Params, news)
    assert all(m.complete and [i.seq for i in m.items] == [0, 1, 2] for m in missions) and missions
    assert params[0].values["WP_RADIUS"] == 90.0 and params[0].values["RTL_ALT"] == 50.5
    assert len(of(Sample, news)) == len(of(Sample, [n for _, step in Recording(path).steps() for n in step]))


@pytest.mark.parametrize("text", ["", "WP_RADIUS", "WP RADIUS 3 4", "A,nan", "\x00\x01"])
def test_a_bad_parameter_file_is_refused_with_its_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.param"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"a\.param"):
        read_parameters(path)
