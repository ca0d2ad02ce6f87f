"""A recording as a link: played in its own time, faster, or as fast as it can be read."""

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Hashable

from fleet.telemetry.recordings import Recording
from gateway.link import POLL_S, Batch
from gateway.spec import Spec

_log = logging.getLogger(__name__)


class Replay:
    """A recording, played at a multiple of its own time.

    Raises:
        ValueError: when there is nothing in it.
        OSError: when it cannot be read.
    """

    def __init__(self, spec: Spec) -> None:
        self.spec = spec
        self.dropped = 0
        self.recording = Recording(spec.where, spec.offset)
        self._steps = self.recording.steps()
        self._first = next(self._steps)
        self._thread: threading.Thread | None = None

    def start(self, number: int, out: "queue.Queue[Batch]", stop: threading.Event) -> None:
        """Play in a thread."""
        self._thread = threading.Thread(target=self._play, args=(number, out, stop), name=self.spec.text)
        self._thread.start()

    def _play(self, number: int, out: "queue.Queue[Batch]", stop: threading.Event) -> None:
        try:
            self._play_steps(number, out, stop)
        except (ValueError, OSError) as error:  # a disk that fails half-way, a file without any aircraft
            _log.warning("%s", error)
        finally:
            for sentence in self.recording.skipped:
                _log.warning("%s", sentence)
            _put(out, Batch(number, ended=True), stop)

    def _play_steps(self, number: int, out: "queue.Queue[Batch]", stop: threading.Event) -> None:
        began, (now, news) = time.monotonic(), self._first
        first = now
        while not stop.wait(max(0.0, began + (now - first) / self.spec.speed - time.monotonic())):
            if news:
                _put(out, Batch(number, news=news), stop)
            step = next(self._steps, None)
            if step is None:
                break
            now, news = step

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
