"""What every test shares: the recordings, a browser, a free port, the option that renews the golden bytes."""

import fleet  # noqa: F401  before numpy: it holds BLAS to one thread

# isort: split

import contextlib
import copy
import itertools
import os
import shutil
import signal
import socket
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import hypothesis
import numpy as np
import pytest

from fleet.bus.session import open_router
from fleet.contract import Message
from tests.support import flights, hover
from tests.support.memory_bus import MemoryBus
from twin_worker.confidence.tube_and_horizon import ConfidenceTracker
from twin_worker.evaluation.replay import run_offline
from twin_worker.prediction.method_selection import MethodSelector
from twin_worker.service.worker import OwnedTwin, Worker
from twin_worker.twin.step import Twin

ROOT = Path(__file__).resolve().parent.parent
LONG_FILES = pytest.StashKey[list[str]]()
HEAVY = (  # files by the time they take, so that none begins when the others have ended; the rest follows by name
    *("effect_injection", "twin", "prove", "browser_access", "diagnose_flightstack", "end_to_end"),
    *("diagnose_concealed", "browser", "assess", "damage", "mismatch_shown", "diagnose_past", "browser_sizes"),
    *("inject", "paper", "rotor", "diagnose_page", "readme", "takeover", "diagnose_bad_input", "security"),
    *("calibration", "diagnose_real", "late_arrival", "mismatch_live", "live_offline", "conceal", "every_vehicle"),
)
"""The first two begin at once: one compiles the twin's physics, the other has no need of it."""
# Properties are checked on the same examples in every run; `--hypothesis-profile explore` looks for new ones.
hypothesis.settings.register_profile("seeded", derandomize=True, database=None, deadline=None)
hypothesis.settings.register_profile("explore", max_examples=5_000, deadline=None)
hypothesis.settings.load_profile("seeded")
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--golden", action="store_true", help="write tests/golden/ anew instead of comparing with it")


def pytest_sessionstart() -> None:
    """Undo a shell that lets what it starts in the background ignore Ctrl-C: every child would inherit that."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def recordings() -> Path:
    """Folder of recorded flights; a test that needs it is skipped where it is absent."""
    folder = Path(os.environ.get("PARAUAV_RECORDINGS") or ROOT.parent / "shared" / "recordings")
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}; name their folder in PARAUAV_RECORDINGS")
    return folder


@pytest.fixture(scope="session")
def chromium() -> str:
    """Path of a browser; without one the test is skipped, or fails under CI=1."""
    found = os.environ.get("PARAUAV_CHROMIUM") or next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        reason = "no chromium; install it (apt-get install chromium) or name one in PARAUAV_CHROMIUM"
        (pytest.fail if os.environ.get("CI") else pytest.skip)(reason)
    return found


_PORTS = itertools.cycle(np.random.default_rng(os.getpid()).permutation(np.arange(20_000, 32_000)).tolist())
"""Below those the system hands out by itself: none is taken between being found free and being used."""


def unused_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """Number of a loopback port that nobody holds, and that this process has not given before."""
    for port in _PORTS:
        with contextlib.suppress(OSError), socket.socket(type=kind) as s:
            s.bind(("127.0.0.1", port))
            return port
    raise AssertionError


def exit_code(run: Callable[[], int]) -> int | str | None:
    """Return the exit code of a command, also where its parser ends it."""
    try:
        return run()
    except SystemExit as left:
        return left.code


@pytest.fixture
def free_port() -> int:
    """The same, as a fixture."""
    return unused_port()


@pytest.fixture(scope="module")
def router() -> Iterator[str]:
    """Endpoint of a router on a free loopback port."""
    where = f"tcp/127.0.0.1:{unused_port()}"
    session = open_router(where)
    yield where
    session.close()


def pytest_configure(config: pytest.Config) -> None:
    config.stash[LONG_FILES] = []
    if "PARAUAV_ONBOARD" not in os.environ:  # not the user's own; processes of this run share it
        folder = tempfile.TemporaryDirectory(prefix="parauav-onboard-")
        config.add_cleanup(folder.cleanup)
        os.environ["PARAUAV_ONBOARD"] = folder.name
    config.option.loadscopereorder = False  # pytest-xdist puts files of many tests first, which are the quick ones


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put heavy files first."""
    rank = {f"test_{name}": k for k, name in enumerate(HEAVY)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    if found := config.stash[LONG_FILES]:
        terminalreporter.write_line("over 250 lines, think again: " + ", ".join(found))


@pytest.fixture(scope="session")
def heard(tmp_path_factory) -> tuple[Message, ...]:
    """What the gateway says of one pretend flight."""
    return flights.pretend(tmp_path_factory.getbasetemp())


@pytest.fixture(scope="session")
def flown(tmp_path_factory) -> tuple[Twin, list[Message]]:
    """The twin at the end of the flight, and everything it published."""
    return flights.learnt(tmp_path_factory.getbasetemp())


@pytest.fixture
def twin(flown) -> Twin:
    """A copy of that twin, to do anything with."""
    return copy.deepcopy(flown[0])


@pytest.fixture(params=["dynamics", "hybrid", "greybox"])
def winged(request, twin) -> Twin:
    """The same, with one of its models and with none."""
    if request.param != "dynamics":
        twin.models.active_model = None
    if request.param != "hybrid":
        twin.models.point_mass = None
    twin.prediction.selector = MethodSelector()
    return twin


@pytest.fixture(scope="session")
def hovering() -> Twin:
    """A multirotor's twin in the middle of its mission."""
    twins: dict[int, Twin] = {}
    for _ in run_offline(hover.fly(3).messages[:500], twins):
        pass
    return twins[7]


@pytest.fixture
def hovered(hovering) -> Twin:
    """A copy of it, to do anything with."""
    return copy.deepcopy(hovering)


@pytest.fixture
def sighted(monkeypatch) -> float:
    """A confidence horizon of every prediction, whatever the tables say [s]."""
    seconds, trust = 12.0, ConfidenceTracker.confidence_of
    monkeypatch.setattr(
        ConfidenceTracker, "confidence_of", lambda *given: replace(trust(*given), horizon_s=seconds, horizon_open=False)
    )
    return seconds


@pytest.fixture
def holder(twin) -> Worker:
    """A worker that holds that twin, on a bus in memory."""
    worker = Worker(MemoryBus(), range(1, 5), omega=0.0)
    worker.connect()
    worker._owned[1] = OwnedTwin(twin, epoch=9)
    return worker
