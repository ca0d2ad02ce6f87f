"""What a link heard, as one stretch of bytes: the seam between receiving and decoding.

A receiving thread lays the datagrams (or pieces of a stream) it got at once into one buffer, says where each begins
and ends, when it came and who sent it, and puts all on the queue as one
`gateway.links.link.Batch(number, heard=Heard(...))`:

    slots: (1024, 2048) uint8 as `recvmmsg` filled them, lengths: (n,), addresses: a bytes-like per slot
    buf, stop = tight(slots.ravel(), np.arange(n) * 2048, lengths)            # a copy: the slots are free again
    Heard(buf, stop - lengths, stop, np.full(n, wall()), sender, senders)     # sender: np.unique of the addresses

Pieces may lie anywhere in `buf`, in any order and with gaps, but they are in order of arrival. A piece need not be a
whole frame: what is cut off at its end is kept by sender and goes on with that sender's next piece, whatever the link.
`senders` are what `Link.send` takes; `None` on a stream with a single far end. The same far end must be an equal object
every time. Take what there is every few milliseconds (not datagram by datagram): a batch costs some 20 us, a datagram
in it next to nothing. `Heard.of` makes one of a list of (arrival, sender, bytes).
"""

from collections.abc import Hashable, Sequence
from typing import NamedTuple

import numba as nb
import numpy as np

Piece = tuple[float, Hashable, bytes]
"""(arrival, fleet time [s since 1970]; sender; bytes as they came)."""


class Heard(NamedTuple):
    """Pieces of bytes in order of arrival."""

    buf: np.ndarray  # bytes they lie in, (b,) uint8
    start: np.ndarray  # where each begins, (n,) int64
    stop: np.ndarray  # and ends, (n,) int64
    arrival: np.ndarray  # fleet time, never falling, (n,) float64 [s since 1970]
    sender: np.ndarray  # number of the sender in `senders`, (n,) int64
    senders: tuple[Hashable, ...] = (None,)

    @classmethod
    def of(cls, pieces: Sequence[Piece]) -> "Heard":
        """Lay pieces one after the other."""
        number: dict[Hashable, int] = {}
        sender = np.array([number.setdefault(who, len(number)) for _, who, _ in pieces], np.int64)
        stop = np.cumsum(np.array([len(data) for _, _, data in pieces], np.int64))
        buf = np.frombuffer(b"".join(data for _, _, data in pieces), np.uint8)
        start = np.concatenate([np.zeros(1, np.int64), stop])[:-1]
        return cls(buf, start, stop, np.array([t for t, _, _ in pieces], float), sender, tuple(number))


def merged(parts: Sequence[Heard]) -> Heard:
    """Lay what was heard at several times one after the other."""
    if len(parts) == 1:
        return parts[0]
    number: dict[Hashable, int] = {}
    buf, start, stop, sender, shift = [], [], [], [], 0
    for part in parts:
        renamed = np.array([number.setdefault(who, len(number)) for who in part.senders], np.int64)
        buf.append(part.buf)
        start.append(part.start + shift)
        stop.append(part.stop + shift)
        sender.append(renamed[part.sender])
        shift += len(part.buf)
    arrival = np.concatenate([part.arrival for part in parts])
    told, begins, ends, who = map(np.concatenate, (buf, start, stop, sender))
    return Heard(told, begins, ends, arrival, who, tuple(number))


@nb.njit(cache=True, nogil=True)
def tight(buf, start, length):
    """Copy pieces one after the other: their bytes, (b,) uint8, and where each ends in them, (n,)."""
    stop = np.cumsum(length)
    out = np.empty(stop[-1] if len(stop) else 0, np.uint8)
    at = 0
    for i in range(len(start)):
        for k in range(length[i]):
            out[at + k] = buf[start[i] + k]
        at += length[i]
    return out, stop
