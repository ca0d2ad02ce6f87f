"""TCP server for aircraft or ground stations: `tcpin`."""

import logging
import queue
import selectors
import socket
import time
from collections.abc import Hashable

from gateway.link_spec import LinkSpec
from gateway.links.link import POLL_S, Batch, Endpoint
from gateway.links.stream import Stream, tcp_stream

MOST = 64  # clients at a time
SPEAKING_S = 3.0  # a client that sent data within this time is not disconnected [s]
LOG_EVERY_S = 10.0  # between two log lines on clients that were disconnected or refused [s]

_log = logging.getLogger(__name__)


class TcpListener(Endpoint):
    """Listening port and its clients.

    Silent clients are allowed: a station may only listen. When all places are taken, a new client replaces the client
    silent for longest; if all have sent data within `SPEAKING_S`, the new client is refused.

    Raises:
        OSError: when the port is in use.
    """

    def __init__(self, spec: LinkSpec) -> None:
        super().__init__(spec)
        self._clients: dict[Hashable, Stream] = {}
        self._logged_t, self._unlogged = float("-inf"), 0
        self._ready = selectors.DefaultSelector()
        family = socket.AF_INET6 if ":" in spec.address else socket.AF_INET
        try:
            self._socket = socket.create_server((spec.address, spec.port), family=family)
        except OSError as error:
            reason = error.strerror or str(error)
            raise OSError(f"link {spec.text}: {reason}; stop the process on this port or name another") from None
        self._socket.setblocking(False)

    @property
    def port(self) -> int:
        """Return the listening port."""
        return int(self._socket.getsockname()[1])

    def _run(self) -> None:
        self._ready.register(self._socket, selectors.EVENT_READ)
        while not self._stop.is_set():
            for client, stream in self._clients.items():
                self._ready.modify(stream, stream.events, client)
            for key, events in self._ready.select(POLL_S):
                if key.fileobj is self._socket:
                    self._accept()
                elif key.data in self._clients:
                    self._serve(key.data, events)
        for client in list(self._clients):
            self._disconnect(client)

    def _accept(self) -> None:
        """Accept the next client, if all places are taken in place of the one silent for longest."""
        try:
            connected, client = self._socket.accept()
        except OSError:  # disconnected before it was accepted
            return
        if len(self._clients) >= MOST:
            oldest = self._longest_silent()
            self._warn("refused another" if oldest is None else "disconnected the one silent for longest")
            if oldest is None:
                connected.close()
                return
            self._disconnect(oldest)
        stream = self._clients[client] = tcp_stream(connected)
        self._ready.register(stream, stream.events, client)
        self.known_peers = tuple(self._clients)

    def _longest_silent(self) -> Hashable:
        """Return the client silent for longest; None if all have sent data recently."""
        limit = time.monotonic() - SPEAKING_S
        silent = [client for client, one in self._clients.items() if one.is_silent or one.last_data_t < limit]
        return min(silent, key=lambda client: self._clients[client].last_data_t, default=None)

    def _warn(self, action: str) -> None:
        """Log that all places are taken, at most every `LOG_EVERY_S`."""
        now = time.monotonic()
        self._unlogged += 1
        if now - self._logged_t >= LOG_EVERY_S:
            suffix = f" ({self._unlogged} since the last such line)" if self._unlogged > 1 else ""
            _log.warning("link %s: found %d clients, expected fewer; %s%s", self.spec.text, MOST, action, suffix)
            self._logged_t, self._unlogged = now, 0

    def _serve(self, client: Hashable, events: int) -> None:
        try:
            data = self._clients[client].serve(events)
        except OSError:
            self._disconnect(client)
            return
        if data:
            self._put_piece(client, data)

    def _disconnect(self, client: Hashable) -> None:
        """Disconnect a client, and queue the notice of it; this may wait."""
        stream = self._clients.pop(client)
        self.known_peers = tuple(self._clients)
        self._ready.unregister(stream)
        self.unsent += stream.close()
        while not self._stop.is_set():
            try:
                return self._out.put(Batch(self._number, left_peer=client), timeout=POLL_S)
            except queue.Full:
                continue

    def send(self, where: Hashable, data: bytes, messages: int = 1) -> None:
        """Send to one client, if it is connected and its send queue has space."""
        stream = self._clients.get(where)
        if stream is None or not stream.put(data, messages):
            self.unsent += messages

    def close(self) -> None:
        """Wait for the thread and free the port."""
        super().close()
        self._ready.close()
        self._socket.close()
