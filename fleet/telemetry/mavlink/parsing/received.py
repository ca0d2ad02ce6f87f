"""Received bytes of a link: the interface between receiving and decoding.

Pieces may be anywhere in `buf`, in any order and with gaps; the arrays are in order of arrival. A piece may end inside
a frame: the decoder joins the rest with the next piece of that sender. `senders` are the addresses for
`Endpoint.send`; `None` on a stream with a single remote end. A sender must be an equal object every time. Collect data
every few milliseconds, not per datagram: a batch costs about 20 us, an additional datagram almost nothing.
"""

from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import numba as nb
import numpy as np

from fleet.telemetry.mavlink.parsing.scan import ID, PAYLOAD, SIZE


class ReceivedBytes(NamedTuple):
    """Pieces of bytes in order of arrival."""

    buf: np.ndarray  # bytes that contain the pieces, (b,) uint8
    start: np.ndarray  # start of each piece, (n,) int64
    stop: np.ndarray  # end of each piece, (n,) int64
    arrival: np.ndarray  # fleet time, non-decreasing, (n,) float64 [s since 1970]
    sender: np.ndarray  # number of the sender in `senders`, (n,) int64
    senders: tuple[Hashable, ...] = (None,)

    @classmethod
    def from_pieces(cls, pieces: Sequence[tuple[float, Hashable, bytes]]) -> "ReceivedBytes":
        """Concatenate pieces: arrival, fleet time [s since 1970]; sender; received bytes."""
        sender_index: dict[Hashable, int] = {}
        sender = np.array([sender_index.setdefault(source, len(sender_index)) for _, source, _ in pieces], np.int64)
        stop = np.cumsum(np.array([len(data) for _, _, data in pieces], np.int64))
        buf = np.frombuffer(b"".join(data for _, _, data in pieces), np.uint8)
        start = np.concatenate([np.zeros(1, np.int64), stop])[:-1]
        return cls(buf, start, stop, np.array([t for t, _, _ in pieces], float), sender, tuple(sender_index))


def joined_senders(parts: Sequence[Any]) -> tuple[np.ndarray, tuple[Hashable, ...]]:
    """Number the senders of several batches jointly: `sender` of all rows, (n,), and `senders`."""
    index: dict[Hashable, int] = {}
    numbers = [
        np.array([index.setdefault(one, len(index)) for one in part.senders], np.int64)[part.sender] for part in parts
    ]
    return np.concatenate(numbers), tuple(index)


def merge_received(parts: Sequence[ReceivedBytes]) -> ReceivedBytes:
    """Concatenate several batches of received bytes."""
    if len(parts) == 1:
        return parts[0]
    offsets = np.cumsum([0, *(len(part.buf) for part in parts)])
    start = np.concatenate([part.start + offset for part, offset in zip(parts, offsets, strict=False)])
    stop = np.concatenate([part.stop + offset for part, offset in zip(parts, offsets, strict=False)])
    buf, arrival = np.concatenate([part.buf for part in parts]), np.concatenate([part.arrival for part in parts])
    return ReceivedBytes(buf, start, stop, arrival, *joined_senders(parts))


def read_only(buf: np.ndarray) -> np.ndarray:
    """Return a read-only view; kernels are compiled separately for arrays that can and that cannot be written."""
    view = buf.view()
    view.flags.writeable = False
    return view


_u = nb.uint64


@nb.njit(cache=True, nogil=True)
def compact(buf, start, length):
    """Copy pieces to a contiguous buffer: bytes, (b,) uint8, and end of each piece, (n,)."""
    stop = np.cumsum(length)
    out = np.empty(stop[-1] if len(stop) else 0, np.uint8)
    dest = _u(0)
    for i in range(len(start)):
        source, n = _u(start[i]), _u(length[i])
        for k in range(n):  # unsigned indices: one copy of the piece, 18 times as fast
            out[dest + k] = buf[source + k]
        dest += n
    return out, stop


@nb.njit(cache=True, nogil=True)
def collect_payloads(buf, starts, sizes, width):
    """Return payloads as rows, truncated payloads padded with zeros, (n, width) uint8."""
    out = np.zeros((len(starts), width), np.uint8)
    for i in range(len(starts)):
        source = _u(starts[i])
        for k in range(_u(min(sizes[i], width))):
            out[i, k] = buf[source + k]
    return out


@nb.njit(cache=True, nogil=True)
def group_payloads(buf, headers, kinds, widths):
    """Copy all payloads grouped by message, truncated payloads padded with zeros.

    Args:
        buf: bytes
        headers: frames found by `scan`, (n, 9)
        kinds: message index by message id
        widths: payload length by message index, (m,) [bytes]
    Returns:
        payloads, (b,) uint8; start of each message in them, (m + 1,); frame numbers grouped by message, (n,);
        start of each message in them, (m + 1,)
    """
    frame_start, payload_start = np.zeros(len(widths) + 1, np.int64), np.zeros(len(widths) + 1, np.int64)
    for i in range(len(headers)):
        frame_start[kinds[headers[i, ID]] + 1] += 1
    for kind in range(len(widths)):
        payload_start[kind + 1] = payload_start[kind] + frame_start[kind + 1] * widths[kind]
        frame_start[kind + 1] += frame_start[kind]
    out, frame_numbers = np.empty(payload_start[-1], np.uint8), np.empty(len(headers), np.int64)
    next_slot = frame_start.copy()
    for i in range(len(headers)):
        kind = kinds[headers[i, ID]]
        width, start = widths[kind], headers[i, PAYLOAD]
        dest, size = payload_start[kind] + (next_slot[kind] - frame_start[kind]) * width, min(headers[i, SIZE], width)
        frame_numbers[next_slot[kind]] = i
        next_slot[kind] += 1
        k = 0
        while k + 8 <= size:  # eight loads, then eight stores: compiled to one move each
            source, target = _u(start + k), _u(dest + k)
            a, b, c, d = buf[source], buf[source + _u(1)], buf[source + _u(2)], buf[source + _u(3)]
            e, f, g, h = buf[source + _u(4)], buf[source + _u(5)], buf[source + _u(6)], buf[source + _u(7)]
            out[target], out[target + _u(1)], out[target + _u(2)], out[target + _u(3)] = a, b, c, d
            out[target + _u(4)], out[target + _u(5)], out[target + _u(6)], out[target + _u(7)] = e, f, g, h
            k += 8
        while k < size:
            out[dest + k] = buf[start + k]
            k += 1
        while k < width:
            out[dest + k] = 0
            k += 1
    return out, payload_start, frame_numbers, frame_start
