"""Copy payloads of frames to arrays of the payload length in pymavlink's classes; compiled."""

import numba as nb
import numpy as np

from fleet.telemetry.mavlink.parsing.scan import ID, PAYLOAD, SIZE

_u = nb.uint64


@nb.njit(cache=True, nogil=True)
def collect_payloads(buf, starts, sizes, width):
    """Return payloads as rows, truncated payloads padded with zeros, (n, width) uint8."""
    out = np.zeros((len(starts), width), np.uint8)
    for i in range(len(starts)):
        for k in range(min(sizes[i], width)):
            out[i, k] = buf[starts[i] + k]
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
    out, frame_numbers, next_slot = (
        np.empty(payload_start[-1], np.uint8),
        np.empty(len(headers), np.int64),
        frame_start.copy(),
    )
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
