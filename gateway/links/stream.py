"""One open stream of bytes, over TCP or a serial line, in the same few words."""

import os
import socket
import termios
from typing import Any

import serial

from gateway.links.send_queue import Outbox

CHUNK = 65_536  # bytes read at once
CONNECT_S = 3.0  # patience of one try [s]


class Tcp:
    """A connected socket."""

    def __init__(self, connected: socket.socket) -> None:
        connected.setblocking(False)
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # commands are short and should go now
        self._socket = connected
        self.outbox = Outbox(self._write)

    def fileno(self) -> int:
        """Return the number to wait at."""
        return self._socket.fileno()

    def read(self) -> bytes:
        """Return what came; it is nothing where waiting was for nothing.

        Raises:
            OSError: when the far end has closed or is gone.
        """
        try:
            data = self._socket.recv(CHUNK)
        except BlockingIOError:
            return b""
        if not data:
            raise ConnectionResetError("the far end closed")
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
        except (ValueError, termios.error) as error:  # a rate this device does not know
            raise OSError(str(error)) from None
        self.outbox = Outbox(self._write)

    def fileno(self) -> int:
        """Return the number to wait at."""
        return int(self._line.fileno())

    def read(self) -> bytes:
        """Return what came.

        Raises:
            OSError: when the device is gone.
        """
        return bytes(self._line.read(CHUNK))

    def _write(self, data: bytes) -> int:
        try:
            return os.write(self._line.fileno(), data)  # pyserial's own write spins where nothing is taken
        except BlockingIOError:
            return 0

    def close(self) -> None:
        """Close it."""
        self._line.close()


Stream = Tcp | Serial


def offer(stream: Stream | None, data: bytes, messages: int) -> int:
    """Offer whole messages to a stream, if it is there and has room; gives how many are not on their way."""
    try:
        taken = stream is not None and stream.outbox.put(data, messages)
    except OSError:  # gone just now: its thread sees it too, and counts what waited
        return 0
    return 0 if taken else messages


def open_stream(kind: str, where: str, port: Any) -> Stream:
    """Call a TCP server, or open a serial line at `port` baud.

    Raises:
        OSError: when nobody is there.
    """
    if kind == "serial":
        return Serial(where, port)
    return Tcp(socket.create_connection((where, port), CONNECT_S))
