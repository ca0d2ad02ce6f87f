"""TCP server for aircraft or ground stations: `tcpin`."""

import logging
import queue
import selectors
import socket
import threading
import time
from collections.abc import Hashable, Sequence

from gateway.links.link import POLL_S, Batch, Outlet
from gateway.links.stream import Tcp, offer
from gateway.settings.link_spec import Spec

MOST = 64  # clients at a time
SPEAKING_S = 3.0  # a client that sent data within this time is not disconnected [s]
SAID_S = 10.0  # between two log lines on clients that were disconnected or refused [s]

_log = logging.getLogger(__name__)


class TcpListener:
    """Listening port and its clients.

    Silent clients are allowed: a station may only listen. When all places are taken, a new client replaces the client
    silent for longest; if all have sent data within `SPEAKING_S`, the new client is refused.

    Raises:
        OSError: when the port is in use.
    """

    def __init__(self, spec: Spec) -> None:
        self.spec = spec
        self.dropped = self.unsent = 0
        self._callers: dict[Hashable, Tcp] = {}
        self._spoke: dict[Hashable, float] = {}  # time of the last data or of the connection [s, monotonic]
        self._silent: set[Hashable] = set()  # clients that have sent nothing yet
        self._said, self._unsaid = float("-inf"), 0
        self._thread: threading.Thread | None = None
        family = socket.AF_INET6 if ":" in spec.where else socket.AF_INET
        try:
            self._socket = socket.create_server((spec.where, spec.port), family=family)
        except OSError as error:
            reason = error.strerror or str(error)
            raise OSError(f"link {spec.text}: {reason}; stop the process on this port or name another") from None
        self._socket.setblocking(False)

    @property
    def greets(self) -> Sequence[Hashable]:
        """Return all connected clients, silent ones included."""
        return tuple(self._callers)

    @property
    def port(self) -> int:
        """Return the listening port."""
        return int(self._socket.getsockname()[1])

    def start(self, number: int, out: "queue.Queue[Batch]", stop: threading.Event) -> None:
        """Accept and receive in a thread."""
        outlet = Outlet(number, out, self)
        self._thread = threading.Thread(target=self._run, args=(outlet, stop), name=self.spec.text)
        self._thread.start()

    def _run(self, outlet: Outlet, stop: threading.Event) -> None:
        read, both = selectors.EVENT_READ, selectors.EVENT_READ | selectors.EVENT_WRITE
        with selectors.DefaultSelector() as ready:
            ready.register(self._socket, read)
            while not stop.is_set():
                for caller, tcp in self._callers.items():
                    ready.modify(tcp, both if tcp.outbox.waits() else read, caller)
                for key, events in ready.select(POLL_S):
                    if key.fileobj is self._socket:
                        if (oldest := self._accept(ready)) is not None:
                            self._leave(oldest, ready, outlet, stop)
                    elif key.data in self._callers and not self._serve(key.data, events, outlet):
                        self._leave(key.data, ready, outlet, stop)
            for caller in list(self._callers):
                self._part(caller)

    def _accept(self, ready: selectors.BaseSelector) -> Hashable:
        """Accept the next client; return the client to disconnect for it, None if there is space or no client."""
        try:
            connected, caller = self._socket.accept()
        except OSError:  # disconnected before it was accepted
            return None
        now, oldest = time.monotonic(), None
        if len(self._callers) >= MOST:
            oldest = self._longest_silent(now)
            self._warn(now, "refused another" if oldest is None else "disconnected the one silent for longest")
            if oldest is None:
                connected.close()
                return None
        tcp = self._callers[caller] = Tcp(connected)
        self._spoke[caller] = now
        self._silent.add(caller)
        ready.register(tcp, selectors.EVENT_READ, caller)
        return oldest

    def _longest_silent(self, now: float) -> Hashable:
        """Return the client silent for longest; None if all have sent data recently."""
        silent = [one for one, t in self._spoke.items() if one in self._silent or now - t > SPEAKING_S]
        return min(silent, key=self._spoke.__getitem__, default=None)

    def _warn(self, now: float, what: str) -> None:
        """Log that all places are taken, at most every `LOG_EVERY_S`."""
        self._unsaid += 1
        if now - self._said >= SAID_S:
            more = f" ({self._unsaid} since the last such line)" if self._unsaid > 1 else ""
            _log.warning("link %s: found %d clients, expected fewer; %s%s", self.spec.text, MOST, what, more)
            self._said, self._unsaid = now, 0

    def _leave(self, caller: Hashable, ready: selectors.BaseSelector, outlet: Outlet, stop: threading.Event) -> None:
        ready.unregister(self._callers[caller])
        self._part(caller)
        outlet.gone(caller, stop)

    def _serve(self, caller: Hashable, events: int, outlet: Outlet) -> bool:
        """Read from and write to one client; return False if it has disconnected."""
        tcp = self._callers[caller]
        try:
            if events & selectors.EVENT_WRITE:
                tcp.outbox.flush()
            if events & selectors.EVENT_READ and (data := tcp.read()):
                self._spoke[caller] = time.monotonic()
                self._silent.discard(caller)
                outlet.piece(caller, data)
        except OSError:
            return False
        return True

    def _part(self, caller: Hashable) -> None:
        tcp = self._callers.pop(caller)
        self._silent.discard(caller)
        del self._spoke[caller]
        tcp.close()
        self.unsent += tcp.outbox.close()

    def send(self, where: Hashable, data: bytes, messages: int = 1) -> None:
        """Send to one client, if it is connected and its send queue has space."""
        self.unsent += offer(self._callers.get(where), data, messages)

    def close(self) -> None:
        """Wait for the thread and free the port."""
        if self._thread is not None:
            self._thread.join()
        self._socket.close()
