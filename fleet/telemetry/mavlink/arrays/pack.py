"""Encode the rows of all aircraft as `Sample` messages in one call, with the same bytes as `codec.encode`.

Compiled. Source: msgpack specification; the bytes around the numbers are taken from `codec.encode`.
"""

import numba as nb
import numpy as np

from fleet.bus.codec import encode
from fleet.contract import COLUMNS, Sample

Packed = tuple[int, bytes, float]
"""Number of the aircraft, bytes of its `Sample`, the sample's time [s since 1970]."""
FIELDS = tuple(COLUMNS)
MOST_ROWS = 2_000  # maximum rows of one field in one message
WIDTHS = np.array([len(COLUMNS[field]) for field in FIELDS])
_WHOLE = {"position", "leg", "target", "gnss"}  # integer fields, <i4; all others are <f4
WHOLE = np.array([field in _WHOLE for field in FIELDS])
_MOST_HEAD = 160  # upper limit of the bytes of a field without its numbers


def _chunks(*told: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Concatenate byte strings: bytes, and start of each."""
    return np.frombuffer(b"".join(told), np.uint8), np.cumsum([0, *map(len, told)])


_START = encode(Sample(uav=0, t=0.0))
_NAMES = _chunks(*(encode(field) for field in FIELDS))
_BEGIN = np.frombuffer(_START[: _START.index(b"\xa3uav") + 4], np.uint8)
_T = encode("t")
_WORDS = _chunks(
    _T + b"\xcb",  # 0: time
    b"\x82" + _T + b"\x83" + encode("dtype") + encode("<f8") + encode("shape") + b"\x91",  # 1: times of rows
    encode("data"),  # 2: before any bytes
    encode("x") + b"\x83" + encode("dtype") + encode("<f4") + encode("shape") + b"\x92",  # 3: values of rows
    encode("x") + b"\x83" + encode("dtype") + encode("<i4") + encode("shape") + b"\x92",  # 4: the same, integers
)


@nb.njit(cache=True, nogil=True)
def _put(out, at, told, start, stop):
    to, start, n = nb.uint64(at), nb.uint64(start), nb.uint64(stop - start)  # unsigned indices: twice as fast
    for i in range(n):
        out[to + i] = told[start + i]
    return at + stop - start


@nb.njit(cache=True, nogil=True)
def _number(out, at, value):
    """Write a non-negative integer in the shortest msgpack form."""
    if value < 0x80:
        out[at] = value
        return at + 1
    size, kind = (1, 0xCC) if value < 0x100 else (2, 0xCD) if value < 0x10000 else (4, 0xCE)
    out[at] = kind
    for i in range(size):
        out[at + 1 + i] = value >> 8 * (size - 1 - i) & 0xFF
    return at + 1 + size


@nb.njit(cache=True, nogil=True)
def _data(out, at, size):
    """Write the msgpack header of a byte string."""
    if size < 0x100:
        out[at], out[at + 1] = 0xC4, size
        return at + 2
    out[at], out[at + 1], out[at + 2] = 0xC5, size >> 8, size & 0xFF
    return at + 3


@nb.njit(cache=True, nogil=True)
def _field(out, at, times, values, field, whole, words, w):
    """Write the rows of one field: times (n,), values (n, 8)."""
    n, width = len(times), field
    one, as_float, as_int = np.empty(1), np.empty(1, np.float32), np.empty(1, np.int32)
    raw, raw_float, raw_int = one.view(np.uint8), as_float.view(np.uint8), as_int.view(np.uint8)
    at = _data(out, _put(out, _number(out, _put(out, at, words, w[1], w[2]), n), words, w[2], w[3]), 8 * n)
    for i in range(n):
        one[0] = times[i]
        at = _put(out, at, raw, 0, 8)
    at = _put(out, at, words, w[4], w[5]) if whole else _put(out, at, words, w[3], w[4])
    at = _put(out, _number(out, _number(out, at, n), width), words, w[2], w[3])
    at = _data(out, at, 4 * width * n)
    for i in range(n):
        for k in range(width):
            if whole:
                as_int[0] = np.int32(values[i, k])
                at = _put(out, at, raw_int, 0, 4)
            else:
                as_float[0] = values[i, k]
                at = _put(out, at, raw_float, 0, 4)
    return at


@nb.njit(cache=True, nogil=True)
def _samples(out, uavs, start, stop, t, values, widths, whole, begin, names, first, words, w):
    """Write a sample for every aircraft with rows; return owners, end of each in `out`, and sample times."""
    owners, ends, at = np.empty(len(start), np.int64), np.empty(len(start), np.int64), 0
    ts = np.empty(len(start))
    newest = np.empty(1)
    raw, n = newest.view(np.uint8), 0
    for owner in range(len(start)):
        newest[0] = -np.inf
        for field in range(len(widths)):
            if start[owner, field] < stop[owner, field]:
                newest[0] = max(newest[0], t[stop[owner, field] - 1])
        if newest[0] == -np.inf:
            continue
        at = _put(out, _number(out, _put(out, at, begin, 0, len(begin)), uavs[owner]), words, w[0], w[1])
        for k in range(8):
            out[at + k] = raw[7 - k]
        at += 8
        for field in range(len(widths)):
            at = _put(out, at, names, first[field], first[field + 1])
            a, b = start[owner, field], stop[owner, field]
            if a < b:
                at = _field(out, at, t[a:b], values[a:b], widths[field], whole[field], words, w)
            else:
                out[at] = 0xC0
                at += 1
        owners[n], ends[n], ts[n] = owner, at, newest[0]
        n += 1
    return owners[:n], ends[:n], ts[:n]


def samples(uavs: np.ndarray, start: np.ndarray, stop: np.ndarray, t: np.ndarray, values: np.ndarray) -> list[Packed]:
    """Encode the rows of all aircraft that have rows.

    Args:
        uavs: UAV ids, (m,)
        start, stop: row range of each aircraft and field, at most `MAX_ROWS`, (m, fields)
        t: fleet times, increasing within a field, (n,) [s since 1970]
        values: columns, (n, 8)
    """
    rows = stop - start
    size = int((rows * (8 + 4 * WIDTHS)).sum()) + (64 + _MOST_HEAD * len(FIELDS)) * int((rows > 0).any(axis=1).sum())
    out = np.empty(size, np.uint8)
    owners, ends, ts = _samples(out, uavs, start, stop, t, values, WIDTHS, WHOLE, _BEGIN, *_NAMES, *_WORDS)
    told, stops = out[: ends[-1]].tobytes() if len(ends) else b"", ends.tolist()
    found = zip(owners.tolist(), [0, *stops][:-1], stops, ts.tolist(), strict=True)
    return [(owner, told[start:stop], t) for owner, start, stop, t in found]
