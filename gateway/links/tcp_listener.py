"""A TCP port that aircraft or ground stations call: `tcpin`."""

import contextlib
import logging
import queue
import selectors
import socket
import threading
from collections.abc import Hashable, Sequence

from gateway.link import POLL_S, Batch, Outlet
from gateway.links.stream import Tcp, offer
from gateway.spec import Spec

MOST = 64  # callers at a time

_log = logging.getLogger(__name__)


class TcpListener:
    """A port and those who called it.

    Raises:
        OSError: when the port is not free.
    """

    def __init__(self, spec: Spec) -> None:
        self.spec = spec
        self.dropped = self.unsent = 0
        self._callers: dict[Hashable, Tcp] = {}
        self._thread: threading.Thread | None = None
        family = socket.AF_INET6 if ":" in spec.where else socket.AF_INET
        try:
            self._socket = socket.create_server((spec.where, spec.port), family=family)
        except OSError as error:
            reason = error.strerror or str(error)
            raise OSError(f"link {spec.text}: {reason}; stop what holds the port or name another") from None
        self._socket.setblocking(False)

    @property
    def greets(self) -> Sequence[Hashable]:
        """Give those who are there, whether they have spoken or not."""
        return tuple(self._callers)

    @property
    def port(self) -> int:
        """Give the port listened at."""
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
                        self._accept(ready)
                    elif not self._serve(key.data, events, outlet):
                        ready.unregister(key.fileobj)
                        self._part(key.data)
                        outlet.gone(key.data, stop)
            for caller in list(self._callers):
                self._part(caller)

    def _accept(self, ready: selectors.BaseSelector) -> None:
        with contextlib.suppress(OSError):  # gone before it was let in
            connected, caller = self._socket.accept()
            if len(self._callers) >= MOST:
                connected.close()
                _log.warning("link %s: found %d callers, expected fewer; one more was refused", self.spec.text, MOST)
                return
            tcp = self._callers[caller] = Tcp(connected)
            ready.register(tcp, selectors.EVENT_READ, caller)

    def _serve(self, caller: Hashable, events: int, outlet: Outlet) -> bool:
        """Read from and write to one caller; False where it is gone."""
        tcp = self._callers[caller]
        try:
            if events & selectors.EVENT_WRITE:
                tcp.outbox.flush()
            if events & selectors.EVENT_READ and (data := tcp.read()):
                outlet.piece(caller, data)
        except OSError:
            return False
        return True

    def _part(self, caller: Hashable) -> None:
        tcp = self._callers.pop(caller)
        tcp.close()
        self.unsent += tcp.outbox.close()

    def send(self, where: Hashable, data: bytes, messages: int = 1) -> None:
        """Send to one of the callers, if it is there and has room."""
        self.unsent += offer(self._callers.get(where), data, messages)

    def close(self) -> None:
        """Wait for the thread and free the port."""
        if self._thread is not None:
            self._thread.join()
        self._socket.close()
