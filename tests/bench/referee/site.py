"""One site as processes: router, gateway that plays copies of a flight, workers behind ways of their own."""

import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path

from fleet.access.entry import ROUTER, parse_endpoint
from fleet.access.knock import accepts_connections
from fleet.bus.session import connect
from fleet.simulator.flight.drive import to_tlog
from fleet.simulator.flight.uav import SimulatedUav

from .forwarder import Forwarder
from .reader import Reader

ROOT = Path(__file__).resolve().parents[3]
PACE = "predict=5,identify=5,ensemble=5,renew=0.1"
_OPEN = "from fleet.bus.session import open_router; from fleet.cli import stop_on_signal; import sys; "
_ROUTER = _OPEN + "session = open_router(sys.argv[1]); stop_on_signal().wait(); session.close()"


def until(condition: Callable[[], object], patience_s: float, what: str) -> float:
    """Wait for a condition; give how long it took [s].

    Raises:
        TimeoutError: when it does not come true.
    """
    begun, never = time.monotonic(), threading.Event()
    while not condition():
        if time.monotonic() - begun > patience_s:
            raise TimeoutError(f"referee: {what} did not come within {patience_s:.0f} s")
        never.wait(0.02)
    return time.monotonic() - begun


def cpu_s(pid: int) -> float:
    """Give the processor time that a process has used so far, all its threads [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def rss_mb(pid: int) -> float:
    """Give the resident memory of a process [MB]."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def fly(path: Path, seconds: float = 1200.0) -> Path:
    """Fly one pretend aircraft in wind and turbulence, and record it."""
    to_tlog(path, [SimulatedUav(0, 3, wind=3.0, turbulence=2)], seconds=seconds, loss=0.01, seed=3)
    return path


class Worker:
    """One worker process, and its way to the router where it has one of its own."""

    def __init__(self, site: "Site", way: Forwarder | None) -> None:
        self.way = way
        router = site.router if way is None else f"tcp/127.0.0.1:{way.port}"
        command = ("twin_worker", "--uavs", f"0-{site.uavs - 1}", "--no-diagnosis", "--pace", site.pace)
        self.process = site.start(*command, "--router", router, name="worker")
        self._said = site.log_of(self.process)

    @property
    def name(self) -> str:
        """Give the name it claims by; empty before it says so."""
        found = re.search(r"twin_worker ([0-9a-f]{16}): serves", self._said.read_text(errors="replace"))
        return found[1] if found else ""

    def signal(self, number: int) -> None:
        """Send a signal."""
        self.process.send_signal(number)

    def end(self) -> None:
        """End it without a word."""
        if self.process.poll() is None:
            self.signal(signal.SIGKILL)
        self.process.wait()
        if self.way is not None:
            self.way.__exit__()

    @property
    def cpu_s(self) -> float:
        """Give the processor time used so far [s]."""
        return cpu_s(self.process.pid)

    @property
    def rss_mb(self) -> float:
        """Give its resident memory [MB]."""
        return rss_mb(self.process.pid)


class Site(AbstractContextManager):
    """Everything that runs.

    Args:
        uavs: aircraft
        zenohd: the real router; None: a session of ours in router mode
        ways: so many workers reach the router by a way that can be cut
    """

    def __init__(
        self, uavs: int, router: str = ROUTER, *, zenohd: str | None = None, pace: str = PACE, ways: int = 0
    ) -> None:
        self.uavs, self.router, self.zenohd, self.pace, self.ways = uavs, router, zenohd, pace, ways
        self.workers: list[Worker] = []
        self.wanted = 0  # workers that there should be
        self.spared: Worker | None = None  # it is never killed nor sent away
        self.reader: Reader = None  # type: ignore[assignment]
        self._stack = ExitStack()
        self._running: list[subprocess.Popen] = []
        self._logs: dict[int, Path] = {}
        self._log = Path(self._stack.enter_context(tempfile.TemporaryDirectory()))

    def open(self, recording: Path | None, workers: int) -> None:
        """Start router, reader, workers and, once these can take over, the gateway.

        Args:
            recording: a flight to play; None: one is flown first
            workers: how many
        """
        self.open_router()
        self.reader = Reader(self._stack.enter_context(connect(self.router)))
        if recording is None:
            recording = fly(self._log / "flight.tlog")
        for _ in range(workers):
            self.add()
        link = f"--link=replay:{recording}?copies={self.uavs}"
        self.gateway = self.start("gateway", link, "--offset=-1", "--router", self.router, name="gateway")

    def open_router(self) -> None:
        """Start the router."""
        if self.zenohd is not None:
            config = str(ROOT / "deploy" / "zenohd.json5")
            command = [self.zenohd, "-c", config, "-l", self.router, "--no-multicast-scouting"]
        else:
            command = [sys.executable, "-c", _ROUTER, self.router]
        self.router_process = self._begin(command, "router")
        until(lambda: accepts_connections(self.router), 60.0, "the router")

    def add(self) -> Worker:
        """Start a worker, and wait until it may claim."""
        ways = sum(worker.way is not None for worker in self.workers)
        worker = Worker(self, Forwarder(parse_endpoint(self.router)) if ways < self.ways else None)
        self.workers.append(worker)
        until(lambda: worker.name or worker.process.poll() is not None, 300.0, "a worker")
        return worker

    def lose(self, worker: Worker) -> None:
        """Count a worker no longer."""
        self.workers.remove(worker)
        worker.end()

    def start(self, module: str, *options: str, name: str) -> subprocess.Popen:
        """Start `python -m module options…`."""
        return self._begin([sys.executable, "-m", module, *options], name)

    def _begin(self, command: list[str], name: str) -> subprocess.Popen:
        path = self._log / f"{name}{len(self._running)}.txt"
        with path.open("wb") as out:
            child = subprocess.Popen(command, cwd=ROOT, stdout=out, stderr=subprocess.STDOUT)
        self._running.append(child)
        self._logs[child.pid] = path
        return child

    def log_of(self, child: subprocess.Popen) -> Path:
        """Give the file of what a process says."""
        return self._logs[child.pid]

    def words(self) -> str:
        """Give the last words of every process."""
        said = [(path.name, path.read_text(errors="replace")[-400:]) for path in sorted(self._log.glob("*.txt"))]
        return "\n".join(f"{name}: {text}" for name, text in said if text.strip())

    def __exit__(self, *_: object) -> None:
        for child in self._running:
            if child.poll() is None:
                child.send_signal(signal.SIGCONT)
                child.kill()
                child.wait()
        for worker in self.workers:
            worker.end()
        self._stack.close()
