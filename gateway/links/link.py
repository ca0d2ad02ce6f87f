"""Interface of all links: an endpoint of bytes with its own thread."""

import queue
import threading
import time
from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple, Protocol

from fleet.bus.codec import Wire
from fleet.telemetry.mavlink.parsing.received import Heard
from gateway.settings.link_spec import Spec

QUEUE = 20_000  # batches between receiving and decoding
QUEUE_BYTES = 8 << 20  # limit of one link in the queue: a flood on one link must not delay the others for long
POLL_S = 0.2  # period at which a receiving thread checks for the end [s]
_T0 = time.time() - time.monotonic()


def wall() -> float:
    """Return fleet time now [s since 1970]; steps of the system clock after the start do not affect it."""
    return _T0 + time.monotonic()


class Batch(NamedTuple):
    """Batch of one link: received bytes, or messages of a recording and of its copies."""

    link: int
    heard: Heard | None = None
    news: Sequence[Any] = ()
    copies: Sequence[Wire] = ()
    gone: Hashable = None  # a peer that disconnected: its resources are free
    ended: bool = False

    @property
    def size(self) -> int:
        """Return the number of bytes received."""
        return len(self.heard.buf) if self.heard is not None else 0


class Link(Protocol):
    """Endpoint of bytes with its own thread."""

    spec: Spec
    dropped: int  # datagrams, or pieces of a stream, lost because decoding fell behind
    unsent: int  # messages not sent: no peer, or send queue full

    @property
    def greets(self) -> Sequence[Hashable]:
        """Return peers known before they send: some aircraft send only after they receive a message."""

    def start(self, number: int, out: "queue.Queue[Batch]", stop: threading.Event) -> None:
        """Start to receive; `number` identifies the link in its batches."""

    def send(self, where: Hashable, data: bytes, messages: int = 1) -> None:
        """Send complete messages to a peer; never wait."""

    def close(self) -> None:
        """Wait for the thread (the stop event is set) and free all resources."""


class Outlet:
    """Writer of a link's batches to the queue; it never waits, and counts what does not fit."""

    def __init__(self, number: int, out: "queue.Queue[Batch]", link: Link) -> None:
        self._number, self._out, self._link = number, out, link

    def put(self, heard: Heard) -> None:
        """Queue received bytes."""
        try:
            self._out.put_nowait(Batch(self._number, heard))
        except queue.Full:
            self._link.dropped += len(heard.start)

    def piece(self, sender: Hashable, data: bytes) -> None:
        """Queue one piece of a stream, received now."""
        self.put(Heard.of([(wall(), sender, data)]))

    def gone(self, sender: Hashable, stop: threading.Event) -> None:
        """Queue the notice that a peer disconnected; this may wait."""
        while not stop.is_set():
            try:
                return self._out.put(Batch(self._number, gone=sender), timeout=POLL_S)
            except queue.Full:
                continue
