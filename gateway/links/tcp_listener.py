"""TCP server for aircraft or ground stations: `tcpin`."""

import logging
import queue
import selectors
import socket
import threading
import time
from collections.abc import Hashable, Sequence

from gateway.link_spec import LinkSpec
from gateway.links.link import POLL_S, Batch, BatchWriter
from gateway.links.stream import Tcp, enqueue

MOST = 64  # clients at a time
SPEAKING_S = 3.0  # a client that sent data within this time is not disconnected [s]
LOG_EVERY_S = 10.0  # between two log lines on clients that were disconnected or refused [s]

_log = logging.getLogger(__name__)


class TcpListener:
    """Listening port and its clients.

    Silent clients are allowed: a station may only listen. When all places are taken, a new client replaces the client
    silent for longest; if all have sent data within `SPEAKING_S`, the new client is refused.

    Raises:
        OSError: when the port is in use.
    """

    def __init__(self, spec: LinkSpec) -> None:
        self.spec = spec
        self.dropped = self.unsent = 0
        self._clients: dict[Hashable, Tcp] = {}
        self._last_data_t: dict[Hashable, float] = {}  # time of the last data or of the connection [s, monotonic]
        self._silent: set[Hashable] = set()  # clients that have sent nothing yet
        self._logged_t, self._unlogged = float("-inf"), 0
        self._thread: threading.Thread | None = None
        family = socket.AF_INET6 if ":" in spec.address else socket.AF_INET
        try:
            self._socket = socket.create_server((spec.address, spec.port), family=family)
        except OSError as error:
            reason = error.strerror or str(error)
            raise OSError(f"link {spec.text}: {reason}; stop the process on this port or name another") from None
        self._socket.setblocking(False)

    @property
    def known_peers(self) -> Sequence[Hashable]:
        """Return all connected clients, silent ones included."""
        return tuple(self._clients)

    @property
    def port(self) -> int:
        """Return the listening port."""
        return int(self._socket.getsockname()[1])

    def start(self, number: int, out: "queue.Queue[Batch]", stop: threading.Event) -> None:
        """Accept and receive in a thread."""
        outlet = BatchWriter(number, out, self)
        self._thread = threading.Thread(target=self._run, args=(outlet, stop), name=self.spec.text)
        self._thread.start()

    def _run(self, outlet: BatchWriter, stop: threading.Event) -> None:
        read, both = selectors.EVENT_READ, selectors.EVENT_READ | selectors.EVENT_WRITE
        with selectors.DefaultSelector() as ready:
            ready.register(self._socket, read)
            while not stop.is_set():
                for client, tcp in self._clients.items():
                    ready.modify(tcp, both if tcp.send_queue.has_data() else read, client)
                for key, events in ready.select(POLL_S):
                    if key.fileobj is self._socket:
                        if (oldest := self._accept(ready)) is not None:
                            self._disconnect(oldest, ready, outlet, stop)
                    elif key.data in self._clients and not self._serve(key.data, events, outlet):
                        self._disconnect(key.data, ready, outlet, stop)
            for client in list(self._clients):
                self._remove(client)

    def _accept(self, ready: selectors.BaseSelector) -> Hashable:
        """Accept the next client; return the client to disconnect for it, None if there is space or no client."""
        try:
            connected, client = self._socket.accept()
        except OSError:  # disconnected before it was accepted
            return None
        now, oldest = time.monotonic(), None
        if len(self._clients) >= MOST:
            oldest = self._longest_silent(now)
            self._warn(now, "refused another" if oldest is None else "disconnected the one silent for longest")
            if oldest is None:
                connected.close()
                return None
        tcp = self._clients[client] = Tcp(connected)
        self._last_data_t[client] = now
        self._silent.add(client)
        ready.register(tcp, selectors.EVENT_READ, client)
        return oldest

    def _longest_silent(self, now: float) -> Hashable:
        """Return the client silent for longest; None if all have sent data recently."""
        silent = [client for client, t in self._last_data_t.items() if client in self._silent or now - t > SPEAKING_S]
        return min(silent, key=self._last_data_t.__getitem__, default=None)

    def _warn(self, now: float, action: str) -> None:
        """Log that all places are taken, at most every `LOG_EVERY_S`."""
        self._unlogged += 1
        if now - self._logged_t >= LOG_EVERY_S:
            suffix = f" ({self._unlogged} since the last such line)" if self._unlogged > 1 else ""
            _log.warning("link %s: found %d clients, expected fewer; %s%s", self.spec.text, MOST, action, suffix)
            self._logged_t, self._unlogged = now, 0

    def _disconnect(
        self, client: Hashable, ready: selectors.BaseSelector, outlet: BatchWriter, stop: threading.Event
    ) -> None:
        ready.unregister(self._clients[client])
        self._remove(client)
        outlet.peer_left(client, stop)

    def _serve(self, client: Hashable, events: int, outlet: BatchWriter) -> bool:
        """Read from and write to one client; return False if it has disconnected."""
        tcp = self._clients[client]
        try:
            if events & selectors.EVENT_WRITE:
                tcp.send_queue.flush()
            if events & selectors.EVENT_READ and (data := tcp.read()):
                self._last_data_t[client] = time.monotonic()
                self._silent.discard(client)
                outlet.piece(client, data)
        except OSError:
            return False
        return True

    def _remove(self, client: Hashable) -> None:
        tcp = self._clients.pop(client)
        self._silent.discard(client)
        del self._last_data_t[client]
        tcp.close()
        self.unsent += tcp.send_queue.close()

    def send(self, where: Hashable, data: bytes, messages: int = 1) -> None:
        """Send to one client, if it is connected and its send queue has space."""
        self.unsent += enqueue(self._clients.get(where), data, messages)

    def close(self) -> None:
        """Wait for the thread and free the port."""
        if self._thread is not None:
            self._thread.join()
        self._socket.close()
