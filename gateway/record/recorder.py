"""Recording thread: queues received bytes without blocking and writes them to disk."""

import logging
import queue
import threading
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import NamedTuple

from fleet.telemetry.mavlink.parsing.received import Heard
from fleet.telemetry.mavlink.parsing.scan import STAMP
from gateway.links.link import QUEUE_BYTES, Batch
from gateway.record.cut import FRAMES, Cutter
from gateway.record.tape import Budget, Tape

MOST = 64 << 20  # bytes waiting for the disk; beyond, they are dropped and counted
WRITE_S = 0.25  # between two writes: the longest loss at a crash [s]

_log = logging.getLogger(__name__)


class Taped(NamedTuple):
    """Byte counters of one link: `received` is the sum of the five after it, without the time stamps of the file."""

    heard: int = 0  # bytes
    recorded: int = 0  # in frames, on disk
    noise: int = 0  # outside frames, not recorded
    lost: int = 0  # write errors
    dropped: int = 0  # queue overflow
    waiting: int = 0  # in the queue, or in incomplete frames
    frames: int = 0  # recorded or lost
    trouble: str = ""


class _Reel:
    """Recording of one link: writer and counters [bytes]."""

    def __init__(self, tape: Tape) -> None:
        self.tape, self.cutter = tape, Cutter()
        self.heard = self.recorded = self.lost = self.dropped = 0

    def write(self, pieces: Sequence[Heard]) -> None:
        before = int(self.cutter.counts[FRAMES])
        records = b"".join(map(self.cutter.feed, pieces))
        size = len(records) - STAMP * (int(self.cutter.counts[FRAMES]) - before)
        if self.tape.write(records, time.monotonic()):
            self.lost += size
        else:
            self.recorded += size

    def account(self) -> Taped:
        frames, noise = self.cutter.counts.tolist()
        known = (self.recorded, noise, self.lost, self.dropped)
        return Taped(self.heard, *known, self.heard - sum(known), frames, self.tape.trouble)


class Recorder(AbstractContextManager):
    """Record links as `.tlog`.

    Args:
        budget: of the folder
        names: of the links
    """

    def __init__(self, budget: Budget, names: Sequence[str]) -> None:
        self.budget = budget
        self._reels = [_Reel(Tape(name, budget, len(names))) for name in names]
        self._lock = threading.Lock()
        self._waiting: list[tuple[int, Heard]] = []
        self._size = 0  # bytes waiting
        self._said: set[str] = set()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder")
        self._thread.start()

    def hear(self, link: int, heard: Heard) -> None:
        """Queue pieces of one link; thread-safe, never waits for the disk."""
        size = int((heard.stop - heard.start).sum())
        with self._lock:
            self._reels[link].heard += size
            if self._size + size > MOST:
                self._reels[link].dropped += size
            else:
                self._waiting.append((link, heard))
                self._size += size

    def account(self) -> list[Taped]:
        """Return the byte counters of each link."""
        with self._lock:
            return [reel.account() for reel in self._reels]

    def close(self) -> None:
        """Write the queue and close the files."""
        self._over.set()
        self._thread.join()
        for reel in self._reels:
            reel.tape.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self) -> None:
        over = False
        while not over:
            over = self._over.wait(WRITE_S)
            self.write()

    def write(self) -> None:
        """Write the queue."""
        with self._lock:
            waiting, self._waiting, self._size = self._waiting, [], 0
        for number, reel in enumerate(self._reels):
            if pieces := [heard for link, heard in waiting if link == number]:
                reel.write(pieces)
            if (trouble := reel.tape.trouble) and trouble not in self._said:
                self._said.add(trouble)
                _log.warning("%s", trouble)


class Tapped(queue.Queue[Batch]):
    """Queue between receiving and decoding; it records every batch, also those that do not fit.

    Args:
        max_batches: capacity
        max_bytes: received bytes of one link in the queue
    """

    def __init__(self, most: int, recorder: Recorder | None, most_bytes: int = QUEUE_BYTES) -> None:
        super().__init__(most)
        self._recorder, self._most_bytes = recorder, most_bytes
        self._sizes: Counter[int] = Counter()  # queued bytes, by link

    def put(self, item: Batch, block: bool = True, timeout: float | None = None) -> None:
        """Record a batch, then queue it.

        Raises:
            queue.Full: when there is no space.
        """
        if self._recorder is not None and item.heard is not None:
            self._recorder.hear(item.link, item.heard)
        waiting = self._sizes[item.link]
        if item.size and waiting and waiting + item.size > self._most_bytes:  # a single batch always fits
            raise queue.Full
        super().put(item, block, timeout)

    def _put(self, item: Batch) -> None:
        self._sizes[item.link] += item.size
        super()._put(item)

    def _get(self) -> Batch:
        item = super()._get()
        self._sizes[item.link] -= item.size
        return item
