"""Decode the `History` message of one aircraft in compiled code, which releases the GIL for the other threads.

`scan` walks the bytes and finds the position of the rows of each kind. Rows whose shape does not match their byte
count are skipped.
"""

from struct import unpack_from

import numpy as np

from fleet.contract import COLUMNS, DTYPES, Array, Rows, Sample
from fleet.physics.kernel import bare, kernel

PLAIN, WORD, BYTES, LIST, MAP, BAD = range(6)  # msgpack kinds
DTYPE, DIMENSIONS, LONG, WIDE, AT, SIZE = range(6)  # of one array: two sizes, offset, byte count
_LEAST, _MOST = 40, 1 << 31  # minimum bytes of the rows of one kind; maximum number of rows
_DOUBLE = 0xCB
_PARTS = (tuple(COLUMNS), ("uav", "t", "samples"), ("t", "x"), ("dtype", "shape", "data"), DTYPES)
TOP, ROWS, ARRAY, DTYPE_NAMES = np.cumsum([len(names) for names in _PARTS])[:-1].tolist()  # start of each group
_F8 = DTYPES.index("<f8")


def _names() -> np.ndarray:
    """Return all names as rows of bytes, (n, longest + 1) u1, with the length first."""
    names = [name.encode() for part in _PARTS for name in part]
    out = np.zeros((len(names), 1 + max(map(len, names))), np.uint8)
    for row, name in zip(out, names, strict=True):
        row[0], row[1 : 1 + len(name)] = len(name), list(name)
    return out


def _heads() -> np.ndarray:
    """Return for each first byte from 0xC0 on: kind, bytes of the next number, whether it is a count."""
    out = np.full((64, 3), (PLAIN, 0, 0), np.int64)
    out[0x01] = out[0x07:0x0A] = (BAD, 0, 0)  # unused byte; extension types
    out[0x14:0x19] = (BAD, 0, 0)
    for first, what, sizes, counts in (
        (0x04, BYTES, (1, 2, 4), 1),
        (0x0A, PLAIN, (4, 8), 0),
        (0x0C, PLAIN, (1, 2, 4, 8), 1),
        (0x10, PLAIN, (1, 2, 4, 8), 0),
        (0x19, WORD, (1, 2, 4), 1),
        (0x1C, LIST, (2, 4), 1),
        (0x1E, MAP, (2, 4), 1),
    ):
        for k, size in enumerate(sizes):
            out[first + k] = (what, size, counts)
    return out


_NAMES, _HEADS = _names(), _heads()
_WIDTHS = np.array([len(columns) for columns in COLUMNS.values()])
_SIZES = np.array([np.dtype(name).itemsize for name in DTYPES])


@bare
def number(b: np.ndarray, i: int, n: int) -> int:
    """Read an unsigned big-endian integer of n bytes."""
    out = 0
    for k in range(n):
        out = (out << 8) | int(b[i + k])
    return out


@bare
def head(b: np.ndarray, i: int) -> tuple[int, int, int]:
    """Read the header at i; return kind, its size (bytes, items or pairs) or integer value, and the next index."""
    if i < 0 or i >= len(b) - 9:  # a number has at most nine bytes
        return BAD, 0, i
    c = int(b[i])
    i += 1
    if c <= 0x7F:
        return PLAIN, c, i
    if c <= 0x8F:
        return MAP, c & 0x0F, i
    if c <= 0x9F:
        return LIST, c & 0x0F, i
    if c <= 0xBF:
        return WORD, c & 0x1F, i
    k = _HEADS[c - 0xC0, 0]
    n = _HEADS[c - 0xC0, 1]
    return k, number(b, i, n) if _HEADS[c - 0xC0, 2] else -1, i + n


@bare
def leap(b: np.ndarray, i: int) -> int:
    """Return the index after the value at i; negative if it is invalid."""
    left = 1
    while left > 0:
        kind, n, i = head(b, i)
        if kind == BAD or (kind != PLAIN and n > len(b)):
            return -1
        left -= 1
        if kind in (WORD, BYTES):
            i += n
        elif kind == LIST:
            left += n
        elif kind == MAP:
            left += 2 * n
    return i


@bare
def named(b: np.ndarray, i: int, first: int, last: int) -> tuple[int, int]:
    """Read a key; return its index among the names first to last or -1, and the next index, negative if invalid."""
    kind, n, i = head(b, i)
    if kind != WORD or i + n > len(b):
        return -1, -1
    for k in range(first, last):
        if n == _NAMES[k, 0]:
            j = 0
            while j < n and b[i + j] == _NAMES[k, 1 + j]:
                j += 1
            if j == n:
                return k - first, i + n
    return -1, i + n


@bare
def array(b: np.ndarray, i: int, got: np.ndarray, row: int) -> int:
    """Read an array header into a row of `layout`, (2, 6); return the next index, negative if invalid."""
    got[row, DTYPE], got[row, DIMENSIONS], got[row, SIZE] = -1, 0, -1
    kind, pairs, i = head(b, i)
    if kind != MAP:
        return -1
    for _ in range(pairs):
        key, begin = named(b, i, ARRAY, DTYPE_NAMES)
        kind, n, i = head(b, begin)
        if key == 0 and kind == WORD:
            got[row, DTYPE], i = named(b, begin, DTYPE_NAMES, len(_NAMES))
        elif key == 1 and kind == LIST and n <= 2:
            got[row, DIMENSIONS] = n
            for k in range(n):
                kind, got[row, LONG + k], i = head(b, i)
                if kind != PLAIN:
                    return -1
        elif key == 2 and kind == BYTES and i + n <= len(b):
            got[row, AT], got[row, SIZE] = i, n
            i += n
        else:
            i = leap(b, begin)
        if i < 0:
            return -1
    return i


