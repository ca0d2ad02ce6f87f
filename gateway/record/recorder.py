"""Recording thread: queues received bytes without blocking and writes them to disk."""

import logging
import queue
import threading
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import NamedTuple

from fleet.telemetry.mavlink.parsing.received import ReceivedBytes
from fleet.telemetry.mavlink.parsing.scan import STAMP_SIZE
from gateway.links.link import QUEUE_BYTES, Batch
from gateway.record.cut import FRAMES, FrameCutter
from gateway.record.tape import DiskBudget, TlogWriter

MOST = 64 << 20  # bytes waiting for the disk; beyond, they are dropped and counted
WRITE_S = 0.25  # between two writes: the longest loss at a crash [s]

_log = logging.getLogger(__name__)


class RecordingCounters(NamedTuple):
    """Byte counters of one link: `received` is the sum of the five after it, without the time stamps of the file."""

    received: int = 0  # bytes
    recorded: int = 0  # in frames, on disk
    noise: int = 0  # outside frames, not recorded
    lost: int = 0  # write errors
    dropped: int = 0  # queue overflow
    waiting: int = 0  # in the queue, or in incomplete frames
    frames: int = 0  # recorded or lost
    fault: str = ""


class _LinkRecording:
    """Recording of one link: writer and counters [bytes]."""

    def __init__(self, tape: TlogWriter) -> None:
        self.writer, self.cutter = tape, FrameCutter()
        self.received = self.recorded = self.lost = self.dropped = 0

    def write(self, pieces: Sequence[ReceivedBytes]) -> None:
        before = int(self.cutter.counts[FRAMES])
        records = b"".join(map(self.cutter.feed, pieces))
        size = len(records) - STAMP_SIZE * (int(self.cutter.counts[FRAMES]) - before)
        if self.writer.write(records, time.monotonic()):
            self.lost += size
        else:
            self.recorded += size

    def counters(self) -> RecordingCounters:
        frames, noise = self.cutter.counts.tolist()
        accounted = (self.recorded, noise, self.lost, self.dropped)
        return RecordingCounters(self.received, *accounted, self.received - sum(accounted), frames, self.writer.fault)


class LinkRecorder(AbstractContextManager):
    """Record links as `.tlog`.

    Args:
        budget: of the folder
        names: of the links
    """

    def __init__(self, budget: DiskBudget, names: Sequence[str]) -> None:
        self.budget = budget
        self._recordings = [_LinkRecording(TlogWriter(name, budget, len(names))) for name in names]
        self._lock = threading.Lock()
        self._waiting: list[tuple[int, ReceivedBytes]] = []
        self._size = 0  # bytes waiting
        self._logged: set[str] = set()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder")
        self._thread.start()

    def add(self, link: int, received: ReceivedBytes) -> None:
        """Queue pieces of one link; thread-safe, never waits for the disk."""
        size = int((received.stop - received.start).sum())
        with self._lock:
            self._recordings[link].received += size
            if self._size + size > MOST:
                self._recordings[link].dropped += size
            else:
                self._waiting.append((link, received))
                self._size += size

    def counters(self) -> list[RecordingCounters]:
        """Return the byte counters of each link."""
        with self._lock:
            return [recording.counters() for recording in self._recordings]

    def close(self) -> None:
        """Write the queue and close the files."""
        self._stop.set()
        self._thread.join()
        for recording in self._recordings:
            recording.writer.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self) -> None:
        stopped = False
        while not stopped:
            stopped = self._stop.wait(WRITE_S)
            self.write()

    def write(self) -> None:
        """Write the queue."""
        with self._lock:
            waiting, self._waiting, self._size = self._waiting, [], 0
        for number, recording in enumerate(self._recordings):
            if pieces := [received for link, received in waiting if link == number]:
                recording.write(pieces)
            if (fault := recording.writer.fault) and fault not in self._logged:
                self._logged.add(fault)
                _log.warning("%s", fault)


class RecordedQueue(queue.Queue[Batch]):
    """Queue between receiving and decoding; it records every batch, also those that do not fit.

    Args:
        max_batches: capacity
        max_bytes: received bytes of one link in the queue
    """

    def __init__(self, max_batches: int, recorder: LinkRecorder | None, max_bytes: int = QUEUE_BYTES) -> None:
        super().__init__(max_batches)
        self._recorder, self._max_bytes = recorder, max_bytes
        self._sizes: Counter[int] = Counter()  # queued bytes, by link

    def put(self, item: Batch, block: bool = True, timeout: float | None = None) -> None:
        """Record a batch, then queue it.

        Raises:
            queue.Full: when there is no space.
        """
        if self._recorder is not None and item.received is not None:
            self._recorder.add(item.link, item.received)
        waiting = self._sizes[item.link]
        if item.size and waiting and waiting + item.size > self._max_bytes:  # a single batch always fits
            raise queue.Full
        super().put(item, block, timeout)

    def _put(self, item: Batch) -> None:
        self._sizes[item.link] += item.size
        super()._put(item)

    def _get(self) -> Batch:
        item = super()._get()
        self._sizes[item.link] -= item.size
        return item
