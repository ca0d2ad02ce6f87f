"""Telemetry of one aircraft over the last minutes, as received."""

from struct import Struct

import numpy as np

from fleet.contract import COLUMNS, DTYPES, UNTOLD, Array, Rows, Sample
from twin_worker.telemetry.row_buffer import Kept

_AHEAD_S = 1.0  # rows further in the future of their message are rejected [s]
_MOST = 1e5  # larger values are invalid [m/s, rad, us, ...]
_MOST_OF = {"position": 2e9, "target": 2e9, "gnss": 2e9, "pressure": 1e6}  # exceptions [1e-7 deg, mm, Pa]
_WIDTHS = tuple((name, len(columns)) for name, columns in COLUMNS.items())
_SIZES = {name: np.dtype(name).itemsize for name in DTYPES}
_TIMES = tuple(Struct(f"<{n}d").unpack for n in range(17))  # by number of rows; faster than an array


class History:
    """Buffer rows of every kind over the last `keep_s` seconds; reading sorts rows and drops duplicates."""

    def __init__(self, keep_s: float = 160.0) -> None:
        self.keep_s = keep_s
        self.newest = -np.inf
        self._kept: dict[str, Kept] = {}

    def add(self, sample: Sample) -> int:
        """Add one message; return how many of its kinds violate the contract."""
        bad, latest = 0, sample.t + _AHEAD_S
        for name, width in _WIDTHS:
            rows: Rows | None = getattr(sample, name)
            if rows is None:
                continue
            newest = _newest(rows.t, rows.x, width, latest)
            if newest:
                self._of(name, newest).hear(rows.t.data, rows.x.data, rows.x.dtype, self.newest - self.keep_s)
            else:
                bad += self._doubt(name, rows, latest)
        return bad

    def _doubt(self, name: str, rows: Rows, latest: float) -> bool:
        """Add the valid rows of a large or irregular batch; return whether some rows are invalid."""
        try:
            t, x = rows.t.numpy(), rows.x.numpy()
        except ValueError:
            return True
        if x.ndim != 2 or t.shape != x.shape[:1] or x.shape[1] != len(COLUMNS[name]) or not len(t):
            return True
        timed = (t <= latest) & (t > 0)  # false for nan; rows later than their message are inconsistent
        if timed.any():
            t, x = t[timed], x[timed]
            self._of(name, float(t.max())).add(t, x, self.newest - self.keep_s)
        return not timed.all()

    def _of(self, name: str, newest: float) -> Kept:
        """Return the buffer of a kind and record its newest row time."""
        if newest > self.newest:
            self.newest = newest
        kept = self._kept.get(name)
        if kept is None:
            kept = self._kept[name] = Kept(np.empty(0), np.empty((0, len(COLUMNS[name]))))
        return kept

    def rows(self, name: str, since: float = -np.inf) -> tuple[np.ndarray, np.ndarray]:
        """Return copies of times (n,) and values (n, k) of one kind from `since` on: valid, rising in time, unique."""
        t, x = self.look(name, since)
        return t.copy(), x.copy()

    def look(self, name: str, since: float = -np.inf) -> tuple[np.ndarray, np.ndarray]:
        """Return the same as read-only views, valid until the next message."""
        kept = self._kept.get(name)
        if kept is None:
            return np.empty(0), np.empty((0, len(COLUMNS[name])))
        kept.lay(self.newest - self.keep_s)
        if kept.settled < kept.n:
            kept.settle(_MOST_OF.get(name, _MOST), UNTOLD.get(name))
        t = kept.t[: kept.n]
        first = 0 if since == -np.inf else int(t.searchsorted(since))
        return t[first:], kept.x[first : kept.n]

    def put(self, name: str, t: np.ndarray, x: np.ndarray) -> None:
        """Replace all rows of one kind, (n,) and (n, k)."""
        self._kept[name] = Kept(np.array(t, float), np.array(x, float))

    def advance(self, before: float, by: float) -> None:
        """Shift rows before `before_t` [s since 1970] by `shift_s` [s], after a correction of their clock."""
        for kept in self._kept.values():
            kept.advance(before, by)
        self.newest = max((float(kept.t[: kept.n].max()) for kept in self._kept.values() if kept.n), default=-np.inf)

    def sound(self) -> bool:
        """Return whether every kind has its columns; compiled code does not check bounds."""
        widths = dict(_WIDTHS)
        kinds = self._kept.items() if isinstance(self._kept, dict) else [("", None)]
        return all(isinstance(kept, Kept) and kept.x.shape[1] == widths.get(name) for name, kept in kinds)

    def clear(self) -> None:
        """Remove all rows, for example after a clock jump."""
        self._kept.clear()
        self.newest = -np.inf


def _newest(t: Array, x: Array, width: int, latest: float) -> float:
    """Return the newest time of a small valid batch, none later than `max_t`; 0 for any other batch."""
    n = len(t.data) >> 3
    if not 0 < n < len(_TIMES) or t.dtype != "<f8" or t.shape != (n,) or x.shape != (n, width):
        return 0.0
    if len(t.data) != 8 * n or len(x.data) != n * width * _SIZES.get(x.dtype, 0):
        return 0.0
    times: tuple[float, ...] = _TIMES[n](t.data)
    for at in times:
        if not 0 < at <= latest:  # true for nan
            return 0.0
    return max(times)
