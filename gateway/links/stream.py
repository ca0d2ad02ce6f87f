"""Open byte stream over TCP or a serial line: reconnecting client and send queue."""

import logging
import os
import queue
import selectors
import socket
import termios
import threading
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import serial

from gateway.link_spec import LinkSpec
from gateway.links.link import POLL_S, BackOff, Batch, BatchWriter

MAX_BYTES = 65_536  # capacity in bytes; eleven seconds at 57,600 baud


class SendQueue:
    """Send queue of one stream.

    Args:
        write: writes bytes without waiting and returns how many were written
    """

    def __init__(self, write: Callable[[bytes], int]) -> None:
        self._write = write
        self._lock = threading.Lock()  # written to by the main thread and the link's thread
        self._waiting: deque[tuple[bytes, int]] = deque()
        self._size = 0
        self._closed = False

    def put(self, data: bytes, messages: int) -> bool:
        """Queue complete messages and write as much as possible; return False if they do not fit.

        Raises:
            OSError: when the peer is disconnected.
        """
        with self._lock:
            if self._closed or self._size + len(data) > MAX_BYTES:
                return False
            self._waiting.append((data, messages))
            self._size += len(data)
            self._flush()
            return True

    def flush(self) -> None:
        """Write as much as possible.

        Raises:
            OSError: when the peer is disconnected.
        """
        with self._lock:
            self._flush()

    def _flush(self) -> None:
        while self._waiting:
            data, messages = self._waiting[0]
            written = self._write(data)
            self._size -= written
            if written < len(data):
                self._waiting[0] = data[written:], messages
                return
            self._waiting.popleft()

    def has_data(self) -> bool:
        """Return whether the queue has data."""
        return bool(self._waiting)

    def close(self) -> int:
        """Close and clear the queue; return the number of messages lost, a partly written one included."""
        with self._lock:
            self._closed = True
            count = sum(messages for _, messages in self._waiting)
            self._waiting.clear()
            return count


CHUNK = 65_536  # bytes read at once
CONNECT_S = 3.0  # timeout of one attempt [s]


class Tcp:
    """A connected socket."""

    def __init__(self, connected: socket.socket) -> None:
        connected.setblocking(False)
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # commands are short and must not be delayed
        self._socket = connected
        self.send_queue = SendQueue(self._write)

    def fileno(self) -> int:
        """Return the file descriptor."""
        return self._socket.fileno()

    def read(self) -> bytes:
        """Return the pending bytes; empty without any.

        Raises:
            OSError: when the peer has closed the connection or is unreachable.
        """
        try:
            data = self._socket.recv(CHUNK)
        except BlockingIOError:
            return b""
        if not data:
            raise ConnectionResetError("the peer closed the connection")
        return data

    def _write(self, data: bytes) -> int:
        try:
            return self._socket.send(data)
        except BlockingIOError:
            return 0

    def close(self) -> None:
        """Close it."""
        self._socket.close()


class Serial:
    """A serial line; `serial.SerialException` is an OSError."""

    def __init__(self, path: str, baud: int) -> None:
        try:
            self._line = serial.Serial(path, baud, timeout=0, write_timeout=0, exclusive=True)
        except (ValueError, termios.error) as error:  # a baud rate that the device does not support
            raise OSError(str(error)) from None
        self.send_queue = SendQueue(self._write)

    def fileno(self) -> int:
        """Return the file descriptor."""
        return int(self._line.fileno())

    def read(self) -> bytes:
        """Return the pending bytes.

        Raises:
            OSError: when the device is disconnected.
        """
        return bytes(self._line.read(CHUNK))

    def _write(self, data: bytes) -> int:
        try:
            return os.write(self._line.fileno(), data)  # pyserial's write busy-waits while the device is blocked
        except BlockingIOError:
            return 0

    def close(self) -> None:
        """Close it."""
        self._line.close()


Stream = Tcp | Serial


def enqueue(stream: Stream | None, data: bytes, messages: int) -> int:
    """Queue complete messages on a stream, if it is open and has space; return the number not queued."""
    try:
        queued = stream is not None and stream.send_queue.put(data, messages)
    except OSError:  # just closed: the thread of the stream counts the queued messages
        return 0
    return 0 if queued else messages


def open_stream(kind: str, where: str, port: Any) -> Stream:
    """Connect to a TCP server, or open a serial line at `port` baud.

    Raises:
        OSError: when the connection fails.
    """
    if kind == "serial":
        return Serial(where, port)
    return Tcp(socket.create_connection((where, port), CONNECT_S))


_log = logging.getLogger(__name__)


class StreamClient:
    """TCP client or serial line; messages sent while it is down are counted, not stored."""

    def __init__(self, spec: LinkSpec) -> None:
        self.spec = spec
        self.dropped = self.unsent = 0
        self.known_peers: Sequence[Hashable] = (spec.text,)  # the peer; the same after every reconnection
        self._stream: Stream | None = None
        self._thread: threading.Thread | None = None

    def start(self, number: int, out: "queue.Queue[Batch]", stop: threading.Event) -> None:
        """Connect and receive in a thread."""
        outlet = BatchWriter(number, out, self)
        self._thread = threading.Thread(target=self._run, args=(outlet, stop), name=self.spec.text)
        self._thread.start()

    def _run(self, outlet: BatchWriter, stop: threading.Event) -> None:
        back_off, logged = BackOff(), ""
        while not stop.is_set():
            try:
                stream = self._stream = open_stream(self.spec.kind, self.spec.address, self.spec.port)
                try:
                    _log.info("link %s: open", self.spec.text)
                    logged = ""
                    self._receive(stream, outlet, back_off, stop)
                finally:
                    self._stream = None
                    stream.close()
                    self.unsent += stream.send_queue.close()
            except OSError as error:
                reason = error.strerror or str(error)
                if reason != logged:
                    _log.warning("link %s: %s; trying again", self.spec.text, reason)
                    logged = reason
                back_off.wait(stop)

    def _receive(self, stream: Stream, outlet: BatchWriter, back_off: BackOff, stop: threading.Event) -> None:
        """Receive until `stop` is set or the peer disconnects, which raises an OSError."""
        read, both = selectors.EVENT_READ, selectors.EVENT_READ | selectors.EVENT_WRITE
        with selectors.DefaultSelector() as ready:
            ready.register(stream, read)
            while not stop.is_set():
                ready.modify(stream, both if stream.send_queue.has_data() else read)
                for _, events in ready.select(POLL_S):
                    if events & selectors.EVENT_WRITE:
                        stream.send_queue.flush()
                    if events & selectors.EVENT_READ and (data := stream.read()):
                        back_off.reset()
                        outlet.piece(self.spec.text, data)

    def send(self, where: Hashable, data: bytes, messages: int = 1) -> None:
        """Send to the peer, if it is connected and the send queue has space."""
        self.unsent += enqueue(self._stream, data, messages)

    def close(self) -> None:
        """Wait for the thread, which closes the stream."""
        if self._thread is not None:
            self._thread.join()
