"""Contract messages for an export: from a running fleet, or from a `.parauav` recording."""

import queue
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from fleet.bus.bus_protocol import EpochFence
from fleet.bus.codec import Stamp
from fleet.bus.session import Bus
from fleet.contract import Alert, Message, Mission, Prediction, Sample, Status
from fleet.telemetry.recording.fleet_news import BusMessageReader

EXPORTED = (Mission, Status, Alert, Sample, Prediction)  # classes that an export shows
_POLL_S = 0.2  # between two checks for the end of the collection [s]
_QUEUE_SIZE = 100_000  # messages waiting for the file; beyond, messages are dropped and counted


class LiveSource:
    """Messages of a running fleet, from their reception on.

    Args:
        bus: connected bus
    """

    def __init__(self, bus: Bus) -> None:
        self.dropped = 0
        self._fence, self._bus = EpochFence(), bus
        self._queue: queue.Queue[Message] = queue.Queue(_QUEUE_SIZE)

    def messages(self, stop: threading.Event, seconds: float) -> Iterator[Message]:
        """Yield the newest rarely published messages, then every message until `stop` or for `seconds` (0: no end)."""
        for kind in EXPORTED:
            self._bus.subscribe(kind, self._on_message)
        end = time.monotonic() + seconds if seconds else float("inf")
        for kind in EXPORTED:
            if kind is not Sample:
                for message, stamp in self._bus.get(kind):
                    self._on_message(message, stamp)
        while not stop.is_set() and (remaining := end - time.monotonic()) > 0:
            try:
                yield self._queue.get(timeout=min(remaining, _POLL_S))
            except queue.Empty:
                continue
        while not self._queue.empty():
            yield self._queue.get_nowait()

    def _on_message(self, message: Any, stamp: Stamp | None) -> None:
        if stamp is not None and not self._fence.accepts(message.uav, stamp):
            return
        try:
            self._queue.put_nowait(message)
        except queue.Full:
            self.dropped += 1


def recorded_messages(reader: BusMessageReader) -> Iterator[Message]:
    """Yield the messages of a recording in order of reception."""
    for _, messages in reader.steps(results=True):
        yield from (message for message in messages if isinstance(message, EXPORTED))


def only(messages: Iterator[Message], accepts: Callable[[int], bool]) -> Iterator[Message]:
    """Filter messages by UAV id."""
    return (message for message in messages if accepts(message.uav))
