"""Decode the `History` message of one aircraft in compiled code, which releases the GIL for the other threads.

`scan` walks the bytes and finds the position of the rows of each kind. Rows whose shape does not match their byte
count are skipped.
"""

from struct import unpack_from

import numpy as np

from fleet.contract import COLUMNS, DTYPES, Array, Rows, Sample
from fleet.physics.kernel import kernel, no_alloc_kernel

SCALAR, TEXT, BYTES, LIST, MAP, INVALID = range(6)  # msgpack kinds
DTYPE, DIMENSIONS, LENGTH, WIDTH, OFFSET, SIZE = range(6)  # of one array: two sizes, offset, byte count
_MIN_ENTRY_BYTES, _MAX_ROWS = 40, 1 << 31  # minimum bytes of the rows of one kind; maximum number of rows
_DOUBLE = 0xCB
_NAME_GROUPS = (tuple(COLUMNS), ("uav", "t", "samples"), ("t", "x"), ("dtype", "shape", "data"), DTYPES)
TOP_KEYS, ROW_KEYS, ARRAY_KEYS, DTYPE_NAMES = np.cumsum([len(names) for names in _NAME_GROUPS])[
    :-1
].tolist()  # start of each group
_F8 = DTYPES.index("<f8")


def _name_table() -> np.ndarray:
    """Return all names as rows of bytes, (n, longest + 1) u1, with the length first."""
    names = [name.encode() for group in _NAME_GROUPS for name in group]
    out = np.zeros((len(names), 1 + max(map(len, names))), np.uint8)
    for row, name in zip(out, names, strict=True):
        row[0], row[1 : 1 + len(name)] = len(name), list(name)
    return out


def _header_table() -> np.ndarray:
    """Return for each first byte from 0xC0 on: kind, bytes of the next number, whether it is a count."""
    out = np.full((64, 3), (SCALAR, 0, 0), np.int64)
    out[0x01] = out[0x07:0x0A] = (INVALID, 0, 0)  # unused byte; extension types
    out[0x14:0x19] = (INVALID, 0, 0)
    for first, kind, sizes, counted in (
        (0x04, BYTES, (1, 2, 4), 1),
        (0x0A, SCALAR, (4, 8), 0),
        (0x0C, SCALAR, (1, 2, 4, 8), 1),
        (0x10, SCALAR, (1, 2, 4, 8), 0),
        (0x19, TEXT, (1, 2, 4), 1),
        (0x1C, LIST, (2, 4), 1),
        (0x1E, MAP, (2, 4), 1),
    ):
        for k, size in enumerate(sizes):
            out[first + k] = (kind, size, counted)
    return out


_NAMES, _HEADS = _name_table(), _header_table()
_WIDTHS = np.array([len(columns) for columns in COLUMNS.values()])
_SIZES = np.array([np.dtype(name).itemsize for name in DTYPES])


@no_alloc_kernel
def read_uint(b: np.ndarray, i: int, n: int) -> int:
    """Read an unsigned big-endian integer of n bytes."""
    out = 0
    for k in range(n):
        out = (out << 8) | int(b[i + k])
    return out


@no_alloc_kernel
def read_header(b: np.ndarray, i: int) -> tuple[int, int, int]:
    """Read the header at i; return kind, its size (bytes, items or pairs) or integer value, and the next index."""
    if i < 0 or i >= len(b) - 9:  # a number has at most nine bytes
        return INVALID, 0, i
    c = int(b[i])
    i += 1
    if c <= 0x7F:
        return SCALAR, c, i
    if c <= 0x8F:
        return MAP, c & 0x0F, i
    if c <= 0x9F:
        return LIST, c & 0x0F, i
    if c <= 0xBF:
        return TEXT, c & 0x1F, i
    k = _HEADS[c - 0xC0, 0]
    n = _HEADS[c - 0xC0, 1]
    return k, read_uint(b, i, n) if _HEADS[c - 0xC0, 2] else -1, i + n


