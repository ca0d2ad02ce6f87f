"""Open byte stream over TCP or a serial line: send queue and reconnecting client."""

import contextlib
import glob
import logging
import os
import selectors
import socket
import termios
import threading
import time
from collections import deque
from collections.abc import Hashable

import serial

from gateway.link_spec import LinkSpec
from gateway.links.link import FIRST_RETRY_S, LAST_RETRY_S, POLL_S, Endpoint

MAX_BYTES = 65_536  # capacity of a send queue; eleven seconds at 57,600 baud [bytes]
CHUNK = 65_536  # bytes read at once
CONNECT_S = 3.0  # timeout of one attempt [s]
LOG_PERIOD_S = 60.0  # between two warnings with the same reason [s]
MAX_LISTED = 8  # serial devices named in a warning

_log = logging.getLogger(__name__)


class Stream:
    """Connected socket or open serial line, and its queue of complete messages to send.

    Args:
        device: non-blocking
    """

    def __init__(self, device: socket.socket | serial.Serial) -> None:
        self.last_data_t = time.monotonic()  # time of the last data or of the connection [s, monotonic]
        self.is_silent = True  # no data yet
        self._device = device
        self._lock = threading.Lock()  # the main thread and the link's thread send
        self._waiting: deque[tuple[bytes, int]] = deque()
        self._size = 0
        self._closed = False

    def fileno(self) -> int:
        """Return the file descriptor."""
        return int(self._device.fileno())

    @property
    def events(self) -> int:
        """Return the events of `selectors` to wait for."""
        return selectors.EVENT_READ | selectors.EVENT_WRITE if self._waiting else selectors.EVENT_READ

    def serve(self, events: int) -> bytes:
        """Write queued bytes and read pending ones, as `events` permit; return the latter.

        Raises:
            OSError: when the peer is disconnected or unreachable.
        """
        if events & selectors.EVENT_WRITE:
            with self._lock:
                self._flush()
        if not events & selectors.EVENT_READ:
            return b""
        try:
            data = os.read(self.fileno(), CHUNK)
        except BlockingIOError:
            return b""
        if not data:
            raise ConnectionResetError("the peer closed the connection")
        self.last_data_t, self.is_silent = time.monotonic(), False
        return data

    def put(self, data: bytes, messages: int) -> bool:
        """Queue complete messages and write as much as possible; return False if they do not fit."""
        with self._lock:
            if self._closed or self._size + len(data) > MAX_BYTES:
                return False
            self._waiting.append((data, messages))
            self._size += len(data)
            with contextlib.suppress(OSError):  # disconnected: `close` counts the queued messages
                self._flush()
            return True

    def _flush(self) -> None:
        while self._waiting:
            data, messages = self._waiting[0]
            try:
                written = os.write(self.fileno(), data)  # pyserial's write busy-waits while the device is blocked
            except BlockingIOError:
                return
            self._size -= written
            if written < len(data):
                self._waiting[0] = data[written:], messages
                return
            self._waiting.popleft()

    def close(self) -> int:
        """Close the device; return the number of queued messages lost, a partly written one included."""
        with self._lock:
            self._closed = True
            self._device.close()
            count = sum(messages for _, messages in self._waiting)
            self._waiting.clear()
            return count


def tcp_stream(connected: socket.socket) -> Stream:
    """Return the stream of a connected socket."""
    connected.setblocking(False)
    connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # commands are short and must not be delayed
    return Stream(connected)


class StreamClient(Endpoint):
    """TCP client or serial line; messages sent while it is down are counted, not stored."""

    def __init__(self, spec: LinkSpec) -> None:
        super().__init__(spec)
        self.known_peers = (spec.text,)  # the peer; the same after every reconnection
        self._stream: Stream | None = None

    def _run(self) -> None:
        self._wait_s, logged, logged_at = FIRST_RETRY_S, "", 0.0
        while not self._stop.is_set():
            try:
                stream = self._stream = self._open()
                try:
                    _log.info("link %s: open", self.spec.text)
                    logged = ""
                    self._receive(stream)
                finally:
                    self._stream = None
                    self.unsent += stream.close()
            except OSError as error:
                reason = self._missing_device() or error.strerror or str(error)
                if reason != logged or time.monotonic() >= logged_at + LOG_PERIOD_S:
                    _log.warning("link %s: %s; trying again", self.spec.text, reason)
                    logged, logged_at = reason, time.monotonic()
                self._stop.wait(self._wait_s)
                self._wait_s = min(2 * self._wait_s, LAST_RETRY_S)

    def _missing_device(self) -> str:
        """Describe a serial device that does not exist, with those that do; empty if it exists."""
        if self.spec.kind != "serial" or os.path.exists(self.spec.address):
            return ""
        present = ", ".join(sorted(glob.glob("/dev/ttyUSB*") + glob.glob("/dev/ttyACM*"))[:MAX_LISTED]) or "none"
        problem = f"found no device {self.spec.address!r} (present: {present}), expected a telemetry radio"
        return f"{problem}; plug it in, or correct the link"

    def _open(self) -> Stream:
        if self.spec.kind == "tcp":
            return tcp_stream(socket.create_connection((self.spec.address, self.spec.port), CONNECT_S))
        try:
            return Stream(serial.Serial(self.spec.address, self.spec.port, timeout=0, exclusive=True))
        except (ValueError, termios.error) as error:  # a baud rate that the device does not support
            raise OSError(str(error)) from None

    def _receive(self, stream: Stream) -> None:
        """Receive until the stop event is set or the peer disconnects, which raises an OSError."""
        with selectors.DefaultSelector() as ready:
            ready.register(stream, selectors.EVENT_READ)
            while not self._stop.is_set():
                ready.modify(stream, stream.events)
                for _, events in ready.select(POLL_S):
                    if data := stream.serve(events):
                        self._wait_s = FIRST_RETRY_S
                        self._put_piece(self.spec.text, data)

    def send(self, where: Hashable, data: bytes, messages: int = 1) -> None:
        """Send to the peer, if it is connected and the send queue has space."""
        stream = self._stream
        if stream is None or not stream.put(data, messages):
            self.unsent += messages
