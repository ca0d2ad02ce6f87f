"""A cable between a browser and the viewer under test: it counts what comes through, and can be pulled and put back."""

import contextlib
import socket
import threading


class Cable:
    """Forwards TCP connections from a port of its own to another, while it is plugged in."""

    def __init__(self, to: int) -> None:
        self._to, self.plugged, self.received = to, True, 0
        self._ends: list[socket.socket] = []
        self._door = socket.create_server(("127.0.0.1", 0))
        self.port = self._door.getsockname()[1]
        self._acceptor = threading.Thread(target=self._accept, daemon=True)
        self._acceptor.start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # closed
            while True:
                near, _ = self._door.accept()
                try:
                    far = socket.create_connection(("127.0.0.1", self._to), timeout=10) if self.plugged else None
                except OSError:
                    far = None
                if far is None:
                    near.close()
                    continue
                far.settimeout(None)
                self._ends += [near, far]
                threading.Thread(target=self._carry, args=(near, far), daemon=True).start()

    def _carry(self, near: socket.socket, far: socket.socket) -> None:
        with near, far:
            back = threading.Thread(target=self._pump, args=(near, far, False), daemon=True)
            back.start()
            self._pump(far, near, True)
            back.join()

    def _pump(self, source: socket.socket, sink: socket.socket, counted: bool) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65_536):
                self.received += len(data) if counted else 0
                sink.sendall(data)
        for end in (source, sink):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def pull(self) -> None:
        """Cut every connection, and let none through."""
        self.plugged = False
        for end in self._ends:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        self._ends.clear()

    def put_back(self) -> None:
        """Let connections through again."""
        self.plugged = True

    def close(self) -> None:
        """Pull it for good."""
        self.pull()
        self._door.shutdown(socket.SHUT_RDWR)
        self._door.close()
        self._acceptor.join()
