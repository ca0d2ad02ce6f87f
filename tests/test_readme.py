"""README and documentation: Python blocks run, shell lines parse, links and named files exist, nothing is remote."""

import argparse
import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import msgpack
import msgspec
import numpy as np
import pytest
import yaml
from conftest import ROOT, unused_port

from docs import check_offline, generate
from fleet import cli
from fleet.access.entry import ROUTER
from fleet.bus.bus_protocol import QueryHandler
from fleet.bus.codec import Stamp
from fleet.bus.session import connect, open_router
from fleet.contract import Array, Prediction, TwinState
from fleet.process import file_options
from gateway import __main__ as gateway
from tests.support.memory_bus import MemoryBus
from twin_worker import __main__ as twin_worker
from twin_worker.service.queries import QueryHandlers
from twin_worker.service.worker import Worker
from viewer import __main__ as viewer

README = (ROOT / "README.md").read_text()
MAINS = {"fleet": cli.main, "gateway": gateway.main, "twin_worker": twin_worker.main, "viewer": viewer.main}
WRITTEN = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "deploy/README.md"]
WRITTEN += sorted(
    str(path.relative_to(ROOT))
    for path in (ROOT / "docs").rglob("*.md")
    if path.parent != generate.REFERENCE or path.name not in generate.PAGES
)
TEXTS = {name: (ROOT / name).read_text() for name in WRITTEN}
WRONG = "docs/wrong-inputs.md"  # commands that are refused, see tests/fleet/test_wrong_inputs.py
MOST_LINES = 150  # of the README
NOT_RUN = re.compile(r"<!-- not run: \w[^>]*-->\n*\Z")
VARIABLE = re.compile(r"PARAUAV_[A-Z_]*[A-Z]")


def blocks(text: str) -> list[str]:
    """The Python blocks of a page, without those that are marked as not run."""
    found = re.finditer(r"^```python[^\n]*\n(.*?)^```", text, re.M | re.S)
    return [block[1] for block in found if not NOT_RUN.search(text[: block.start()])]


def tools() -> list[str]:
    """The foreign tools: position in 30 s (README), what-if (reference)."""
    return [*blocks(README), *blocks(TEXTS["docs/reference/index.md"])]


def answers(*_: object) -> Iterator[tuple[Prediction, Stamp]]:
    """Two UAVs due north and due east; of the second also answers of an older owner and of a forger."""
    for uav, velocity, epoch in (
        (3, (20.0, 0.0, -1.0), 5),
        (7, (0.0, 15.0, 0.0), 9),
        (7, (99.0, 99.0, 99.0), 2),
        (7, (77.0, 77.0, 77.0), 2**64 - 1),
    ):
        ahead = np.array([0.0, 30.0])
        prediction = Prediction(
            uav=uav,
            t=time.time() - 4 * uav,
            state=TwinState.PREDICTING,
            method="paper",
            origin=(470_000_000, 80_000_000, 500_000),
            ahead=Array.of(ahead),
            path=Array.of(ahead[:, None] * np.array(velocity) + np.array([0.0, 0.0, -100.0])),
            prediction_region_half_axes=Array.of(np.ones((2, 3))),
            horizon_s=10.0 + uav,
        )
        yield prediction, Stamp(epoch, 1)


def run_tool(code: str, folder: Path, reply: QueryHandler) -> list[str]:
    """Run a foreign tool against a bus where predictions are answered by `reply`; give what it prints."""
    where = f"tcp/127.0.0.1:{unused_port()}"
    script = folder / "tool.py"
    assert ROUTER in code
    script.write_text(code.replace(ROUTER, where))
    router = open_router(where)
    try:
        with connect(where) as bus:
            bus.declare_queryable(Prediction, reply)
            env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
            command = [sys.executable, "-I", "-W", "error", str(script)]
            done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, timeout=60, check=False)
    finally:
        router.close()
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.splitlines()


def test_the_foreign_tool_prints_where_everyone_will_be(tmp_path: Path) -> None:
    origin = "above [470000000, 80000000, 500000]"
    lines = [line.split(" old, ") for line in run_tool(tools()[0], tmp_path, answers)]
    assert [line[1] for line in lines] == [
        f"horizon 13.0 s; 600.0 m north, 0.0 m east, 130.0 m {origin}",
        f"horizon 17.0 s; 0.0 m north, 450.0 m east, 100.0 m {origin}",
    ]
    told = [line[0].removesuffix(" s").rpartition(" ") for line in lines]
    assert [words for words, _, _ in told] == ["uav 3: predicting,", "uav 7: predicting,"]
    ages = [int(age) for _, _, age in told]
    assert 12 <= ages[0] < 40 and ages[1] - ages[0] in (15, 16, 17)  # seconds of a busy machine pass before it prints


