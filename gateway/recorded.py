"""A recording as a link: played in its own time, faster, or as fast as it can be read."""

import contextlib
import queue
import threading
import time
from collections import deque
from collections.abc import Hashable
from pathlib import Path

from fleet.telemetry.recordings import ticks, timed
from gateway.link import POLL_S, Batch
from gateway.spec import Spec


class Replay:
    """A recording, played at a multiple of its own time."""

    def __init__(self, spec: Spec) -> None:
        self.spec = spec
        self.dropped = 0
        self.played_s = 0.0  # recorded time played so far [s]
        self._steps = ticks(Path(spec.where))
        self._first = next(self._steps)
        self._thread: threading.Thread | None = None

    def start(self, number: int, out: "queue.Queue[Batch]", stop: threading.Event) -> None:
        """Play in a thread."""
        self._thread = threading.Thread(target=self._play, args=(number, out, stop), name=self.spec.text)
        self._thread.start()

    def _play(self, number: int, out: "queue.Queue[Batch]", stop: threading.Event) -> None:
        try:
            self._play_steps(number, out, stop)
        finally:  # a disk that fails half-way ends the recording too
            _put(out, Batch(number, [], ended=True), stop)

    def _play_steps(self, number: int, out: "queue.Queue[Batch]", stop: threading.Event) -> None:
        began, (now, heard) = time.monotonic(), self._first
        first = now
        while not stop.wait(max(0.0, began + (now - first) / self.spec.speed - time.monotonic())):
            self.played_s = now - first
            _put(out, Batch(number, [(t, None, frame) for t, frame in heard], now), stop)
            step = next(self._steps, None)
            if step is None:
                break
            now, heard = step

    def length_s(self) -> float:
        """Read how long the recording is [s]; takes a moment."""
        end = deque(timed(self.spec.where), maxlen=1)
        return end[0][0] - self._first[0]

    def send(self, where: Hashable, data: bytes) -> None:
        """Do nothing: a recording does not answer."""

    def close(self) -> None:
        """Wait for the thread."""
        if self._thread is not None:
            self._thread.join()


def _put(out: "queue.Queue[Batch]", batch: Batch, stop: threading.Event) -> None:
    while not stop.is_set():
        with contextlib.suppress(queue.Full):
            return out.put(batch, timeout=POLL_S)
