"""UDP links. Datagrams are received in batches with `recvmmsg` on Linux, one by one elsewhere.

Source: recvmmsg(2), udp(7), socket(7), cmsg(3); structures as in <sys/socket.h> of 64-bit Linux.
"""

import ctypes
import logging
import mmap
import selectors
import socket
import sys
import time
from collections.abc import Hashable
from typing import Any, cast

import numba as nb
import numpy as np

from fleet.telemetry.mavlink.parsing.received import ReceivedBytes, compact, merge_received, read_only
from gateway.link_spec import LinkSpec
from gateway.links.link import FIRST_RETRY_S, LAST_RETRY_S, POLL_S, Endpoint, wall

MAX_DATAGRAMS = 256  # datagrams per batch, at most 16 MB
SLOT_BYTES = 65_536  # maximum size of a datagram [bytes]
_PAGE = 4096  # memory page; a larger datagram touches more than one page of its slot [bytes]
_ADDRESS = 28  # bytes of an IPv6 socket address; IPv4 takes 16
_TIMESTAMPNS = 35  # SO_TIMESTAMPNS: the system provides the arrival time of each datagram
_STAMP_NUMBERS = 4  # numbers of a time stamp message: length, kind, seconds, nanoseconds
_STAMPED = socket.SOL_SOCKET | _TIMESTAMPNS << 32
_MAX_DELAY_S = 1.0  # upper bound of the delay of a datagram, for steps of the system's clock
_MAX_ADDRESSES = 4096  # parsed addresses that are cached
_DONTWAIT = getattr(socket, "MSG_DONTWAIT", 0)
_VECTOR = np.dtype([("base", "u8"), ("size", "u8")])  # struct iovec
_MESSAGE = np.dtype(  # struct mmsghdr
    {
        "names": ["name", "name_size", "vectors", "vector_count", "control", "control_size", "length"],
        "formats": ["u8", "u4", "u8", "u8", "u8", "u8", "u4"],
        "offsets": [0, 8, 16, 24, 32, 40, 56],
        "itemsize": 64,
    }
)


def make_receiver(sock: socket.socket) -> "BatchReceiver | SingleReceiver":
    """Return the fastest way to read a socket on this machine."""
    try:
        return BatchReceiver(sock)
    except (AttributeError, OSError):  # another system, or another C library
        return SingleReceiver(sock)


class SingleReceiver:
    """Portable receiver, one datagram per call."""

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        self._sock = sock

    def receive(self) -> ReceivedBytes | None:
        """Return the pending datagrams; None without any."""
        pieces: list[tuple[float, Hashable, bytes]] = []
        while len(pieces) < MAX_DATAGRAMS:
            try:
                data, sender = self._sock.recvfrom(SLOT_BYTES)
            except OSError:  # no more datagrams, or an earlier send failed
                break
            pieces.append((wall(), sender, data))
        return ReceivedBytes.from_pieces(pieces) if pieces else None


