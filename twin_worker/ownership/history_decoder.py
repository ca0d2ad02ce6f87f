"""The past of one aircraft as a gateway tells it, read by compiled code, so that the others do not wait meanwhile.

`scan` walks the bytes of a `History` and finds where the rows of each kind lie; nothing is believed that does not have
the shape and bytes it says.
"""

from struct import unpack_from

import numpy as np

from fleet.contract import COLUMNS, DTYPES, Array, Rows, Sample
from fleet.physics.kernel import bare, kernel

PLAIN, WORD, BYTES, LIST, MAP, BAD = range(6)  # what there is in msgpack
DTYPE, DIMENSIONS, LONG, WIDE, AT, SIZE = range(6)  # of one array: two sizes, where its bytes are, how many
_LEAST, _MOST = 40, 1 << 31  # bytes that rows of one kind take at least; rows
_DOUBLE = 0xCB
_PARTS = (tuple(COLUMNS), ("uav", "t", "samples"), ("t", "x"), ("dtype", "shape", "data"), DTYPES)
TOP, ROWS, ARRAY, DTYPE_NAMES = np.cumsum([len(names) for names in _PARTS])[:-1].tolist()  # where each part begins
_F8 = DTYPES.index("<f8")


def _names() -> np.ndarray:
    """Lay all names in rows of bytes, (n, longest + 1) u1: the length comes first."""
    names = [name.encode() for part in _PARTS for name in part]
    out = np.zeros((len(names), 1 + max(map(len, names))), np.uint8)
    for row, name in zip(out, names, strict=True):
        row[0], row[1 : 1 + len(name)] = len(name), list(name)
    return out


def _heads() -> np.ndarray:
    """Return for each first byte from 0xC0 on: what it begins, bytes of the number behind it, whether that counts."""
    out = np.full((64, 3), (PLAIN, 0, 0), np.int64)
    out[0x01] = out[0x07:0x0A] = (BAD, 0, 0)  # never used; strangers' own types
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
    """Read an unsigned big-endian number of n bytes."""
    out = 0
    for k in range(n):
        out = (out << 8) | int(b[i + k])
    return out


@bare
def head(b: np.ndarray, i: int) -> tuple[int, int, int]:
    """Read what begins at i: kind, then bytes, items, pairs or the value of a whole number, and where it goes on."""
    if i < 0 or i >= len(b) - 9:  # a number is of nine bytes at most
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
    """Return where it goes on after whatever begins at i; negative where that is broken."""
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
    """Read a key: which name from first to last it is, or -1 for another; and where it goes on, negative if nowhere."""
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
    """Read an array into a row of `got`, (2, 6); return where it goes on, negative where it is broken."""
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
    """Read the rows of one kind: array `t` into got[0] and `x` into got[1]; return where it goes on."""
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
    """Return whether rows have the shape and bytes they say."""
    n, dtype = got[0, LONG], got[1, DTYPE]
    if got[0, SIZE] < 0 or got[1, SIZE] < 0 or got[0, DIMENSIONS] != 1 or got[1, DIMENSIONS] != 2 or dtype < 0:
        return False
    if got[0, DTYPE] != _F8 or not 0 < n < _MOST or got[1, LONG] != n or got[1, WIDE] != _WIDTHS[kind]:
        return False
    return got[0, SIZE] == 8 * n and got[1, SIZE] == n * _WIDTHS[kind] * _SIZES[dtype]


@bare
def sample(b: np.ndarray, i: int, got: np.ndarray, found: np.ndarray, n: int) -> tuple[int, int]:
    """Find the rows in one sample; return how many finds there are now, and where it goes on."""
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
    """Find all rows; return how many finds there are (negative: it is broken), the UAV id, and where its time lies.

    Args:
        b: bytes, and nine more at the end
        got: (2, 6), written over
        found: filled, one row a find: kind, rows, where their times and values lie, bytes of these, kind of number
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
    """Copy stretches of bytes one behind the other."""
    k = 0
    for j in range(len(at)):
        out[k : k + size[j]] = b[at[j] : at[j] + size[j]]
        k += size[j]


def read(payload: bytes) -> Sample | None:
    """Read a `History` as one sample of all its rows; what does not fit the others is left out.

    Returns:
        None where it is broken, or holds nothing.
    """
    b = np.frombuffer(payload + bytes(9), np.uint8)
    found = np.empty((len(b) // _LEAST + 1, 6), np.int64)
    n, uav, at = scan(b, np.empty((2, 6), np.int64), found)  # type: ignore[call-arg]
    if n <= 0 or uav < 0 or at < 0:
        return None
    kinds = {name: _rows(b, mine) for k, name in enumerate(COLUMNS) if len(mine := found[:n][found[:n, 0] == k])}
    return Sample(uav=uav, t=unpack_from(">d", payload, at)[0], **kinds)


def _rows(b: np.ndarray, found: np.ndarray) -> Rows:
    """Put those together that are of the newest one's kind of number."""
    kind, dtype = found[-1, 0], found[-1, 5]
    rows, t_at, x_at, x_size = np.ascontiguousarray(found[found[:, 5] == dtype, 1:5].T)  # one find lies so by itself
    n = int(rows.sum())
    t, x = np.empty(8 * n, np.uint8), np.empty(int(x_size.sum()), np.uint8)
    put_together(b, t_at, 8 * rows, t)  # type: ignore[call-arg]
    put_together(b, x_at, x_size, x)  # type: ignore[call-arg]
    return Rows(t=Array("<f8", (n,), t.tobytes()), x=Array(DTYPES[dtype], (n, int(_WIDTHS[kind])), x.tobytes()))