@no_alloc_kernel
def skip_value(b: np.ndarray, i: int) -> int:
    """Return the index after the value at i; negative if it is invalid."""
    remaining = 1
    while remaining > 0:
        kind, n, i = read_header(b, i)
        if kind == INVALID or (kind != SCALAR and n > len(b)):
            return -1
        remaining -= 1
        if kind in (TEXT, BYTES):
            i += n
        elif kind == LIST:
            remaining += n
        elif kind == MAP:
            remaining += 2 * n
    return i


@no_alloc_kernel
def read_key(b: np.ndarray, i: int, first: int, last: int) -> tuple[int, int]:
    """Read a key; return its index among the names first to last or -1, and the next index, negative if invalid."""
    kind, n, i = read_header(b, i)
    if kind != TEXT or i + n > len(b):
        return -1, -1
    for k in range(first, last):
        if n == _NAMES[k, 0]:
            j = 0
            while j < n and b[i + j] == _NAMES[k, 1 + j]:
                j += 1
            if j == n:
                return k - first, i + n
    return -1, i + n


@no_alloc_kernel
def read_array(b: np.ndarray, i: int, layout: np.ndarray, row: int) -> int:
    """Read an array header into a row of `layout`, (2, 6); return the next index, negative if invalid."""
    layout[row, DTYPE], layout[row, DIMENSIONS], layout[row, SIZE] = -1, 0, -1
    kind, pairs, i = read_header(b, i)
    if kind != MAP:
        return -1
    for _ in range(pairs):
        key, start = read_key(b, i, ARRAY_KEYS, DTYPE_NAMES)
        kind, n, i = read_header(b, start)
        if key == 0 and kind == TEXT:
            layout[row, DTYPE], i = read_key(b, start, DTYPE_NAMES, len(_NAMES))
        elif key == 1 and kind == LIST and n <= 2:
            layout[row, DIMENSIONS] = n
            for k in range(n):
                kind, layout[row, LENGTH + k], i = read_header(b, i)
                if kind != SCALAR:
                    return -1
        elif key == 2 and kind == BYTES and i + n <= len(b):
            layout[row, OFFSET], layout[row, SIZE] = i, n
            i += n
        else:
            i = skip_value(b, start)
        if i < 0:
            return -1
    return i


@no_alloc_kernel
def read_rows(b: np.ndarray, i: int, layout: np.ndarray) -> int:
    """Read the rows of one kind: array `t` into layout[0] and `x` into layout[1]; return the next index."""
    layout[0, SIZE] = layout[1, SIZE] = -1
    kind, pairs, after = read_header(b, i)
    if kind == SCALAR:
        return after
    if kind != MAP:
        return -1
    i = after
    for _ in range(pairs):
        key, i = read_key(b, i, ROW_KEYS, ARRAY_KEYS)
        i = read_array(b, i, layout, key) if key >= 0 else skip_value(b, i)
        if i < 0:
            return -1
    return i


@no_alloc_kernel
def is_consistent(layout: np.ndarray, kind: int) -> bool:
    """Return whether the shapes of the rows match their byte counts."""
    n, dtype = layout[0, LENGTH], layout[1, DTYPE]
    if (
        layout[0, SIZE] < 0
        or layout[1, SIZE] < 0
        or layout[0, DIMENSIONS] != 1
        or layout[1, DIMENSIONS] != 2
        or dtype < 0
    ):
        return False
    if layout[0, DTYPE] != _F8 or not 0 < n < _MAX_ROWS or layout[1, LENGTH] != n or layout[1, WIDTH] != _WIDTHS[kind]:
        return False
    return layout[0, SIZE] == 8 * n and layout[1, SIZE] == n * _WIDTHS[kind] * _SIZES[dtype]