def test_a_foreign_tool_asks_what_if(tmp_path: Path, holder: Worker) -> None:
    (held,) = holder.owned_twins()
    held.twin.config = msgspec.structs.replace(held.twin.config, uav=7)
    seven = QueryHandlers(MemoryBus().writer, lambda: [held])
    seven.predictions(7, {}, msgpack.packb({"speed": 18.0}))  # compiles what a running worker has compiled
    (line,) = run_tool(tools()[1], tmp_path, seven.predictions)
    assert line.startswith("what if it flew at 18 m/s, the wind blew 3 m/s north and -1 east, NAVL1_PERIOD were 25")
    assert line.endswith("{'NAVL1_PERIOD': 25.0, 'AIRSPEED_CRUISE': 18.0}")
    (refused,) = run_tool(tools()[1].replace("18.0", "-18.0"), tmp_path, seven.predictions)
    assert refused == "what if: speed: found -18.0 m/s, expected above 0 to 300; correct it"


def test_every_python_block_is_run_by_a_test_or_marked() -> None:
    from tests.twin_worker.diagnosis.test_newcomer_effect import DOOR

    assert sorted(block for text in TEXTS.values() for block in blocks(text)) == sorted([*tools(), DOOR])


def test_the_foreign_tools_need_two_packages_and_eleven_lines() -> None:
    assert len(tools()) == 2
    for code, clock in zip(tools(), ("time, ", ""), strict=True):
        assert re.findall(r"^import (.*)", code, re.M) == [f"struct, {clock}msgpack, zenoh"]
        assert len(code.splitlines()) <= 11


# --- shell lines -----------------------------------------------------------------------------------------------------


def prose(text: str) -> str:
    return re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)


def commands(text: str = README) -> list[str]:
    """Every call of our own commands: indented blocks, and code spans in the text."""
    lines = re.findall(r"^    ((?:fleet|gateway|twin_worker|viewer|make) .*)", prose(text), re.M)
    spans = re.findall(r"`((?:fleet|gateway|twin_worker|viewer|make) [^`]+)`", prose(text))
    return sorted({bare(line) for line in lines + spans})


def bare(line: str) -> str:
    """A shell line without its comment; a # within a word belongs to a link."""
    return re.split(r"\s#", line)[0].strip()


def shell_blocks(text: str) -> Iterator[tuple[list[str], bool]]:
    """Every indented block that follows an empty line, and whether it is marked as not run, with a reason."""
    for found in re.finditer(r"\n\n((?:    .*\n)+)", prose(text)):
        lines = [bare(line) for line in found[1].splitlines()]
        yield [line for line in lines if line], bool(NOT_RUN.search(prose(text)[: found.start() + 2]))


def shown() -> list[str]:
    """The examples in the help of every command, as the generated page shows them."""
    lines = re.findall(r"^  ((?:PARAUAV_\w+=\S+ )?(?:fleet|gateway|twin_worker|viewer)\b.*)", generate.cli_page(), re.M)
    return sorted({re.split(r"\s{2,}", line)[0] for line in lines})


