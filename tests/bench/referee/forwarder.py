"""A way between workers and router that delays, stalls, is cut and mended: TCP, byte by byte, in this process."""

import socket
import threading
import time
from collections import deque
from contextlib import AbstractContextManager, suppress

_CHUNK = 1 << 16
_POLL_S = 0.02


class Forwarder(AbstractContextManager):
    """Forwards every connection to one port on to another.

    Attributes:
        delay_s: every byte comes so much later
        stalled: nothing moves, and nobody is told
        cut: connections are closed, and none is taken
    """

    def __init__(self, to: tuple[str, int]) -> None:
        self.delay_s, self.stalled, self.cut = 0.0, False, False
        self._to, self._ended = to, threading.Event()
        self._open: list[socket.socket] = []
        self._door = socket.create_server(("127.0.0.1", 0))
        self._door.settimeout(_POLL_S)
        self.port: int = self._door.getsockname()[1]
        threading.Thread(target=self._take, daemon=True).start()

    def sever(self) -> None:
        """Close every connection, once."""
        gone, self._open = self._open, []
        for end in gone:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()

    def _take(self) -> None:
        while not self._ended.is_set():
            if self.cut:
                self.sever()
            try:
                here, _ = self._door.accept()
            except OSError:
                continue
            if self.cut:
                here.close()
                continue
            try:
                there = socket.create_connection(self._to, timeout=1.0)
            except OSError:
                here.close()
                continue
            self._open = [end for end in self._open if end.fileno() >= 0] + [here, there]
            with suppress(OSError):  # closed again at once, as by who only looks whether somebody is there
                for end in (here, there):
                    end.settimeout(_POLL_S)
                    end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                for one, other in ((here, there), (there, here)):
                    threading.Thread(target=self._pump, args=(one, other), daemon=True).start()

    def _pump(self, one: socket.socket, other: socket.socket) -> None:
        """Pass on what one end says."""
        waiting: deque[tuple[float, bytes]] = deque()
        try:
            while not self._ended.is_set():
                late = self.delay_s
                if not waiting or late:
                    with suppress(TimeoutError):
                        data = one.recv(_CHUNK)
                        if not data:
                            break
                        waiting.append((time.monotonic() + late, data))
                while waiting and not self.stalled and waiting[0][0] <= time.monotonic():
                    self._send(other, waiting.popleft()[1])
                if self.stalled:
                    self._ended.wait(_POLL_S)
        except OSError:
            pass
        for end in (one, other):
            end.close()

    def _send(self, to: socket.socket, data: bytes) -> None:
        left = memoryview(data)
        while left:
            with suppress(TimeoutError):
                left = left[to.send(left) :]
            if self._ended.is_set() or self.cut:
                raise OSError

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self.sever()
        self._door.close()