@no_alloc_kernel
def scan_sample(b: np.ndarray, i: int, layout: np.ndarray, entries: np.ndarray, n: int) -> tuple[int, int]:
    """Find the rows in one sample; return the number of entries and the next index."""
    tag, pairs, i = read_header(b, i)
    if tag != MAP:
        return n, -1
    for _ in range(pairs):
        kind, i = read_key(b, i, 0, TOP_KEYS)
        i = read_rows(b, i, layout) if kind >= 0 else skip_value(b, i)
        if i < 0 or n >= len(entries):
            return n, -1
        if kind >= 0 and is_consistent(layout, kind):
            entries[n, 0], entries[n, 1], entries[n, 2] = kind, layout[0, LENGTH], layout[0, OFFSET]
            entries[n, 3], entries[n, 4], entries[n, 5] = layout[1, OFFSET], layout[1, SIZE], layout[1, DTYPE]
            n += 1
    return n, i


@no_alloc_kernel
def scan(b: np.ndarray, layout: np.ndarray, entries: np.ndarray) -> tuple[int, int, int]:
    """Find all rows; return the number of entries (negative: invalid), the UAV id, and the offset of the time.

    Args:
        b: bytes, and nine more at the end
        layout: (2, 6), scratch
        entries: output, one row an entry: kind, row count, offsets of times and values, bytes of the values, dtype
    """
    uav, t, n = -1, -1, 0
    tag, pairs, i = read_header(b, 0)
    if tag != MAP:
        return -1, uav, t
    for _ in range(pairs):
        key, start = read_key(b, i, TOP_KEYS, ROW_KEYS)
        tag, items, i = read_header(b, start)
        if key == 2 and tag == LIST:
            for _ in range(items):
                n, i = scan_sample(b, i, layout, entries, n)
                if i < 0:
                    return -1, uav, t
            continue
        if key == 0 and tag == SCALAR:
            uav = items
        elif key == 1 and tag == SCALAR and b[start] == _DOUBLE:
            t = start + 1
        i = skip_value(b, start)
        if i < 0:
            return -1, uav, t
    return n, uav, t


@kernel
def concatenate(b: np.ndarray, offset: np.ndarray, size: np.ndarray, out: np.ndarray) -> None:
    """Concatenate byte ranges."""
    k = 0
    for j in range(len(offset)):
        out[k : k + size[j]] = b[offset[j] : offset[j] + size[j]]
        k += size[j]


def decode_history(payload: bytes) -> Sample | None:
    """Decode a `History` into one sample with all its rows; rows with another dtype than the newest are skipped.

    Returns:
        None if it is invalid or empty.
    """
    b = np.frombuffer(payload + bytes(9), np.uint8)
    entries = np.empty((len(b) // _MIN_ENTRY_BYTES + 1, 6), np.int64)
    n, uav, t_offset = scan(b, np.empty((2, 6), np.int64), entries)  # type: ignore[call-arg]
    if n <= 0 or uav < 0 or t_offset < 0:
        return None
    kinds = {
        name: _join_rows(b, kind_entries)
        for k, name in enumerate(COLUMNS)
        if len(kind_entries := entries[:n][entries[:n, 0] == k])
    }
    return Sample(uav=uav, t=unpack_from(">d", payload, t_offset)[0], **kinds)


def _join_rows(b: np.ndarray, entries: np.ndarray) -> Rows:
    """Join the entries that have the newest entry's dtype."""
    kind, dtype = entries[-1, 0], entries[-1, 5]
    rows, t_at, x_at, x_size = np.ascontiguousarray(entries[entries[:, 5] == dtype, 1:5].T)  # contiguous if single
    n = int(rows.sum())
    t, x = np.empty(8 * n, np.uint8), np.empty(int(x_size.sum()), np.uint8)
    concatenate(b, t_at, 8 * rows, t)  # type: ignore[call-arg]
    concatenate(b, x_at, x_size, x)  # type: ignore[call-arg]
    return Rows(t=Array("<f8", (n,), t.tobytes()), x=Array(DTYPES[dtype], (n, int(_WIDTHS[kind])), x.tobytes()))
