"""What is said of a flight: flown into a recording, judged by twins that need not hurry, and said again on a bus."""

import copy
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from contextlib import nullcontext
from math import inf
from pathlib import Path
from types import TracebackType
from typing import Any

from fleet.bus.codec import Stamp
from fleet.bus.session import connect, open_router
from fleet.contract import DiagnosisOutcome, GatewayCounters, Mismatch, Prediction, Proposal, Sample, Status
from fleet.process import private_files
from fleet.telemetry.recording.recordings import Recording
from tests.bench.mismatch.flown import Inline
from tests.bench.mismatch.world import baseline
from tests.bench.viewing.process import free_port
from twin_worker.alerts.traffic import TrafficMonitor
from twin_worker.mismatch.coordinator import ALL_UAVS, Coordinator
from twin_worker.proposals.proposer import Proposer
from twin_worker.twin.step import Twin, advance

ROOT = Path(__file__).resolve().parents[3]
STAMP = Stamp(1, 0xABCD)
HASTE, SLOW = 40.0, 0.12  # times as fast as it was: until the moment, and from then on, for a browser takes its time
SETTLED_S = 120.0  # so late a moment may be, at the earliest [s]
NEAR_S, BEST_S, FAR_S, STEADY = 25.0, 55.0, 90.0, 8  # a horizon for a picture, for so many predictions in a row [s]

Said = list[tuple[float, Any, Stamp | None]]
"""When [s since 1970], what, and by whose claim."""


def flown(name: str, *options: str) -> Path:
    """Fly simulated aircraft into a recording, kept for the next time."""
    path = private_files.ensure_private_folder(private_files.cache_folder() / "pictures", "pictures") / f"{name}.tlog"
    if not path.is_file():
        command = [sys.executable, "-m", "fleet.cli", "fly", *options, "--seed", "1", "--tlog", str(path)]
        subprocess.run(command, cwd=ROOT, check=True)
    return path


def judged(path: Path, diagnosed: int | None = None, *, proposes: bool = False) -> Said:
    """Let twins judge a recording; of one UAV also what its simulation lacks. Everything said, in the order of time.

    With `proposes`, what a worker would propose against the alerts.
    """
    said: Said = []
    twins: dict[int, Twin] = {}
    traffic, hand = TrafficMonitor(), Inline()
    proposer = Proposer(traffic.separation, lambda uav: copy.deepcopy(twins.get(uav)), traffic.picture.forecasts)
    with tempfile.TemporaryDirectory() as folder:
        live = Coordinator(hand, {ALL_UAVS: baseline(1, Path(folder))}) if diagnosed is not None else None
    for now, news in Recording(str(path), 0).steps():
        for message in news:
            said.append((now, message, None))
            twin = twins.setdefault(message.uav, Twin.of(message.uav))
            said += [
                (now, told, STAMP)
                for told in traffic.process_results(
                    twin.config.uav, twin.telemetry.last_step_t, advance(twin, (message,))
                )
            ]
            last_t = twin.telemetry.last_step_t
            due = [one for one in traffic.active(message.uav) if proposes and proposer.due(one, last_t)]
            said += [(now, told, STAMP) for alert in due if (told := proposer.update(alert, last_t)) is not None]
            if live is not None and isinstance(message, Sample) and message.uav == diagnosed:
                hand.now = message.t
                said += [(now, told, STAMP) for told in live.run_once([(twin, nullcontext())])]
    return said


def played(said: Said, name: str) -> Said:
    """Have a gateway say beside it that it plays a recording."""
    found: Said = []
    for t, message, stamp in said:
        found.append((t, message, stamp))
        if isinstance(message, Status):
            found.append((t, GatewayCounters(t=t, links=(f"replay:{name}",), uavs=(message.uav,)), None))
    return found


def moment(said: Said, since: float = SETTLED_S, uav: int | None = None) -> tuple[int, float]:
    """Choose whom to show and when [s since 1970]: whose horizon is neither near nor far for a while.

    Where nobody's is, as open horizons are far, it is the one with the best horizon of any kind.

    Args:
        said: all that was said
        since: of its time, from when on [s]
        uav: of whom alone; None: of anybody
    """
    best, least = None, inf
    otherwise, otherwise_off = (0 if uav is None else uav, said[-1][0]), inf
    runs: dict[int, list[float]] = defaultdict(list)
    for t, message, _ in said:
        if isinstance(message, Prediction) and t > said[0][0] + since and uav in (None, message.uav):
            run = runs[message.uav]
            if message.horizon_s >= NEAR_S and (off := abs(message.horizon_s - BEST_S)) < otherwise_off:
                otherwise, otherwise_off = (message.uav, t), off
            if message.horizon_open or not NEAR_S <= message.horizon_s <= FAR_S:
                run.clear()
                continue
            run.append(t)
            if len(run) >= STEADY and (off := abs(message.horizon_s - BEST_S)) < least:
                best, least = (message.uav, t), off
    return best or otherwise


def offered(said: Said, since: float) -> tuple[int, float]:
    """Tell of whom and when something is first proposed after `since` [s], and 1 s later [s since 1970]."""
    first = next(m for t, m, _ in said if t > said[0][0] + since and isinstance(m, Proposal) and m.options)
    return first.uav, next(t for t, m, _ in said if t >= first.t + 1.0)


def named_s(said: Said) -> float:
    """Tell how long after the first word a mismatch was first named and predicted with [s]."""
    found = (m for _, m, _ in said if isinstance(m, Mismatch) and m.outcome is DiagnosisOutcome.NAMED and m.adapted)
    return float(next(found).t) - said[0][0]


class Speaker:
    """Says it on a router of its own: in haste until a moment [s since 1970], then slowly, so that it can be seen."""

    def __init__(self, said: Said, moment: float) -> None:
        self._said, self._moment, self.router = said, moment, f"tcp/127.0.0.1:{free_port()}"
        self.there, self._stop = threading.Event(), threading.Event()  # the moment has come; enough is said
        self._session = open_router(self.router)
        self._thread = threading.Thread(target=self._speak)

    def __enter__(self) -> "Speaker":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        self._session.close()

    def begin(self) -> None:
        """Begin to speak: whoever is to hear all of it listens."""
        self._thread.start()

    def _speak(self) -> None:
        with connect(self.router) as bus:
            due, before = time.monotonic(), self._said[0][0]
            for t, message, stamp in self._said:
                due += (t - before) / (SLOW if t > self._moment else HASTE)
                before = t
                if self._stop.wait(max(due - time.monotonic(), 0.0)):
                    return
                bus.publish(message, stamp)
                if t >= self._moment:
                    self.there.set()
