"""Ctrl-C ends a command with exit code 130 and one line, at whatever line of ours it comes."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterable

import pytest
from conftest import ROOT

from fleet.process import interrupt
from fleet.process.interrupt import INTERRUPTED, run_interruptible
from tests.support import long_tlog

PATIENCE_S = 120.0
PHASES = {
    "fleet/commands": 3,
    "fleet/cli.py": 2,
    "fleet/telemetry": 3,
    "fleet/report/report_text.py": 1,
    "fleet/report/progress.py": 2,
}
"""Files of ours, and at how many of their lines Ctrl-C comes."""
STRIKER = """
import atexit, os, signal, sys
AT, OURS = int(os.environ["STRIKE_AT"]), tuple(os.environ["STRIKE_IN"].split(os.pathsep))
ready, struck, seen = False, False, set()

def lines(frame, event, arg):
    global ready, struck
    if not ready and signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        ready = True
        atexit.register(count)  # not before ours, which runs last and ends the process
    if event == "line" and ready and not struck:
        seen.add((frame.f_code.co_filename, frame.f_lineno))
        if len(seen) == AT:
            struck = True
            signal.raise_signal(signal.SIGINT)
    return lines

def calls(frame, event, arg):
    return lines if frame.f_code.co_filename.startswith(OURS) else None

def count():
    sys.settrace(None)
    if AT == 0:
        os.write(2, f"lines {[sum(name.startswith(ours) for name, _ in seen) for ours in OURS]}".encode())

sys.settrace(calls)
"""
CALLBACK = """
import ctypes, signal, sys
from fleet.cli import run_command

def work(args):
    noted = ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.SIGINT))
    noted()  # the interpreter cannot raise through C: what is raised there is dropped
    for k in range(10**9):
        pass
    return 0

sys.exit(run_command("fleet", work, None))
"""
TEARDOWN = """
import atexit, os, sys
from fleet.cli import run_command

class Global:
    def __del__(self):
        os.write(2, b"torn down")

def work(args):
    print("done", end="")
    if int(sys.argv[1]) == 2:
        raise ValueError("refused")
    return int(sys.argv[1])

kept = Global()
atexit.register(os.write, 1, b"cleaned up ")
sys.exit(run_command("fleet", work, None))
"""


@pytest.fixture(scope="module")
def tlog(tmp_path_factory):
    path = tmp_path_factory.mktemp("flight") / "flight.tlog"
    long_tlog.write(path, 0.5)
    return path


@pytest.fixture(scope="module")
def hook(tmp_path_factory):
    """A folder on the path of a child, whose lines it then counts; the signal comes at one of them."""
    folder = tmp_path_factory.mktemp("hook")
    (folder / "sitecustomize.py").write_text(STRIKER)
    return folder


@pytest.fixture(scope="module")
def lines(hook, tlog) -> dict[str, int]:
    """How many lines of each phase an undisturbed inspection runs through."""
    whole = struck(hook, PHASES, 0, "fleet.cli", "inspect", str(tlog))
    assert whole.returncode == 0
    return dict(zip(PHASES, json.loads(whole.stderr.rpartition("lines ")[2]), strict=True))


def struck(hook, within: Iterable[str], at: int, *command: str) -> subprocess.CompletedProcess[str]:
    env = os.environ | {
        "STRIKE_AT": str(at),
        "STRIKE_IN": os.pathsep.join(str(ROOT / each) for each in within),
        "PYTHONPATH": f"{hook}:{ROOT}",
    }
    return subprocess.run(
        [sys.executable, "-m", *command], env=env, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )


@pytest.mark.parametrize("within", PHASES)
def test_ctrl_c_at_any_line_of_inspect_gives_130_and_one_line(tlog, hook, lines, within):
    for k in range(PHASES[within]):
        at = 1 + (2 * k + 1) * lines[within] // (2 * PHASES[within])
        found = struck(hook, [within], at, "fleet.cli", "inspect", str(tlog))
        said = found.stderr.strip("\r\n").splitlines()
        assert (found.returncode, len(said)) == (INTERRUPTED, 1), (at, found.stderr)
        assert said[0] in ("fleet: interrupted", "fleet inspect: interrupted")


@pytest.mark.parametrize(
    "module", ["gateway", "twin_worker", "viewer", "twin_worker.evaluation", "twin_worker.evaluation.replay"]
)
def test_every_command_ends_so_while_it_is_being_loaded(hook, module):
    found = struck(hook, ["fleet/cli.py"], 5, module, "--help")
    assert (found.returncode, found.stderr) == (INTERRUPTED, f"{module}: interrupted\n")


def test_what_the_interpreter_drops_is_raised_anew(tmp_path):
    program = tmp_path / "fleet"
    program.write_text(CALLBACK)
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, program], env=env, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert (done.returncode, done.stderr) == (INTERRUPTED, "fleet: interrupted\n")


def test_an_error_that_a_library_makes_of_ctrl_c_is_not_told_as_one(handled):
    def work() -> int:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise RuntimeError("no object was compiled") from None
        return 0

    assert run_interruptible(work) == INTERRUPTED


def test_ctrl_c_that_comes_in_a_deferred_block_is_raised_at_its_end(handled):
    done = []

    def work() -> int:
        with interrupt.interrupt_deferred():
            signal.raise_signal(signal.SIGINT)
            done.append("within")
        done.append("after")
        return 0

    assert run_interruptible(work) == INTERRUPTED and done == ["within"]


def test_an_error_without_ctrl_c_is_still_one(handled):
    def work() -> int:
        raise RuntimeError("a defect")

    with pytest.raises(RuntimeError, match="a defect"):
        run_interruptible(work)
    assert run_interruptible(lambda: 3) == 3


def test_a_program_that_uses_us_as_a_library_keeps_its_own_handler():
    code = "import signal, fleet; raise SystemExit(signal.getsignal(signal.SIGINT) is not signal.default_int_handler)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


@pytest.fixture
def handled(monkeypatch):
    """The handler of a command, in this process."""
    before = signal.signal(signal.SIGINT, interrupt._on_sigint)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(("name", "torn_down"), [("fleet", False), ("other", True)])
@pytest.mark.parametrize("code", [0, 1, 2])
@pytest.mark.parametrize("trap", ["", "trap '' INT; "], ids=["foreground", "background"])
def test_a_command_ends_without_tearing_down_the_interpreter(trap, code, name, torn_down, tmp_path):
    """Else a thread of a foreign library that asks for the interpreter in that moment aborts the process.

    What a shell starts in the background ignores SIGINT.
    """
    (tmp_path / name).write_text(TEARDOWN)
    script = f'{trap}exec "$0" "$@"'
    command, env = [sys.executable, str(tmp_path / name), str(code)], os.environ | {"PYTHONPATH": str(ROOT)}
    command = ["sh", "-c", script, *command]
    ended = subprocess.run(command, env=env, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert (ended.returncode, ended.stdout) == (code, "donecleaned up ")
    assert ended.stderr.endswith("torn down") == torn_down
