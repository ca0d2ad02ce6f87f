"""Interface of all links: an endpoint of bytes with its own thread."""

import queue
import threading
import time
from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple, Protocol

from fleet.bus.codec import EncodedMessage
from fleet.telemetry.mavlink.parsing.received import ReceivedBytes
from gateway.link_spec import LinkSpec

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
    received: ReceivedBytes | None = None
    messages: Sequence[Any] = ()
    copies: Sequence[EncodedMessage] = ()
    left_peer: Hashable = None  # a peer that disconnected: its resources are free
    ended: bool = False

    @property
    def size(self) -> int:
        """Return the number of bytes received."""
        return len(self.received.buf) if self.received is not None else 0


class Endpoint(Protocol):
    """Endpoint of bytes with its own thread."""

    spec: LinkSpec
    dropped: int  # datagrams, or pieces of a stream, lost because decoding fell behind
    unsent: int  # messages not sent: no peer, or send queue full

    @property
    def known_peers(self) -> Sequence[Hashable]:
        """Return peers known before they send: some aircraft send only after they receive a message."""

    def start(self, number: int, out: "queue.Queue[Batch]", stop: threading.Event) -> None:
        """Start to receive; `number` identifies the link in its batches."""

    def send(self, where: Hashable, data: bytes, messages: int = 1) -> None:
        """Send complete messages to a peer; never wait."""

    def close(self) -> None:
        """Wait for the thread (the stop event is set) and free all resources."""


class BatchWriter:
    """Writer of a link's batches to the queue; it never waits, and counts what does not fit."""

    def __init__(self, number: int, out: "queue.Queue[Batch]", link: Endpoint) -> None:
        self._number, self._out, self._link = number, out, link

    def put(self, received: ReceivedBytes) -> None:
        """Queue received bytes."""
        try:
            self._out.put_nowait(Batch(self._number, received))
        except queue.Full:
            self._link.dropped += len(received.start)

    def piece(self, sender: Hashable, data: bytes) -> None:
        """Queue one piece of a stream, received now."""
        self.put(ReceivedBytes.from_pieces([(wall(), sender, data)]))

    def peer_left(self, sender: Hashable, stop: threading.Event) -> None:
        """Queue the notice that a peer disconnected; this may wait."""
        while not stop.is_set():
            try:
                return self._out.put(Batch(self._number, left_peer=sender), timeout=POLL_S)
            except queue.Full:
                continue


FIRST_S, MAX_S = 0.25, 5.0


class BackOff:
    """Back-off between attempts to open a link."""

    def __init__(self) -> None:
        self._wait_s = FIRST_S

    def wait(self, stop: threading.Event) -> None:
        """Wait before the next attempt, or until `stop` is set."""
        stop.wait(self._wait_s)
        self._wait_s = min(2 * self._wait_s, MAX_S)

    def reset(self) -> None:
        """Reset the delay after data from the peer."""
        self._wait_s = FIRST_S
