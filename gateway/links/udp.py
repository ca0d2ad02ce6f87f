"""Links over UDP: `udpin` listens, `udpout` sends to one peer, `udpbcast` broadcasts to a network."""

import logging
import queue
import selectors
import socket
import threading
from collections.abc import Hashable, Sequence
from typing import Any, cast

from gateway.links.backoff import BackOff
from gateway.links.link import POLL_S, Batch, Outlet
from gateway.links.receive import MOST, receiver
from gateway.settings.link_spec import Spec

BUFFER = 1 << 26  # requested receive buffer: two seconds of 250 aircraft; memory is used only when filled [bytes]
_FORCE = 33  # SO_RCVBUFFORCE: exceeds the system's limit, if permitted
_LONGEST_NAP_S = 0.02
_FILL = 4e8  # buffer use of a flood of 300,000 datagrams a second [bytes/s]

_log = logging.getLogger(__name__)


class Udp:
    """UDP socket and its thread.

    Raises:
        OSError: when the listening port is in use.
    """

    def __init__(self, spec: Spec) -> None:
        self.spec = spec
        self.dropped = self.unsent = 0
        self.greets: Sequence[Hashable] = ()
        self._socket = _listening(spec) if spec.kind == "udpin" else None
        self._thread: threading.Thread | None = None

    @property
    def port(self) -> int:
        """Return the local port; 0 before the socket is open."""
        return int(self._socket.getsockname()[1]) if self._socket is not None else 0

    def start(self, number: int, out: "queue.Queue[Batch]", stop: threading.Event) -> None:
        """Receive in a thread, which only time-stamps and queues datagrams."""
        outlet = Outlet(number, out, self)
        self._thread = threading.Thread(target=self._run, args=(outlet, stop), name=self.spec.text)
        self._thread.start()

    def _run(self, outlet: Outlet, stop: threading.Event) -> None:
        back_off = BackOff()
        while self._socket is None and not stop.is_set():
            try:
                self._socket, where = _calling(self.spec)
                self.greets = (where,)
            except OSError as error:  # no network yet, or an unresolved host name
                _log.warning("link %s: %s; trying again", self.spec.text, error.strerror or error)
                back_off.wait(stop)
        if self._socket is not None:
            self._receive(self._socket, outlet, stop)

    def _receive(self, sock: socket.socket, outlet: Outlet, stop: threading.Event) -> None:
        source = receiver(sock)
        size = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        nap = min(_LONGEST_NAP_S, size / _FILL)  # a batch of datagrams costs little more than one
        with selectors.DefaultSelector() as ready:
            ready.register(sock, selectors.EVENT_READ)
            while not stop.is_set():
                if ready.select(POLL_S):
                    heard = source.take()
                    if heard is not None:
                        outlet.put(heard)
                    if heard is None or len(heard.start) < MOST:  # else there is more
                        stop.wait(nap)

    def send(self, where: Hashable, data: bytes, messages: int = 1) -> None:
        """Send one datagram; count its messages as unsent if the buffer is full or the peer unreachable."""
        try:
            if self._socket is None:
                raise OSError("not open yet")
            self._socket.sendto(data, cast("Any", where))
        except OSError:
            self.unsent += messages

    def close(self) -> None:
        """Wait for the thread and free the port."""
        if self._thread is not None:
            self._thread.join()
        if self._socket is not None:
            self._socket.close()


def _listening(spec: Spec) -> socket.socket:
    family = socket.AF_INET6 if ":" in spec.where else socket.AF_INET
    found = socket.socket(family, socket.SOCK_DGRAM)
    _widen(found)
    try:
        found.bind((spec.where, spec.port))
    except OSError as error:
        found.close()
        reason = error.strerror or str(error)
        raise OSError(f"link {spec.text}: {reason}; stop the process on this port or name another") from None
    return found


def _calling(spec: Spec) -> tuple[socket.socket, Hashable]:
    """Open a socket that sends first: connected to one peer, or unconnected for broadcasts."""
    family, _, _, _, where = socket.getaddrinfo(spec.where, spec.port, type=socket.SOCK_DGRAM)[0]
    found = socket.socket(family, socket.SOCK_DGRAM)
    try:
        _widen(found)
        if spec.kind == "udpbcast":
            found.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            found.bind(("", 0))
        else:
            found.connect(where)
    except OSError:
        found.close()
        raise
    return found, where


def _widen(sock: socket.socket) -> None:
    try:
        sock.setsockopt(socket.SOL_SOCKET, _FORCE, BUFFER)
    except OSError:  # not permitted
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
