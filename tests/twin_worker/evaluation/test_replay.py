"""Recordings through the twins on the command line: what is printed, what is written, what goes wrong."""

import json

import pytest

from fleet.process.logs import strip_time
from fleet.simulator.flight.drive import to_tlog
from fleet.simulator.flight.uav import SimulatedUav
from twin_worker.evaluation.replay import WITHIN_S, format_row, main, replay

ROW = {"vehicle", "seconds", "methods", "first_verified_s", "scored", "within_10_percent", "verdict", "prediction"}


def test_a_flight_becomes_a_row_and_lines(heard):
    (row,) = replay(heard).values()
    assert set(row) == ROW and row["vehicle"] == "fixed_wing"
    on_route = sum(row["methods"].get(way, 0) for way in ("hybrid", "both", "dynamics"))
    assert on_route > 20 and 30 < row["first_verified_s"] < 90
    scored = row["scored"]
    assert sum(scored.values()) >= 5
    for method, shares in row["within_10_percent"].items():
        assert set(shares) == {str(s) for s in WITHIN_S} and scored[method]
        assert 1 >= shares["10"] >= shares["30"] >= shares["60"] >= 0
    said = format_row("1", row)
    assert said.startswith("uav-1: fixed_wing") and "verified after" in said and "within 10 %" in said


def test_the_command_writes_what_it_prints(tmp_path, capsys):
    path = tmp_path / "short.tlog"
    to_tlog(path, [SimulatedUav(0, 3, wind=3.0)], seconds=20, loss=0.0, seed=3)
    assert main(["--json", str(tmp_path / "out.json"), "--offset", "4", str(path), str(path)]) == 0
    out = capsys.readouterr().out
    assert out.count("short.tlog: 1 UAVs") == 2 and "uav-5: fixed_wing" in out and "verified never" in out
    (rows,) = json.loads((tmp_path / "out.json").read_text()).values()
    assert set(rows) == {"5"} and set(rows["5"]) == ROW
    assert rows["5"]["prediction"] and rows["5"]["first_verified_s"] is None


def test_progress_goes_to_stderr(heard, capsys):
    replay(heard, "flight")
    err = capsys.readouterr().err
    assert strip_time(err).startswith("flight: 60 s of flight, 1 UAVs")


@pytest.mark.parametrize("name", ["nothing.tlog", "notes.txt"])
def test_what_is_no_recording_is_one_sentence(tmp_path, capsys, name):
    (tmp_path / "notes.txt").write_text("hello")
    assert main([str(tmp_path / name)]) != 0
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and name in err and "Traceback" not in err
