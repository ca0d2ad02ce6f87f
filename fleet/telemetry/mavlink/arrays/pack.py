"""Encode the rows of all aircraft as `Sample` messages in one call, with the same bytes as `codec.encode`.

Compiled. Source: msgpack specification; the bytes around the numbers are taken from `codec.encode`.
"""

import numba as nb
import numpy as np

from fleet.bus.codec import encode
from fleet.contract import COLUMNS, ROW_WIDTHS, Sample

Packed = tuple[int, bytes, float]
"""Number of the aircraft, bytes of its `Sample`, the sample's time [s since 1970]."""
FIELDS = tuple(COLUMNS)
MAX_ROWS = 2_000  # maximum rows of one field in one message
WIDTHS = np.array([len(COLUMNS[field]) for field in FIELDS])
WIDEST = np.array([ROW_WIDTHS[field][-1] for field in FIELDS])  # with the extra columns
_INTEGER_FIELDS = {"position", "leg", "target", "gnss"}  # integer fields, <i4; all others are <f4
IS_INTEGER = np.array([field in _INTEGER_FIELDS for field in FIELDS])
_MAX_FIELD_HEADER = 160  # upper limit of the bytes of a field without its numbers
_MAX_ABSENT = 24  # the same of a field without rows


def _concatenated(*parts: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Concatenate byte strings: bytes, and start of each."""
    return np.frombuffer(b"".join(parts), np.uint8), np.cumsum([0, *map(len, parts)])


_EMPTY_SAMPLE = encode(Sample(uav=0, t=0.0))
_FIELD_NAMES = _concatenated(*(encode(field) for field in FIELDS))
_PREFIX = np.frombuffer(_EMPTY_SAMPLE[: _EMPTY_SAMPLE.index(b"\xa3uav") + 4], np.uint8)
_T = encode("t")
_FRAGMENTS = _concatenated(
    _T + b"\xcb",  # 0: time
    b"\x82" + _T + b"\x83" + encode("dtype") + encode("<f8") + encode("shape") + b"\x91",  # 1: times of rows
    encode("data"),  # 2: before any bytes
    encode("x") + b"\x83" + encode("dtype") + encode("<f4") + encode("shape") + b"\x92",  # 3: values of rows
    encode("x") + b"\x83" + encode("dtype") + encode("<i4") + encode("shape") + b"\x92",  # 4: the same, integers
)


@nb.njit(cache=True, nogil=True)
def _copy_bytes(out, at, source, start, stop):
    dest, start, n = nb.uint64(at), nb.uint64(start), nb.uint64(stop - start)  # unsigned indices: twice as fast
    for i in range(n):
        out[dest + i] = source[start + i]
    return at + stop - start


@nb.njit(cache=True, nogil=True)
def _write_uint(out, at, value):
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
def _write_bin_header(out, at, size):
    if size < 0x100:
        out[at], out[at + 1] = 0xC4, size
        return at + 2
    out[at], out[at + 1], out[at + 2] = 0xC5, size >> 8, size & 0xFF
    return at + 3


@nb.njit(cache=True, nogil=True)
def _write_field(out, at, times, rows, values, columns, is_integer, fragments, offsets):
    """Write the rows of one field: times (n,), positions in `values` (n,)."""
    n = len(times)
    as_double, as_float, as_int = np.empty(1), np.empty(1, np.float32), np.empty(1, np.int32)
    double_bytes, float_bytes, int_bytes = as_double.view(np.uint8), as_float.view(np.uint8), as_int.view(np.uint8)
    at = _write_uint(out, _copy_bytes(out, at, fragments, offsets[1], offsets[2]), n)
    at = _write_bin_header(out, _copy_bytes(out, at, fragments, offsets[2], offsets[3]), 8 * n)
    for i in range(n):
        as_double[0] = times[i]
        at = _copy_bytes(out, at, double_bytes, 0, 8)
    values_at = 4 if is_integer else 3
    at = _copy_bytes(out, at, fragments, offsets[values_at], offsets[values_at + 1])
    at = _write_uint(out, _write_uint(out, at, n), columns)
    at = _write_bin_header(out, _copy_bytes(out, at, fragments, offsets[2], offsets[3]), 4 * columns * n)
    for i in range(n):
        for k in range(columns):
            if is_integer:
                as_int[0] = np.int32(values[rows[i] + k])
                at = _copy_bytes(out, at, int_bytes, 0, 4)
            else:
                as_float[0] = values[rows[i] + k]
                at = _copy_bytes(out, at, float_bytes, 0, 4)
    return at


@nb.njit(cache=True, nogil=True)
def _used_width(rows, values, width, widest):
    """Return the columns of the field in these rows: the widest form if an extra column is not 0."""
    for at in rows:
        for k in range(width, widest):
            if values[at + k] != 0.0:
                return widest
    return width


@nb.njit(cache=True, nogil=True)
def _write_samples(
    out,
    uavs,
    start,
    stop,
    t,
    values,
    positions,
    widths,
    widest,
    is_integer,
    prefix,
    names,
    name_offsets,
    fragments,
    offsets,
):
    """Write a sample for every aircraft with rows; return owners, end of each in `out`, and sample times."""
    owners, ends, at = np.empty(len(start), np.int64), np.empty(len(start), np.int64), 0
    sample_t = np.empty(len(start))
    newest = np.empty(1)
    time_bytes, n = newest.view(np.uint8), 0
    for owner in range(len(start)):
        newest[0] = -np.inf
        for field in range(len(widths)):
            if start[owner, field] < stop[owner, field]:
                newest[0] = max(newest[0], t[stop[owner, field] - 1])
        if newest[0] == -np.inf:
            continue
        at = _write_uint(out, _copy_bytes(out, at, prefix, 0, len(prefix)), uavs[owner])
        at = _copy_bytes(out, at, fragments, offsets[0], offsets[1])
        for k in range(8):
            out[at + k] = time_bytes[7 - k]
        at += 8
        for field in range(len(widths)):
            at = _copy_bytes(out, at, names, name_offsets[field], name_offsets[field + 1])
            first, end = start[owner, field], stop[owner, field]
            if first < end:
                rows = positions[first:end]
                columns = _used_width(rows, values, widths[field], widest[field])
                at = _write_field(out, at, t[first:end], rows, values, columns, is_integer[field], fragments, offsets)
            else:
                out[at] = 0xC0
                at += 1
        owners[n], ends[n], sample_t[n] = owner, at, newest[0]
        n += 1
    return owners[:n], ends[:n], sample_t[:n]


@nb.njit(cache=True, nogil=True)
def _max_size(start, stop, widths):
    """Return an upper limit of the bytes of all samples."""
    size = 0
    for owner in range(len(start)):
        has_rows = False
        for field in range(len(widths)):
            rows = stop[owner, field] - start[owner, field]
            size += rows * (8 + 4 * widths[field]) + (_MAX_FIELD_HEADER - _MAX_ABSENT if rows > 0 else 0)
            has_rows = has_rows or rows > 0
        if has_rows:
            size += 64 + _MAX_ABSENT * len(widths)
    return size


def pack_samples(
    uavs: np.ndarray, start: np.ndarray, stop: np.ndarray, t: np.ndarray, values: np.ndarray, *, at: np.ndarray
) -> list[Packed]:
    """Encode the rows of all aircraft that have rows.

    Args:
        uavs: UAV ids, (m,)
        start, stop: row range of each aircraft and field, at most `MAX_ROWS`, (m, fields)
        t: fleet times, increasing within a field, (n,) [s since 1970]
        values: numbers of all rows, (k,)
        at: position of each row's `WIDEST` values in them, (n,)
    """
    out = np.empty(_max_size(start, stop, WIDEST), np.uint8)
    owners, ends, sample_t = _write_samples(
        out, uavs, start, stop, t, values, at, WIDTHS, WIDEST, IS_INTEGER, _PREFIX, *_FIELD_NAMES, *_FRAGMENTS
    )
    payload, stops = out[: ends[-1]].tobytes() if len(ends) else b"", ends.tolist()
    entries = zip(owners.tolist(), [0, *stops][:-1], stops, sample_t.tolist(), strict=True)
    return [(owner, payload[start:stop], t) for owner, start, stop, t in entries]