@pytest.mark.parametrize(
    "line",
    sorted({line for name, text in TEXTS.items() if name != WRONG for line in commands(text)} | set(shown())),
)
def test_every_command_is_understood(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert understood(line, monkeypatch)


def understood(line: str, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Tell whether the command itself takes a line; what its shell would do (`> FILE`) is left out."""
    words = shlex.split(re.sub(r"^\w+=\S+ ", "", line.split(" > ")[0]))
    if words[0] == "make":
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.M)
        options = [word.removeprefix("UP=") for word in words[2:] if word.startswith("UP=")]
        words = ["fleet", "up", *(shlex.split(options[0]) if options else [])]
    if words[0] == "fleet" and len(words) == 2:
        return words[1] in cli.command_modules()  # the mention of a verb, which may need more
    taken: list[argparse.Namespace] = []

    def note(_: str, __: object, args: argparse.Namespace) -> int:
        taken.append(args)
        return 0

    for module in (cli, gateway, twin_worker, viewer):
        monkeypatch.setattr(module, "run_command", note)
    monkeypatch.setattr(file_options, "_unreadable", lambda *_: "")  # the reader has the files
    return MAINS[words[0]](words[1:]) == 0 and bool(taken)


def known(line: str) -> bool:
    """Tell whether a line is one that tests parse, or calls a bench or a script that exists with such options."""
    words = shlex.split(line)
    if re.match(r"(?:\w+=\S+ )?(?:fleet|gateway|twin_worker|viewer|make) ", line):
        return True  # parsed by the test above
    if words[:2] == ["sh", "deploy/certificates.sh"]:
        return bool(re.search(rf"^{words[2]}\)", (ROOT / words[1]).read_text(), re.M))
    if words[0] not in ("python", ".venv-bench/bin/python") or words[1] != "-m":
        return False
    path = ROOT / words[2].replace(".", "/")
    files = sorted(path.glob("*.py")) if path.is_dir() else [path.with_suffix(".py")]
    if not all(file.is_file() for file in files):
        return False
    sources = "".join(file.read_text() for file in files)
    return "__main__" in sources + str(files) and all(f'"{word}"' in sources for word in words if word.startswith("--"))


@pytest.mark.parametrize("page", WRITTEN)
def test_every_shell_line_is_known_or_its_block_says_why_it_is_not_run(page: str) -> None:
    strange = [line for lines, marked in shell_blocks(TEXTS[page]) if not marked for line in lines if not known(line)]
    assert strange == []


def test_the_rule_above_catches_unknown_lines_and_honours_marks() -> None:
    text = "x\n\n    zenohd -c a\n\n<!-- not run: not ours -->\n\n    zenohd -c b\n\n<!-- not run: -->\n\n    rm c\n"
    assert list(shell_blocks(text)) == [(["zenohd -c a"], False), (["zenohd -c b"], True), (["rm c"], False)]
    strange = (
        "zenohd -c a",
        "python -m tests.bench.nothing",
        "python -m tests.bench.scale --no-such",
        "sh deploy/x.sh",
    )
    assert not any(map(known, strange)) and known("python -m tests.bench.scale --only curve")


def test_the_pages_name_enough_commands_for_the_tests_above_to_mean_something() -> None:
    assert len(commands()) > 10
    assert len({line for text in TEXTS.values() for line in commands(text)}) > 50
    assert len(shown()) > 50


# --- links, files, names ---------------------------------------------------------------------------------------------

LINKS = sorted(
    {
        (page, target)
        for page, text in TEXTS.items()
        for target in re.findall(r"\]\((?!https?:)([^)]+)\)", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S))
    }
)


def slugs(text: str) -> set[str]:
    """The anchors of the headings of a page."""
    heads = re.findall(r"^#+ (.*)$", prose(text), re.M)
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", head).strip().lower()) for head in heads}


@pytest.mark.parametrize(("page", "target"), LINKS)
def test_links_and_pictures_lead_somewhere(page: str, target: str) -> None:
    name, _, anchor = target.partition("#")
    path = ((ROOT / page).parent / name).resolve() if name else ROOT / page
    if path.parent == generate.REFERENCE and path.name in generate.PAGES:
        text = generate.PAGES[path.name]()
    else:
        assert path.is_file()
        text = path.read_text() if path.suffix == ".md" else ""
    assert not anchor or anchor in slugs(text)


@pytest.mark.parametrize("page", WRITTEN)
def test_files_and_folders_named_in_the_text_exist(page: str) -> None:
    named = re.findall(r"`((?:deploy|docs|fleet|gateway|twin_worker|viewer|tests)/[\w./-]*)`", TEXTS[page])
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_the_readme_is_short() -> None:
    assert len(README.splitlines()) <= MOST_LINES


def test_every_page_is_in_the_navigation() -> None:
    def pages(entry: object) -> Iterator[str]:
        if isinstance(entry, str):
            yield entry
        else:
            for part in entry.values() if isinstance(entry, dict) else entry:  # type: ignore[attr-defined]
                yield from pages(part)

    configured = yaml.safe_load((ROOT / "mkdocs.yml").read_text())
    written = {name.removeprefix("docs/") for name in WRITTEN if name.startswith("docs/")}
    assert configured["strict"] is True
    assert set(pages(configured["nav"])) == written | {f"reference/{name}" for name in generate.PAGES}


def test_the_architecture_page_lists_the_folders_of_the_worker() -> None:
    listed = set(re.findall(r"^\| `(\w+)/`", TEXTS["docs/architecture.md"], re.M))
    assert listed == {path.parent.name for path in (ROOT / "twin_worker").glob("*/__init__.py")}


def test_every_environment_variable_is_documented() -> None:
    folders = ("fleet", "gateway", "twin_worker", "viewer", "tests")
    sources = "".join(path.read_text() for folder in folders for path in (ROOT / folder).rglob("*.py"))
    assert set(VARIABLE.findall(TEXTS["docs/reference/index.md"])) == set(VARIABLE.findall(sources))


# --- the site --------------------------------------------------------------------------------------------------------


def test_generated_pages_name_every_command_key_metric_and_effect() -> None:
    commands = generate.cli_page()
    assert all(f"### fleet {verb}\n" in commands for verb in cli.command_modules())
    assert all(f"class {name}(" in (ROOT / "fleet" / "contract.py").read_text() for name in ("Sample", "Prediction"))
    assert (
        "`parauav/{uav}/prediction`" in generate.messages_page()
        and "| `horizon_s` | float |" in generate.messages_page()
    )
    assert "`parauav_link_messages_total` | counter | link |" in generate.metrics_page()
    assert all(
        f"`{name}`" in generate.metrics_page() for name in re.findall(r"`(parauav_\w+)`", TEXTS["deploy/README.md"])
    )
    assert "## icing" in generate.effects_page() and "at = " in generate.configuration_page()


def test_remote_resources_of_a_site_are_found(tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text('<a href="https://a.example"><link rel="canonical" href="https://a.example">')
    assert check_offline.main([str(tmp_path)]) == 0
    (tmp_path / "index.html").write_text('<script src="//b.example/x.js"></script>')
    (tmp_path / "x.css").write_text("@import 'https://c.example/font.css'; a { background: url(local.png) }")
    assert check_offline.remote_resources(tmp_path) == [
        "index.html: //b.example/x.js",
        "x.css: https://c.example/font.css",
    ]
    assert check_offline.main([str(tmp_path)]) == check_offline.main([str(tmp_path / "nothing")]) == 1
