"""Base of all links: an endpoint of bytes with its own thread."""

import queue
import threading
import time
from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

from fleet.bus.codec import EncodedMessage
from fleet.telemetry.mavlink.parsing.received import ReceivedBytes
from gateway.link_spec import LinkSpec

QUEUE = 20_000  # batches between receiving and decoding
QUEUE_BYTES = 8 << 20  # limit of one link in the queue: a flood on one link must not delay the others for long
POLL_S = 0.2  # period at which a receiving thread checks for the end [s]
FIRST_RETRY_S, LAST_RETRY_S = 0.25, 5.0  # wait before another attempt to open a link, doubled every time [s]
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


class Endpoint:
    """Endpoint of bytes; its thread queues batches, never waits, and counts what does not fit."""

    def __init__(self, spec: LinkSpec) -> None:
        self.spec = spec
        self.dropped = 0  # datagrams, or pieces of a stream, lost because decoding fell behind
        self.unsent = 0  # messages not sent: no peer, or send queue full
        self.known_peers: Sequence[Hashable] = ()  # before they send: some aircraft send only after they receive
        self._thread: threading.Thread | None = None

    def start(self, number: int, out: "queue.Queue[Batch]", stop: threading.Event) -> None:
        """Start to receive in a thread until `stop` is set; `number` identifies the link in its batches."""
        self._number, self._out, self._stop = number, out, stop
        self._thread = threading.Thread(target=self._run, name=self.spec.text)
        self._thread.start()

    def _run(self) -> None:
        raise NotImplementedError

    def send(self, where: Hashable, data: bytes, messages: int = 1) -> None:
        """Send complete messages to a peer; never wait. A recording ignores them."""

    def close(self) -> None:
        """Wait for the thread (the stop event is set) and free all resources."""
        if self._thread is not None:
            self._thread.join()

    def _put(self, received: ReceivedBytes) -> None:
        try:
            self._out.put_nowait(Batch(self._number, received))
        except queue.Full:
            self.dropped += len(received.start)

    def _put_piece(self, sender: Hashable, data: bytes) -> None:
        """Queue one piece of a stream, received now."""
        self._put(ReceivedBytes.from_pieces([(wall(), sender, data)]))
