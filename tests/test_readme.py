"""The README keeps its word: the foreign tool runs, the commands parse, the links lead somewhere."""

import argparse
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT, unused_port

from fleet import cli
from fleet.access.entry import ROUTER
from fleet.bus.bus_protocol import Answer
from fleet.bus.codec import Stamp
from fleet.bus.memory_bus import MemoryBus
from fleet.bus.session import connect, open_router
from fleet.contract import Array, Prediction, State
from gateway import __main__ as gateway
from twin_worker import __main__ as twin_worker
from twin_worker.service.queries import Answers
from twin_worker.service.worker import Worker
from viewer import __main__ as viewer

README = (ROOT / "README.md").read_text()
MAINS = {"fleet": cli.main, "gateway": gateway.main, "twin_worker": twin_worker.main, "viewer": viewer.main}


def tools() -> list[str]:
    """The foreign tools: who will be where, and what if."""
    return re.findall(r"^```python\n(.*?)^```", README, re.M | re.S)


def answers(*_: object) -> Iterator[tuple[Prediction, Stamp]]:
    """Two UAVs due north and due east; of the second also what an older owner and a forger would say."""
    for uav, velocity, epoch in (
        (3, (20.0, 0.0, -1.0), 5),
        (7, (0.0, 15.0, 0.0), 9),
        (7, (99.0, 99.0, 99.0), 2),
        (7, (77.0, 77.0, 77.0), 2**64 - 1),
    ):
        ahead = np.array([0.0, 30.0])
        prediction = Prediction(
            uav=uav,
            t=1.0,
            state=State.PREDICTING,
            method="paper",
            origin=(470_000_000, 80_000_000, 500_000),
            ahead=Array.of(ahead),
            path=Array.of(ahead[:, None] * np.array(velocity) + np.array([0.0, 0.0, -100.0])),
            tube=Array.of(np.ones((2, 3))),
            horizon_s=10.0 + uav,
        )
        yield prediction, Stamp(epoch, 1)


def run_tool(code: str, folder: Path, reply: Answer) -> list[str]:
    """Run a foreign tool against a bus where predictions are answered by `reply`; give what it prints."""
    where = f"tcp/127.0.0.1:{unused_port()}"
    script = folder / "tool.py"
    assert ROUTER in code
    script.write_text(code.replace(ROUTER, where))
    router = open_router(where)
    try:
        with connect(where) as bus:
            bus.answer(Prediction, reply)
            env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
            command = [sys.executable, "-I", "-W", "error", str(script)]
            done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, timeout=60, check=False)
    finally:
        router.close()
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.splitlines()


def test_the_foreign_tool_prints_where_everyone_will_be(tmp_path: Path) -> None:
    origin = "above [470000000, 80000000, 500000]"
    assert run_tool(tools()[0], tmp_path, answers) == [
        f"uav 3: 600.0 m north, 0.0 m east, 130.0 m {origin}; horizon 13.0 s",
        f"uav 7: 0.0 m north, 450.0 m east, 100.0 m {origin}; horizon 17.0 s",
    ]


def test_a_foreign_tool_asks_what_if(tmp_path: Path, holder: Worker) -> None:
    (held,) = holder.holding()
    held.twin.uav = 7
    seven = Answers(MemoryBus().writer, lambda: [held])
    (line,) = run_tool(tools()[1], tmp_path, seven.predictions)
    assert line.startswith("what if it flew at 18 m/s, the wind blew 3 m/s north and -1 east, NAVL1_PERIOD were 25")
    assert line.endswith("{'NAVL1_PERIOD': 25.0, 'AIRSPEED_CRUISE': 18.0}")
    (refused,) = run_tool(tools()[1].replace("18.0", "-18.0"), tmp_path, seven.predictions)
    assert refused == "what if: speed: found -18.0 m/s, expected above 0 to 300; correct it"


def test_the_foreign_tools_need_two_packages_and_eleven_lines() -> None:
    assert len(tools()) == 2
    for code, clock in zip(tools(), ("time, ", ""), strict=True):
        assert re.findall(r"^import (.*)", code, re.M) == [f"struct, {clock}msgpack, zenoh"]
        assert len(code.splitlines()) <= 11


def commands(text: str = README) -> list[str]:
    """Every call of our own commands: indented blocks, and code spans in the text."""
    prose = re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)
    lines = re.findall(r"^    ((?:fleet|gateway|twin_worker|viewer|make) .*)", prose, re.M)
    # a # within a word belongs to a link
    spans = re.findall(r"`((?:fleet|gateway|twin_worker|viewer|make) [^`]+)`", prose)
    return sorted(
        {re.split(r"\s#", line)[0].strip() for line in lines + spans if "──" not in line}
    )  # a link may hold a #


@pytest.mark.parametrize("line", commands())
def test_every_command_is_understood(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert understood(line, monkeypatch)


def understood(line: str, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Tell whether the command itself takes a line; what its shell would do (`> FILE`) is left out."""
    words = shlex.split(line.split(" > ")[0])
    if words[0] == "make":
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.M)
        options = [word.removeprefix("UP=") for word in words[2:]]
        words = ["fleet", "up", *(shlex.split(options[0]) if options else [])]
    taken: list[argparse.Namespace] = []

    def note(_: str, __: object, args: argparse.Namespace) -> int:
        taken.append(args)
        return 0

    for module in (cli, gateway, twin_worker, viewer):
        monkeypatch.setattr(module, "guarded", note)
    return MAINS[words[0]](words[1:]) == 0 and bool(taken)


def test_the_readme_names_enough_commands_for_the_test_above_to_mean_something() -> None:
    assert len(commands()) > 15


@pytest.mark.parametrize("target", sorted(set(re.findall(r"\]\((?!https?:|#)([^)]+)\)", README))))
def test_links_and_pictures_lead_somewhere(target: str) -> None:
    assert (ROOT / target.split("#")[0]).is_file()


def test_files_named_in_the_text_exist() -> None:
    named = re.findall(r"`((?:deploy|fleet|gateway|twin_worker|viewer|tests)/[\w./-]+\.\w+)`", README)
    assert named
    assert [name for name in named if not (ROOT / name).is_file()] == []
