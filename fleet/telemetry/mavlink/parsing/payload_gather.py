"""Copy payloads of frames to arrays of the payload length in pymavlink's classes; compiled."""

import numba as nb
import numpy as np

from fleet.telemetry.mavlink.parsing.scan import ID, PAYLOAD, SIZE

_u = nb.uint64


@nb.njit(cache=True, nogil=True)
def gather(buf, starts, sizes, width):
    """Return payloads as rows, truncated payloads padded with zeros, (n, width) uint8."""
    out = np.zeros((len(starts), width), np.uint8)
    for i in range(len(starts)):
        for k in range(min(sizes[i], width)):
            out[i, k] = buf[starts[i] + k]
    return out


@nb.njit(cache=True, nogil=True)
def deal(buf, at, kinds, widths):
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
    first, begin = np.zeros(len(widths) + 1, np.int64), np.zeros(len(widths) + 1, np.int64)
    for i in range(len(at)):
        first[kinds[at[i, ID]] + 1] += 1
    for kind in range(len(widths)):
        begin[kind + 1] = begin[kind] + first[kind + 1] * widths[kind]
        first[kind + 1] += first[kind]
    out, which, done = np.empty(begin[-1], np.uint8), np.empty(len(at), np.int64), first.copy()
    for i in range(len(at)):
        kind = kinds[at[i, ID]]
        width, start = widths[kind], at[i, PAYLOAD]
        to, size = begin[kind] + (done[kind] - first[kind]) * width, min(at[i, SIZE], width)
        which[done[kind]] = i
        done[kind] += 1
        k = 0
        while k + 8 <= size:  # eight loads, then eight stores: compiled to one move each
            i0, o0 = _u(start + k), _u(to + k)
            a, b, c, d = buf[i0], buf[i0 + _u(1)], buf[i0 + _u(2)], buf[i0 + _u(3)]
            e, f, g, h = buf[i0 + _u(4)], buf[i0 + _u(5)], buf[i0 + _u(6)], buf[i0 + _u(7)]
            out[o0], out[o0 + _u(1)], out[o0 + _u(2)], out[o0 + _u(3)] = a, b, c, d
            out[o0 + _u(4)], out[o0 + _u(5)], out[o0 + _u(6)], out[o0 + _u(7)] = e, f, g, h
            k += 8
        while k < size:
            out[to + k] = buf[start + k]
            k += 1
        while k < width:
            out[to + k] = 0
            k += 1
    return out, begin, which, first
