"""Where bytes come from: what a link is, and the UDP port that listens."""

import contextlib
import queue
import socket
import threading
import time
from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple, Protocol, cast

from fleet.codec import Wire
from fleet.telemetry.heard import Heard
from gateway.spec import Spec

QUEUE = 20_000  # batches between receiving and decoding
POLL_S = 0.2  # how soon a receiving thread notices the end [s]
DATAGRAM = 65_535  # longest there is [bytes]
_T0 = time.time() - time.monotonic()


def wall() -> float:
    """Give fleet time now [s since 1970]; steps of the system clock after the start do not show."""
    return _T0 + time.monotonic()


class Batch(NamedTuple):
    """What one link heard: bytes as they came, or the news of a recording and of its copies."""

    link: int
    heard: Heard | None = None
    news: Sequence[Any] = ()
    copies: Sequence[Wire] = ()
    ended: bool = False


class Link(Protocol):
    """One source of bytes with a thread of its own."""

    spec: Spec
    dropped: int  # datagrams lost because decoding fell behind

    def start(self, number: int, out: "queue.Queue[Batch]", stop: threading.Event) -> None:
        """Begin to receive; batches carry `number`."""

    def send(self, where: Hashable, data: bytes) -> None:
        """Send bytes back to a sender."""

    def close(self) -> None:
        """Wait for the thread (the stop event is set) and free what is held."""


class Udp:
    """A UDP port; every sender's address is learned from what it sends."""

    def __init__(self, spec: Spec) -> None:
        self.spec = spec
        self.dropped = 0
        self._socket = _bind(spec)
        self._thread: threading.Thread | None = None

    @property
    def port(self) -> int:
        """Give the port listened at."""
        return int(self._socket.getsockname()[1])

    def start(self, number: int, out: "queue.Queue[Batch]", stop: threading.Event) -> None:
        """Receive in a thread: stamp, queue, nothing else."""
        self._thread = threading.Thread(target=self._receive, args=(number, out, stop), name=self.spec.text)
        self._thread.start()

    def _receive(self, number: int, out: "queue.Queue[Batch]", stop: threading.Event) -> None:
        while not stop.is_set():
            try:
                data, sender = self._socket.recvfrom(DATAGRAM)
            except OSError:  # nothing for a while, or an earlier answer found nobody
                continue
            try:
                out.put_nowait(Batch(number, heard=Heard.of([(wall(), sender, data)])))
            except queue.Full:
                self.dropped += 1

    def send(self, where: Hashable, data: bytes) -> None:
        """Send one datagram; a full buffer or a vanished far end loses it, as radio would."""
        with contextlib.suppress(OSError):
            self._socket.sendto(data, cast("tuple[str, int]", where))

    def close(self) -> None:
        """Wait for the thread and free the port."""
        if self._thread is not None:
            self._thread.join()
        self._socket.close()


def _bind(spec: Spec) -> socket.socket:
    family = socket.AF_INET6 if ":" in spec.where else socket.AF_INET
    found = socket.socket(family, socket.SOCK_DGRAM)
    found.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
    found.settimeout(POLL_S)
    try:
        found.bind((spec.where.strip("[]"), spec.port))
    except OSError as error:
        found.close()
        reason = error.strerror or str(error)
        raise OSError(f"link {spec.text}: {reason}; stop what holds the port or name another") from None
    return found
