"""Recording as a link: replayed at any speed, optionally with copies of aircraft, in its own process."""

import argparse
import contextlib
import itertools
import logging
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from fleet.config import router_options
from fleet.contract import FleetState
from fleet.process.children import PARENT
from fleet.telemetry.mavlink.steps import STEP_S
from fleet.telemetry.recording.fleet_news import renumbered
from fleet.telemetry.recording.ids import IdAllocator
from fleet.telemetry.recording.opening import ReplayPace
from fleet.telemetry.recording.recordings import Recording
from fleet.telemetry.replay.offset_copies import OffsetCopies
from gateway.link_spec import LinkSpec
from gateway.links.link import POLL_S, QUEUE, Batch, Endpoint

READ_AHEAD_S = 3.0  # recorded time read ahead to find the aircraft [s]
_MAX_READ_AHEAD = 100  # steps read ahead before the first message
_IN_FLIGHT = 4096  # messages between replay and publication, approximately

_log = logging.getLogger(__name__)


class ReplayLink(Endpoint):
    """Recording replayed at a multiple of real time.

    Args:
        spec: the link
        ids: assignment of UAV ids, shared by all recordings that are replayed together
    Raises:
        ValueError: when the file is not a recording.
        OSError: when it cannot be read.
    """

    def __init__(self, spec: LinkSpec, ids: IdAllocator | None = None) -> None:
        super().__init__(spec)
        self.recording = Recording(spec.address, spec.offset, spec.options)
        self.pace = ReplayPace(spec.speed)
        self._ids = IdAllocator() if ids is None else ids
        self._copies = OffsetCopies(spec.copies)
        self._uav_ids: dict[int, int] = {}  # UAV id by recorded id
        self._steps: Iterator[tuple[float, list[Any]]] | None = None

    @property
    def name(self) -> str:
        """Return the file name."""
        return self.recording.name

    @property
    def damage(self) -> str:
        """Return what could not be read, known at the end of the recording; empty: everything was read."""
        return "; ".join(self.recording.skipped)

    @property
    def share(self) -> float:
        """Return the progress of reading, 0..1."""
        return self.recording.share

    def progress_text(self) -> str:
        """Return the progress and speed of the replay."""
        return self.pace.progress_text() if self.pace.passed_s else "scanning"

    def read_ahead(self, stop: threading.Event) -> None:
        """Read ahead, so that all aircraft have an id before the first message is published.

        Raises:
            ValueError: when the recording is empty.
            OSError: when it cannot be read.
        """
        self.recording.source.stop = stop
        steps = self.recording.steps(self.spec.results)
        ahead: list[tuple[float, list[Any]]] = []
        first_t: float | None = None
        try:
            for now, messages in steps:
                ahead.append((now, messages))
                first_t = now if first_t is None and messages else first_t
                if len(ahead) >= _MAX_READ_AHEAD or (first_t is not None and now > first_t + READ_AHEAD_S):
                    break
        except ValueError:
            if not stop.is_set():
                raise
        self._assign_ids([message for _, news in ahead for message in news])
        self._steps = itertools.chain(ahead, steps)

    def _assign_ids(self, messages: Sequence[Any]) -> None:
        """Assign ids to new aircraft: first to the recorded ones, then to their copies, copy by copy."""
        new_uavs = sorted({m.uav for m in messages if not isinstance(m, FleetState)} - self._uav_ids.keys())
        for uav in new_uavs:
            self._uav_ids[uav] = self._ids.allocate((self, uav, 0), uav)
            if self._uav_ids[uav] != uav:
                _log.warning("%s: uav-%d is in use, replayed as uav-%d", self.name, uav, self._uav_ids[uav])
        ids = [[self._ids.allocate((self, uav, copy), self._uav_ids[uav]) for uav in new_uavs]
               for copy in range(1, self.spec.copies)]  # fmt: skip
        for k, uav in enumerate(new_uavs):
            self._copies.set_ids(self._uav_ids[uav], [row[k] for row in ids])

    def start(self, number: int, out: "queue.Queue[Batch]", stop: threading.Event) -> None:
        """Replay in a thread."""
        if self._steps is None:
            self.read_ahead(stop)
        super().start(number, out, stop)

    def _run(self) -> None:
        try:
            self._replay()
        except (ValueError, OSError) as error:  # a read error, or a file without aircraft
            if not self._stop.is_set():
                _log.warning("%s", error)
        finally:
            for sentence in [] if self._stop.is_set() else self.recording.skipped:
                _log.warning("%s", sentence)
            self._wait_and_put(Batch(self._number, ended=True), QUEUE)

    def _replay(self) -> None:
        assert self._steps is not None
        max_queued = max(_IN_FLIGHT // self.spec.copies, 8)
        now = 0.0
        for now, messages in self._steps:
            if self.pace.wait(now, self._stop):
                return
            self._assign_ids(messages)
            renumbered_batch = self._renumber(messages)
            copied = self._copies.step(renumbered_batch)
            if renumbered_batch or copied:
                self._wait_and_put(Batch(self._number, messages=renumbered_batch, copies=copied), max_queued)
        for k, copied in enumerate(self._copies.remaining(), start=1):
            if self.pace.wait(now + k * STEP_S, self._stop):
                return
            self._wait_and_put(Batch(self._number, copies=copied), max_queued)

    def _wait_and_put(self, batch: Batch, max_queued: int) -> None:
        """Queue a batch once fewer than `max_queued` are queued."""
        while not self._stop.is_set():
            if self._out.qsize() >= max_queued:
                self._stop.wait(0.005)
                continue
            with contextlib.suppress(queue.Full):
                return self._out.put(batch, timeout=POLL_S)

    def _renumber(self, messages: Sequence[Any]) -> list[Any]:
        if all(uav == assigned for uav, assigned in self._uav_ids.items()):
            return list(messages)
        renamed = (renumbered(message, lambda uav: self._uav_ids.get(uav, uav)) for message in messages)
        return [message for message in renamed if message is not None]


_STOP_TIMEOUT_S = 8.0  # between the request to terminate and the kill [s]


def split_replays(specs: Sequence[LinkSpec]) -> tuple[list[LinkSpec], list[LinkSpec]]:
    """Return the links to open here, and the recordings to replay separately: all, if there is a live link."""
    files = [spec for spec in specs if spec.kind == "replay"]
    live = [spec for spec in specs if spec.kind != "replay"]
    return (live, files) if live else (files, [])


@contextmanager
def replay_process(files: Sequence[LinkSpec], args: argparse.Namespace) -> Iterator[None]:
    """Replay recordings in a separate process until they or the block end.

    Args:
        files: the recordings; none: no process
        args: arguments of this gateway; those of the router and the limits are passed on
    """
    if not files:
        yield
        return
    options = [f"--link={spec.text.partition('#')[0]}#offset={spec.offset}" for spec in files]
    options += [*router_options(args), "--listen-only", f"--most-uavs={args.most_uavs}"]
    options += ["--log-json"] if args.log_json else []
    command = [sys.executable, "-m", "gateway", *options]
    child = subprocess.Popen(command, stdin=subprocess.DEVNULL, env=os.environ | {PARENT: str(os.getpid())})
    ended = threading.Event()
    watcher = threading.Thread(target=_report_exit, args=(child, ended), daemon=True)
    watcher.start()
    try:
        yield
    finally:
        ended.set()
        if child.poll() is None:
            child.terminate()
        try:
            child.wait(_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
        watcher.join()


def _report_exit(child: subprocess.Popen[bytes], ended: threading.Event) -> None:
    code = child.wait()
    if code and not ended.is_set():
        _log.warning("the replay of recordings ended with exit code %d; the live links continue", code)