class BatchReceiver:
    """Receiver of up to `MAX_DATAGRAMS` per call; pages touched by long datagrams are returned to the system."""

    def __init__(self, sock: socket.socket) -> None:
        if not sys.platform.startswith("linux"):
            raise AttributeError("recvmmsg: Linux only")
        sock.setblocking(False)
        self._sock = sock
        self._recvmmsg = ctypes.CDLL(None, use_errno=True).recvmmsg  # releases the interpreter during the call
        self._recvmmsg.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p)
        self._memory = mmap.mmap(-1, MAX_DATAGRAMS * SLOT_BYTES, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        self._slots = read_only(np.frombuffer(self._memory, np.uint8))
        self._names = np.zeros((MAX_DATAGRAMS, _ADDRESS), np.uint8)
        self._stamps = np.zeros((MAX_DATAGRAMS, _STAMP_NUMBERS), np.int64)
        self._newest = 0.0  # arrival [s since 1970]
        self._starts = np.arange(MAX_DATAGRAMS) * SLOT_BYTES
        self._vectors, self._messages = np.zeros(MAX_DATAGRAMS, _VECTOR), np.zeros(MAX_DATAGRAMS, _MESSAGE)
        self._vectors["base"], self._vectors["size"] = self._slots.ctypes.data + self._starts, SLOT_BYTES
        self._messages["vectors"], self._messages["vector_count"] = _addresses(self._vectors), 1
        self._messages["name"], self._messages["control"] = _addresses(self._names), _addresses(self._stamps)
        self._messages_at = self._messages.ctypes.data
        sock.setsockopt(socket.SOL_SOCKET, _TIMESTAMPNS, 1)
        self._name_sizes, self._stamp_sizes = self._messages["name_size"], self._messages["control_size"]
        self._lengths, self._senders = self._messages["length"], dict[bytes, Hashable]()
        self._take(0)  # compile before the first datagram

    def receive(self) -> ReceivedBytes | None:
        """Return the pending datagrams; None without any."""
        self._name_sizes[:], self._stamp_sizes[:] = _ADDRESS, self._stamps.itemsize * _STAMP_NUMBERS
        count = self._recvmmsg(self._sock.fileno(), self._messages_at, MAX_DATAGRAMS, _DONTWAIT, None)
        return self._take(count) if count > 0 else None  # no datagram, or an earlier send failed

    def _take(self, count: int) -> ReceivedBytes:
        """Copy the first `count` datagrams."""
        control = (self._stamps, self._stamp_sizes, wall(), time.time())
        lengths, arrival, self._newest = read_headers(self._lengths, *control, self._newest, count)
        buf, stop = compact(self._slots, self._starts[:count], lengths)
        if len(buf) > _PAGE and lengths.max() > _PAGE:
            self._memory.madvise(mmap.MADV_DONTNEED)
        sender, first = number_addresses(self._names, self._name_sizes, count)
        names = [self._names[i, : self._name_sizes[i]].tobytes() for i in first.tolist()]
        return ReceivedBytes(buf, stop - lengths, stop, arrival, sender, tuple(map(self._sender, names)))

    def _sender(self, address: bytes) -> Hashable:
        if address not in self._senders:
            if len(self._senders) >= _MAX_ADDRESSES:
                self._senders.clear()
            self._senders[address] = read_address(address)
        return self._senders[address]


def _addresses(array: np.ndarray) -> np.ndarray:
    """Return the memory address of each row, (n,)."""
    return array.ctypes.data + np.arange(len(array)) * array.strides[0]


@nb.njit(cache=True, nogil=True)
def read_headers(sizes, stamps, stamp_sizes, now, system_now, newest, count):
    """Read the lengths and arrival times of the first `count` datagrams.

    Args:
        sizes: lengths, (m,) [bytes]
        stamps, stamp_sizes: time stamp messages, (m, 4), and their sizes, (m,) [bytes]
        now: fleet time [s since 1970]
        system_now: the system's clock [s since 1970]
        newest: arrival of the last datagram before [s since 1970]
    Returns:
        lengths, (n,) [bytes]; arrival times, non-decreasing, (n,) [s since 1970], now for datagrams without a time
        stamp; the last of them
    """
    lengths, arrival = np.empty(count, np.int64), np.empty(count)
    for i in range(count):
        delay = 0.0
        if stamp_sizes[i] > 0 and stamps[i, 1] == _STAMPED:
            delay = min(max(system_now - stamps[i, 2] - stamps[i, 3] * 1e-9, 0.0), _MAX_DELAY_S)
        newest = max(now - delay, newest)
        lengths[i], arrival[i] = sizes[i], newest
    return lengths, arrival, newest


@nb.njit(cache=True, nogil=True)
def number_addresses(names, sizes, count):
    """Number distinct addresses: number of each address, (n,), and index of its first occurrence, (k,)."""
    number, first, k = np.empty(count, np.int64), np.empty(count, np.int64), 0
    for i in range(count):
        candidate = number[i - 1] if i else 0  # often the sender of the last datagram
        if not (k and _equal(names[first[candidate]], names[i], sizes[first[candidate]], sizes[i])):
            candidate = 0
            while candidate < k and not _equal(names[first[candidate]], names[i], sizes[first[candidate]], sizes[i]):
                candidate += 1
        if candidate == k:
            first[k] = i
            k += 1
        number[i] = candidate
    return number, first[:k]


@nb.njit(cache=True, nogil=True)
def _equal(a, b, size_a, size_b):
    same = size_a == size_b
    for k in range(min(size_a, len(a))):
        same &= a[k] == b[k]
    return same


def read_address(raw: bytes) -> Hashable:
    """Parse a raw socket address as in Python: (host, port), or (host, port, flow, scope) for IPv6."""
    family, port = int.from_bytes(raw[:2], sys.byteorder), int.from_bytes(raw[2:4], "big")
    if family == socket.AF_INET:
        return socket.inet_ntop(family, raw[4:8]), port
    host = socket.inet_ntop(socket.AF_INET6, raw[8:24])
    return host, port, int.from_bytes(raw[4:8], "big"), int.from_bytes(raw[24:28], sys.byteorder)


BUFFER = 1 << 26  # requested receive buffer: two seconds of 250 aircraft; memory is used only when filled [bytes]
_RCVBUFFORCE = 33  # SO_RCVBUFFORCE: exceeds the system's limit, if permitted
_WAIT_S, _BUSY_WAIT_S = 0.02, 0.05  # between two rounds of a link; of one that receives many datagrams [s]
_BUSY = 100  # datagrams in a round of a busy link
_ROUND_BYTES = 1 << 18  # received in one round, at least [bytes]
_FLOOD_BYTES_S = 4e8  # buffer use of a flood of 300,000 datagrams a second [bytes/s]

_log = logging.getLogger(__name__)


def receive_round(source: "BatchReceiver | SingleReceiver") -> tuple[ReceivedBytes | None, bool]:
    """Return the pending datagrams up to a limit, None without any; and whether none are left."""
    parts: list[ReceivedBytes] = []
    size, count = 0, MAX_DATAGRAMS
    while count == MAX_DATAGRAMS and size < _ROUND_BYTES and (received := source.receive()) is not None:
        parts.append(received)
        size, count = size + len(received.buf), len(received.start)
    return merge_received(parts) if parts else None, count < MAX_DATAGRAMS or size < _ROUND_BYTES


class Udp(Endpoint):
    """UDP socket.

    Raises:
        OSError: when the listening port is in use.
    """

    def __init__(self, spec: LinkSpec) -> None:
        super().__init__(spec)
        self._socket = _open_listening(spec) if spec.kind == "udpin" else None

    @property
    def port(self) -> int:
        """Return the local port; 0 before the socket is open."""
        return int(self._socket.getsockname()[1]) if self._socket is not None else 0

    def _run(self) -> None:
        wait_s = FIRST_RETRY_S
        while self._socket is None and not self._stop.is_set():
            try:
                self._socket, where = _open_outgoing(self.spec)
                self.known_peers = (where,)
            except OSError as error:  # no network yet, or an unresolved host name
                _log.warning("link %s: %s; trying again", self.spec.text, error.strerror or error)
                self._stop.wait(wait_s)
                wait_s = min(2 * wait_s, LAST_RETRY_S)
        if self._socket is not None:
            self._receive(self._socket)

    def _receive(self, sock: socket.socket) -> None:
        source = make_receiver(sock)
        longest_s = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) / _FLOOD_BYTES_S
        with selectors.DefaultSelector() as ready:
            ready.register(sock, selectors.EVENT_READ)
            while not self._stop.is_set():
                if ready.select(POLL_S):
                    received, is_empty = receive_round(source)
                    if received is not None:
                        self._put(received)
                    if is_empty:
                        is_busy = received is not None and len(received.start) >= _BUSY
                        wait_s = min(_BUSY_WAIT_S if is_busy else _WAIT_S, longest_s)
                        self._stop.wait(wait_s - time.monotonic() % wait_s)  # all links at once, before a publication

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
        super().close()
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
