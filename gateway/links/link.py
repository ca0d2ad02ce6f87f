"""What a link is: where bytes come from and go to, with a thread of its own."""

import queue
import threading
import time
from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple, Protocol

from fleet.bus.codec import Wire
from fleet.telemetry.mavlink.parsing.received import Heard
from gateway.settings.link_spec import Spec

QUEUE = 20_000  # batches between receiving and decoding
QUEUE_BYTES = 8 << 20  # of one link in them: a flood on one link must not delay the others for long
POLL_S = 0.2  # how soon a receiving thread notices the end [s]
_T0 = time.time() - time.monotonic()


def wall() -> float:
    """Return fleet time now [s since 1970]; steps of the system clock after the start do not show."""
    return _T0 + time.monotonic()


class Batch(NamedTuple):
    """What one link heard: bytes as they came, or the news of a recording and of its copies."""

    link: int
    heard: Heard | None = None
    news: Sequence[Any] = ()
    copies: Sequence[Wire] = ()
    gone: Hashable = None  # a sender that took its leave: whoever comes next may have its place
    ended: bool = False

    @property
    def size(self) -> int:
        """Tell how many bytes were heard."""
        return len(self.heard.buf) if self.heard is not None else 0


class Link(Protocol):
    """One source of bytes with a thread of its own."""

    spec: Spec
    dropped: int  # datagrams, or pieces of a stream, lost because decoding fell behind
    unsent: int  # messages not sent: nobody at the far end, or no room

    @property
    def greets(self) -> Sequence[Hashable]:
        """Return far ends known before they spoke: many an aircraft speaks only when spoken to."""

    def start(self, number: int, out: "queue.Queue[Batch]", stop: threading.Event) -> None:
        """Begin to receive; batches carry `number`."""

    def send(self, where: Hashable, data: bytes, messages: int = 1) -> None:
        """Send bytes, whole messages, to a sender; never wait."""

    def close(self) -> None:
        """Wait for the thread (the stop event is set) and free what is held."""


class Outlet:
    """Where a link puts what it hears: it never waits, and counts what finds no room."""

    def __init__(self, number: int, out: "queue.Queue[Batch]", link: Link) -> None:
        self._number, self._out, self._link = number, out, link

    def put(self, heard: Heard) -> None:
        """Put what was heard."""
        try:
            self._out.put_nowait(Batch(self._number, heard))
        except queue.Full:
            self._link.dropped += len(heard.start)

    def piece(self, sender: Hashable, data: bytes) -> None:
        """Put one piece of a stream that came just now."""
        self.put(Heard.of([(wall(), sender, data)]))

    def gone(self, sender: Hashable, stop: threading.Event) -> None:
        """Say that a sender took its leave; this may wait."""
        while not stop.is_set():
            try:
                return self._out.put(Batch(self._number, gone=sender), timeout=POLL_S)
            except queue.Full:
                continue
