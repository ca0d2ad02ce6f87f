"""Links over UDP: `udpin` listens, `udpout` sends to one peer, `udpbcast` broadcasts to a network."""

import logging
import queue
import selectors
import socket
import threading
from collections.abc import Hashable, Sequence
from typing import Any, cast

from gateway.links.link import POLL_S, BackOff, Batch, BatchWriter
from gateway.links.receive import MAX_DATAGRAMS, make_receiver
from gateway.settings.link_spec import LinkSpec

BUFFER = 1 << 26  # requested receive buffer: two seconds of 250 aircraft; memory is used only when filled [bytes]
_RCVBUFFORCE = 33  # SO_RCVBUFFORCE: exceeds the system's limit, if permitted
_MAX_WAIT_S = 0.02
_FLOOD_BYTES_S = 4e8  # buffer use of a flood of 300,000 datagrams a second [bytes/s]

_log = logging.getLogger(__name__)


class Udp:
    """UDP socket and its thread.

    Raises:
        OSError: when the listening port is in use.
    """

    def __init__(self, spec: LinkSpec) -> None:
        self.spec = spec
        self.dropped = self.unsent = 0
        self.known_peers: Sequence[Hashable] = ()
        self._socket = _open_listening(spec) if spec.kind == "udpin" else None
        self._thread: threading.Thread | None = None

    @property
    def port(self) -> int:
        """Return the local port; 0 before the socket is open."""
        return int(self._socket.getsockname()[1]) if self._socket is not None else 0

    def start(self, number: int, out: "queue.Queue[Batch]", stop: threading.Event) -> None:
        """Receive in a thread, which only time-stamps and queues datagrams."""
        outlet = BatchWriter(number, out, self)
        self._thread = threading.Thread(target=self._run, args=(outlet, stop), name=self.spec.text)
        self._thread.start()

    def _run(self, outlet: BatchWriter, stop: threading.Event) -> None:
        back_off = BackOff()
        while self._socket is None and not stop.is_set():
            try:
                self._socket, where = _open_outgoing(self.spec)
                self.known_peers = (where,)
            except OSError as error:  # no network yet, or an unresolved host name
                _log.warning("link %s: %s; trying again", self.spec.text, error.strerror or error)
                back_off.wait(stop)
        if self._socket is not None:
            self._receive(self._socket, outlet, stop)

    def _receive(self, sock: socket.socket, outlet: BatchWriter, stop: threading.Event) -> None:
        source = make_receiver(sock)
        size = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        wait_s = min(_MAX_WAIT_S, size / _FLOOD_BYTES_S)  # a batch of datagrams costs little more than one
        with selectors.DefaultSelector() as ready:
            ready.register(sock, selectors.EVENT_READ)
            while not stop.is_set():
                if ready.select(POLL_S):
                    received = source.receive()
                    if received is not None:
                        outlet.put(received)
                    if received is None or len(received.start) < MAX_DATAGRAMS:  # else there is more
                        stop.wait(wait_s)

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


def _open_listening(spec: LinkSpec) -> socket.socket:
    family = socket.AF_INET6 if ":" in spec.address else socket.AF_INET
    sock = socket.socket(family, socket.SOCK_DGRAM)
    _set_buffer(sock)
    try:
        sock.bind((spec.address, spec.port))
    except OSError as error:
        sock.close()
        reason = error.strerror or str(error)
        raise OSError(f"link {spec.text}: {reason}; stop the process on this port or name another") from None
    return sock


def _open_outgoing(spec: LinkSpec) -> tuple[socket.socket, Hashable]:
    """Open a socket that sends first: connected to one peer, or unconnected for broadcasts."""
    family, _, _, _, where = socket.getaddrinfo(spec.address, spec.port, type=socket.SOCK_DGRAM)[0]
    sock = socket.socket(family, socket.SOCK_DGRAM)
    try:
        _set_buffer(sock)
        if spec.kind == "udpbcast":
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            sock.bind(("", 0))
        else:
            sock.connect(where)
    except OSError:
        sock.close()
        raise
    return sock, where


def _set_buffer(sock: socket.socket) -> None:
    try:
        sock.setsockopt(socket.SOL_SOCKET, _RCVBUFFORCE, BUFFER)
    except OSError:  # not permitted
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
