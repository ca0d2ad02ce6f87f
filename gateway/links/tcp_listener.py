"""A TCP port that aircraft or ground stations call: `tcpin`."""

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

MOST = 64  # callers at a time
SPEAKING_S = 3.0  # a caller that sent something so lately keeps its place [s]
SAID_S = 10.0  # between two log lines on callers that had to leave or were refused [s]

_log = logging.getLogger(__name__)


class TcpListener:
    """A port and those who called it.

    Silence is no fault: a station may only listen. But where all places are taken, the caller silent for longest gives
    its place to the next one; only if all have sent something within `SPEAKING_S` is the next one refused.

    Raises:
        OSError: when the port is not free.
    """

    def __init__(self, spec: Spec) -> None:
        self.spec = spec
        self.dropped = self.unsent = 0
        self._callers: dict[Hashable, Tcp] = {}
        self._spoke: dict[Hashable, float] = {}  # when each sent something last, or called [s, monotonic]
        self._silent: set[Hashable] = set()  # callers that have sent nothing yet
        self._said, self._unsaid = float("-inf"), 0
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
        """Return those who are there, whether they have spoken or not."""
        return tuple(self._callers)

    @property
    def port(self) -> int:
        """Return the port listened at."""
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
        """Let the next caller in; gives the caller that has to leave for it, None where there is room or no caller."""
        try:
            connected, caller = self._socket.accept()
        except OSError:  # gone before it was let in
            return None
        now, oldest = time.monotonic(), None
        if len(self._callers) >= MOST:
            oldest = self._longest_silent(now)
            self._warn(now, "one more was refused" if oldest is None else "the one silent for longest had to leave")
            if oldest is None:
                connected.close()
                return None
        tcp = self._callers[caller] = Tcp(connected)
        self._spoke[caller] = now
        self._silent.add(caller)
        ready.register(tcp, selectors.EVENT_READ, caller)
        return oldest

    def _longest_silent(self, now: float) -> Hashable:
        """Return the caller silent for longest; None where all have sent something lately."""
        silent = [one for one, t in self._spoke.items() if one in self._silent or now - t > SPEAKING_S]
        return min(silent, key=self._spoke.__getitem__, default=None)

    def _warn(self, now: float, what: str) -> None:
        """Log that there is no room, at most every `SAID_S`."""
        self._unsaid += 1
        if now - self._said >= SAID_S:
            more = f" ({self._unsaid} since the last such line)" if self._unsaid > 1 else ""
            _log.warning("link %s: found %d callers, expected fewer; %s%s", self.spec.text, MOST, what, more)
            self._said, self._unsaid = now, 0

    def _leave(self, caller: Hashable, ready: selectors.BaseSelector, outlet: Outlet, stop: threading.Event) -> None:
        ready.unregister(self._callers[caller])
        self._part(caller)
        outlet.gone(caller, stop)

    def _serve(self, caller: Hashable, events: int, outlet: Outlet) -> bool:
        """Read from and write to one caller; False where it is gone."""
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
        """Send to one of the callers, if it is there and has room."""
        self.unsent += offer(self._callers.get(where), data, messages)

    def close(self) -> None:
        """Wait for the thread and free the port."""
        if self._thread is not None:
            self._thread.join()
        self._socket.close()
