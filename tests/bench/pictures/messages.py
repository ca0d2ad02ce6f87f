"""Messages of a flight: simulated into a recording, processed by twins offline, and published again on a bus."""

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
from fleet.terrain.areas import Area
from tests.bench.mismatch.flown import Inline
from tests.bench.mismatch.world import baseline
from tests.bench.viewing.process import free_port
from twin_worker.alerts.traffic import TrafficMonitor
from twin_worker.mismatch.coordinator import ALL_UAVS, Coordinator
from twin_worker.proposals.proposer import PROPOSED, Proposer
from twin_worker.twin.step import Twin, advance

ROOT = Path(__file__).resolve().parents[3]
STAMP = Stamp(1, 0xABCD)
FAST, SLOW = 40.0, 0.12  # publication over real time: until the moment of the picture, and while it is drawn
SETTLED_S = 120.0  # earliest moment of a picture after the start [s]
NEAR_S, BEST_S, FAR_S, STEADY = 25.0, 55.0, 90.0, 8  # horizon for a picture [s], and number of predictions in a row

TimedMessages = list[tuple[float, Any, Stamp | None]]
"""Time [s since 1970], message, and stamp of its writer."""


def recorded_flight(name: str, *options: str) -> Path:
    """Simulate aircraft into a recording, which is reused the next time."""
    path = private_files.ensure_private_folder(private_files.cache_folder() / "pictures", "pictures") / f"{name}.tlog"
    if not path.is_file():
        command = [sys.executable, "-m", "fleet.cli", "fly", *options, "--seed", "1", "--tlog", str(path)]
        subprocess.run(command, cwd=ROOT, check=True)
    return path


def twin_messages(
    path: Path, diagnosed: int | None = None, *, proposes: bool = False, areas: tuple[Area, ...] = ()
) -> TimedMessages:
    """Return the messages of a recording and those of its twins, in the order of time.

    Args:
        path: the recording
        diagnosed: UAV whose mismatch is diagnosed; None: of none
        proposes: include the proposals against its alerts
        areas: of the operator
    """
    messages: TimedMessages = []
    twins: dict[int, Twin] = {}
    traffic, hand = TrafficMonitor(), Inline()
    proposer = Proposer(traffic.separation, lambda uav: copy.deepcopy(twins.get(uav)), traffic.picture.forecasts)
    with tempfile.TemporaryDirectory() as folder:
        live = Coordinator(hand, {ALL_UAVS: baseline(1, Path(folder))}) if diagnosed is not None else None
    for now, news in Recording(str(path), 0).steps():
        for message in news:
            messages.append((now, message, None))
            twin = twins.setdefault(message.uav, Twin.of(message.uav))
            twin.areas = areas
            messages += [
                (now, result, STAMP)
                for result in traffic.process_results(
                    twin.config.uav, twin.telemetry.last_step_t, advance(twin, (message,))
                )
            ]
            last_t = twin.telemetry.last_step_t
            active = (*traffic.active(message.uav), *twin.alerts.alarms.active) if proposes else ()
            due = [one for one in active if one.kind in PROPOSED and proposer.due(one, last_t)]
            messages += [(now, one, STAMP) for alert in due if (one := proposer.update(alert, last_t)) is not None]
            if live is not None and isinstance(message, Sample) and message.uav == diagnosed:
                hand.now = message.t
                messages += [(now, result, STAMP) for result in live.run_once([(twin, nullcontext())])]
    return messages


def position_at(path: Path, uav: int, seconds: float) -> tuple[int, int]:
    """Return latitude and longitude of an aircraft `seconds` after its first position [1e-7 deg]."""
    start = inf
    for _, news in Recording(str(path), 0).steps():
        for message in news:
            if isinstance(message, Sample) and message.uav == uav and message.position is not None:
                t, x = message.position.t.numpy(), message.position.x.numpy()
                start = min(start, float(t[0]))
                if t[-1] >= start + seconds:
                    return int(x[-1, 0]), int(x[-1, 1])
    raise ValueError(f"{path.name}: found no position of UAV {uav} after {seconds:.0f} s, expected one; fly longer")


def with_replay_link(messages: TimedMessages, name: str) -> TimedMessages:
    """Add the counters of a gateway that replays the recording `name`."""
    found: TimedMessages = []
    for t, message, stamp in messages:
        found.append((t, message, stamp))
        if isinstance(message, Status):
            found.append((t, GatewayCounters(t=t, links=(f"replay:{name}",), uavs=(message.uav,)), None))
    return found


def moment(messages: TimedMessages, since: float = SETTLED_S, uav: int | None = None) -> tuple[int, float]:
    """Choose the UAV to show and the time [s since 1970].

    Its confidence horizon is neither short nor long for a while; else it is the horizon nearest to `BEST_S`.

    Args:
        messages: of the flight
        since: earliest time after the start [s]
        uav: the UAV to show; None: any
    """
    best, least = None, inf
    otherwise, otherwise_off = (0 if uav is None else uav, messages[-1][0]), inf
    runs: dict[int, list[float]] = defaultdict(list)
    for t, message, _ in messages:
        if isinstance(message, Prediction) and t > messages[0][0] + since and uav in (None, message.uav):
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


def proposed(messages: TimedMessages, since: float, uav: int | None = None) -> tuple[int, float]:
    """Return the UAV of the first proposal with options after `since` [s], and the time 1 s later [s since 1970]."""
    start = messages[0][0] + since
    offers = (m for t, m, _ in messages if t > start and isinstance(m, Proposal) and m.options)
    first = next(m for m in offers if uav in (None, m.uav))
    return first.uav, next(t for t, _, _ in messages if t >= first.t + 1.0)


def named_s(messages: TimedMessages) -> float:
    """Return the time from the first message to the first mismatch that is named and used in predictions [s]."""
    found = (m for _, m, _ in messages if isinstance(m, Mismatch) and m.outcome is DiagnosisOutcome.NAMED and m.adapted)
    return float(next(found).t) - messages[0][0]


class Publisher:
    """Publishes messages on a router of its own: fast until a moment [s since 1970], then slowly, while it is drawn."""

    def __init__(self, messages: TimedMessages, moment: float) -> None:
        self._messages, self._moment, self.router = messages, moment, f"tcp/127.0.0.1:{free_port()}"
        self.reached, self._stop = threading.Event(), threading.Event()  # the moment is reached; end
        self._session = open_router(self.router)
        self._thread = threading.Thread(target=self._publish)

    def __enter__(self) -> "Publisher":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        self._session.close()

    def begin(self) -> None:
        """Begin, once all receivers are subscribed."""
        self._thread.start()

    def _publish(self) -> None:
        with connect(self.router) as bus:
            due, before = time.monotonic(), self._messages[0][0]
            for t, message, stamp in self._messages:
                due += (t - before) / (SLOW if t > self._moment else FAST)
                before = t
                if self._stop.wait(max(due - time.monotonic(), 0.0)):
                    return
                bus.publish(message, stamp)
                if t >= self._moment:
                    self.reached.set()
