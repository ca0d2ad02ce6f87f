"""`fleet whatif`: options and mission files become a question, the answer a few lines."""

import argparse

import pytest

from fleet.commands.live import whatif as command
from fleet.contract import MAX_ITEMS, Prediction
from tests.support.memory_bus import MemoryBus

WPL = """QGC WPL 110
0\t1\t0\t16\t0\t0\t0\t0\t47.4\t8.5\t450\t1
1\t0\t3\t16\t0\t0\t0\t0\t47.41\t8.51\t100\t1
2\t0\t3\t177\t1\t-1\t0\t0\t0\t0\t0\t1
"""


def options(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    command.arguments(parser)
    return parser.parse_args(["1", *words])


def test_a_mission_file_becomes_a_question(tmp_path):
    path = tmp_path / "other.waypoints"
    path.write_text(WPL)
    got = command.build_request(options("--items", str(path), "--seq", "1", "--param", "WP_RADIUS=40", "--wind=-3,2"))
    assert [(i.seq, i.command, i.lat_e7, i.param2) for i in got.items] == [
        (0, 16, 474_000_000, 0.0), (1, 16, 474_100_000, 0.0), (2, 177, 0, -1.0)
    ]  # fmt: skip
    assert (got.seq, got.params, got.wind) == (1, {"WP_RADIUS": 40.0}, (-3.0, 2.0))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "first line"),
        ("[mission]\n", "first line"),
        ("QGC WPL 110\n", "found 0 items"),
        (WPL + "3\t0\t3\n", "line 5"),
        (WPL.replace("47.41", "north"), "line 3"),
        (WPL.replace("47.41", "147.41"), "a position on earth"),
        (WPL.replace("8.51", "nan"), "a position on earth"),
        ("QGC WPL 110\n" + "\n".join(WPL.splitlines()[2:3] * (MAX_ITEMS + 1)), "1,001 items"),
    ],
)
def test_a_file_that_is_no_mission_is_refused_by_its_line(tmp_path, text, words):
    path = tmp_path / "odd.waypoints"
    path.write_text(text)
    with pytest.raises(ValueError, match=words):
        command.build_request(options("--items", str(path)))


@pytest.mark.parametrize(
    "words", [("--start=1,2",), ("--start=1,2,nan",), ("--wind=1",), ("--param", "NAVL1_PERIOD"), ("--param", "A=b")]
)
def test_an_option_that_makes_no_sense_is_refused(words):
    with pytest.raises(ValueError, match=r"found .*expected"):
        command.build_request(options(*words))


def test_the_path_is_told_in_a_few_lines(holder, monkeypatch, capsys):
    monkeypatch.setattr(command, "connect", lambda _: holder.bus)
    holder.bus.get(Prediction, 1)
    assert command.run(options("--speed", "18")) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "it flew at 18 m/s" in lines[0] and "horizon" in lines[1]
    assert [int(line.split()[0]) for line in lines[3:]] == [0, 5, 10, 20, 30, 45, 60, 92, 120, 180]
    assert float(lines[3].split()[-1]) < 30.0 < float(lines[-1].split()[4])


def test_nobody_there_is_said(monkeypatch, capsys):
    monkeypatch.setattr(command, "connect", lambda _: MemoryBus())
    assert command.run(options()) == 1
    assert "found no worker that replies" in capsys.readouterr().err