@bare
def rows_at(b: np.ndarray, i: int, got: np.ndarray) -> int:
    """Read the rows of one kind: array `t` into layout[0] and `x` into layout[1]; return the next index."""
    got[0, SIZE] = got[1, SIZE] = -1
    kind, pairs, after = head(b, i)
    if kind == PLAIN:
        return after
    if kind != MAP:
        return -1
    i = after
    for _ in range(pairs):
        key, i = named(b, i, ROWS, ARRAY)
        i = array(b, i, got, key) if key >= 0 else leap(b, i)
        if i < 0:
            return -1
    return i


@bare
def whole(got: np.ndarray, kind: int) -> bool:
    """Return whether the shapes of the rows match their byte counts."""
    n, dtype = got[0, LONG], got[1, DTYPE]
    if got[0, SIZE] < 0 or got[1, SIZE] < 0 or got[0, DIMENSIONS] != 1 or got[1, DIMENSIONS] != 2 or dtype < 0:
        return False
    if got[0, DTYPE] != _F8 or not 0 < n < _MOST or got[1, LONG] != n or got[1, WIDE] != _WIDTHS[kind]:
        return False
    return got[0, SIZE] == 8 * n and got[1, SIZE] == n * _WIDTHS[kind] * _SIZES[dtype]


@bare
def sample(b: np.ndarray, i: int, got: np.ndarray, found: np.ndarray, n: int) -> tuple[int, int]:
    """Find the rows in one sample; return the number of entries and the next index."""
    what, pairs, i = head(b, i)
    if what != MAP:
        return n, -1
    for _ in range(pairs):
        kind, i = named(b, i, 0, TOP)
        i = rows_at(b, i, got) if kind >= 0 else leap(b, i)
        if i < 0 or n >= len(found):
            return n, -1
        if kind >= 0 and whole(got, kind):
            found[n, 0], found[n, 1], found[n, 2] = kind, got[0, LONG], got[0, AT]
            found[n, 3], found[n, 4], found[n, 5] = got[1, AT], got[1, SIZE], got[1, DTYPE]
            n += 1
    return n, i


@bare
def scan(b: np.ndarray, got: np.ndarray, found: np.ndarray) -> tuple[int, int, int]:
    """Find all rows; return the number of entries (negative: invalid), the UAV id, and the offset of the time.

    Args:
        b: bytes, and nine more at the end
        layout: (2, 6), scratch
        entries: output, one row an entry: kind, row count, offsets of times and values, bytes of the values, dtype
    """
    uav, t, n = -1, -1, 0
    what, pairs, i = head(b, 0)
    if what != MAP:
        return -1, uav, t
    for _ in range(pairs):
        key, begin = named(b, i, TOP, ROWS)
        what, items, i = head(b, begin)
        if key == 2 and what == LIST:
            for _ in range(items):
                n, i = sample(b, i, got, found, n)
                if i < 0:
                    return -1, uav, t
            continue
        if key == 0 and what == PLAIN:
            uav = items
        elif key == 1 and what == PLAIN and b[begin] == _DOUBLE:
            t = begin + 1
        i = leap(b, begin)
        if i < 0:
            return -1, uav, t
    return n, uav, t


@kernel
def put_together(b: np.ndarray, at: np.ndarray, size: np.ndarray, out: np.ndarray) -> None:
    """Concatenate byte ranges."""
    k = 0
    for j in range(len(at)):
        out[k : k + size[j]] = b[at[j] : at[j] + size[j]]
        k += size[j]


def read(payload: bytes) -> Sample | None:
    """Decode a `History` into one sample with all its rows; rows with another dtype than the newest are skipped.

    Returns:
        None if it is invalid or empty.
    """
    b = np.frombuffer(payload + bytes(9), np.uint8)
    found = np.empty((len(b) // _LEAST + 1, 6), np.int64)
    n, uav, at = scan(b, np.empty((2, 6), np.int64), found)  # type: ignore[call-arg]
    if n <= 0 or uav < 0 or at < 0:
        return None
    kinds = {name: _rows(b, mine) for k, name in enumerate(COLUMNS) if len(mine := found[:n][found[:n, 0] == k])}
    return Sample(uav=uav, t=unpack_from(">d", payload, at)[0], **kinds)


def _rows(b: np.ndarray, found: np.ndarray) -> Rows:
    """Join the entries that have the newest entry's dtype."""
    kind, dtype = found[-1, 0], found[-1, 5]
    rows, t_at, x_at, x_size = np.ascontiguousarray(found[found[:, 5] == dtype, 1:5].T)  # contiguous if single
    n = int(rows.sum())
    t, x = np.empty(8 * n, np.uint8), np.empty(int(x_size.sum()), np.uint8)
    put_together(b, t_at, 8 * rows, t)  # type: ignore[call-arg]
    put_together(b, x_at, x_size, x)  # type: ignore[call-arg]
    return Rows(t=Array("<f8", (n,), t.tobytes()), x=Array(DTYPES[dtype], (n, int(_WIDTHS[kind])), x.tobytes()))
