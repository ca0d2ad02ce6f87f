"""Rows of one field in bounded memory: decimated rows, and statistics of all intervals."""

from heapq import nlargest
from typing import NamedTuple

import numpy as np

MOST = 200_000  # stored rows of one field [-]
_BLOCK = 4_096  # rows processed at once
_WIDEST = 1_000  # wide intervals stored with their start
_SHORTEST_S = 1.0  # shorter continuous stretches are ignored [s]
_BINS, _PER_DECADE, _LOWEST = 180, 20, -5  # interval histogram: 10 us to 10,000 s


class Span(NamedTuple):
    """A time interval [s since 1970]."""

    start: float
    stop: float

    @property
    def seconds(self) -> float:
        """Return the length [s]."""
        return self.stop - self.start


class Thinned:
    """Store rows in order; beyond `max_rows`, halve the stored rows and double the stride.

    Args:
        max_interval_s: an interval longer than this ends a stretch [s]
        max_rows: maximum number of stored rows
        dtype: type of the stored values; positions need double precision
    """

    def __init__(self, longest: float, most: int = MOST, dtype: str = "<f4") -> None:
        self.longest, self.most, self.dtype = longest, most, dtype
        self._count, self._stride = 0, 1
        self._pending: list[tuple[np.ndarray, np.ndarray]] = []
        self._waiting = 0
        self._kept: list[tuple[np.ndarray, np.ndarray]] = []
        self._last = self._open = np.nan
        self._intervals, self._seconds = np.zeros(_BINS), np.zeros(_BINS)
        self._wide: list[tuple[float, float]] = []  # (length, start)
        self._stretches: list[Span] = []

    def add(self, t: np.ndarray, x: np.ndarray) -> None:
        """Add rows: times (n,) [s since 1970] and values (n, k)."""
        self._pending.append((t, x))
        self._waiting += len(t)
        if self._waiting >= _BLOCK:
            self._settle()

    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Return times and values of the stored rows, (m,) and (m, k)."""
        self._settle()
        if not self._kept:
            return np.zeros(0), np.zeros((0, 0), self.dtype)
        if len(self._kept) > 1:
            self._kept = [(np.concatenate([t for t, _ in self._kept]), np.concatenate([x for _, x in self._kept]))]
        return self._kept[0]

    @property
    def count(self) -> int:
        """Return the number of rows added."""
        self._settle()
        return self._count

    @property
    def stride(self) -> int:
        """Return the decimation stride: one row in `stride` is stored."""
        self._settle()
        return self._stride

    @property
    def rate_hz(self) -> float:
        """Return rows per second outside gaps; 0 with fewer than two rows."""
        self._settle()
        usual = _edges() <= self._gap_s()
        seconds = float(self._seconds[usual].sum())
        return float(self._intervals[usual].sum()) / seconds if seconds else 0.0

    def gaps(self) -> list[Span]:
        """Return at most 1,000 gaps in time order.

        A gap is longer than `max_interval_s` and than three times the median interval.
        """
        self._settle()
        limit = self._gap_s()
        return sorted(Span(start, start + length) for length, start in self._wide if length > limit)

    def stretches(self) -> list[Span]:
        """Return the stretches of at least 1 s without an interval longer than `max_interval_s`."""
        self._settle()
        last = Span(float(self._open), float(self._last))
        return [*self._stretches, last] if last.seconds >= _SHORTEST_S else list(self._stretches)

    def _gap_s(self) -> float:
        """Return the interval above which there is a gap [s]."""
        n = self._intervals.sum()
        usual = _edges()[np.searchsorted(np.cumsum(self._intervals), 0.5 * n)] if n else 0.0
        return float(max(self.longest, 3 * usual))

    def _settle(self) -> None:
        if not self._pending:
            return
        t = np.concatenate([t for t, _ in self._pending])
        x = np.concatenate([x for _, x in self._pending])
        self._pending, self._waiting = [], 0
        good = np.isfinite(t) & np.isfinite(x).all(axis=1)
        t, x = t[good], x[good].astype(self.dtype)
        if not len(t):
            return
        if not self._count:
            self._last = self._open = t[0]
        self._look(t)
        self._keep(t, x)
        self._last = t[-1]

    def _look(self, t: np.ndarray) -> None:
        """Add all intervals up to the last of these times to the statistics."""
        before = np.concatenate([[self._last], t[:-1]])
        dt = t - before
        real = dt[dt > 0]
        place = np.clip(((np.log10(real) - _LOWEST) * _PER_DECADE).astype(int), 0, _BINS - 1)
        self._intervals += np.bincount(place, minlength=_BINS)
        self._seconds += np.bincount(place, real, minlength=_BINS)
        wide = np.flatnonzero(dt > self.longest)
        if len(wide):
            found = zip(dt[wide].tolist(), before[wide].tolist(), strict=True)
            self._wide = nlargest(_WIDEST, [*self._wide, *found])
        broken = np.flatnonzero((dt > self.longest) | (dt < 0))
        starts = np.concatenate([[self._open], t[broken]])
        long = before[broken] - starts[:-1] >= _SHORTEST_S
        self._stretches += map(Span, starts[:-1][long].tolist(), before[broken][long].tolist())
        self._open = starts[-1]

    def _keep(self, t: np.ndarray, x: np.ndarray) -> None:
        taken = slice(-self._count % self._stride, None, self._stride)
        self._kept.append((t[taken].copy(), x[taken].copy()))  # a view would hold the full array in memory
        self._count += len(t)
        while sum(len(kept) for kept, _ in self._kept) > self.most:
            whole_t, whole_x = (np.concatenate([pair[i] for pair in self._kept]) for i in (0, 1))
            self._kept = [(whole_t[::2].copy(), whole_x[::2].copy())]
            self._stride *= 2


def _edges() -> np.ndarray:
    """Return the upper edge of each histogram bin, (n,) [s]."""
    return 10.0 ** (_LOWEST + (np.arange(_BINS) + 1) / _PER_DECADE)


def overlap(one: list[Span], other: list[Span]) -> list[Span]:
    """Return the intersection of two lists of intervals, each in time order."""
    out, i, j = [], 0, 0
    while i < len(one) and j < len(other):
        both = Span(max(one[i].start, other[j].start), min(one[i].stop, other[j].stop))
        if both.seconds > 0:
            out.append(both)
        if one[i].stop < other[j].stop:
            i += 1
        else:
            j += 1
    return out


def inside(t: np.ndarray, spans: list[Span]) -> np.ndarray:
    """Return a mask of the times inside any interval, (n,) bool."""
    out = np.zeros(len(t), bool)
    for span in spans:
        out |= (t >= span.start) & (t <= span.stop)
    return out


def seconds(spans: list[Span]) -> float:
    """Return the total length [s]."""
    return float(sum(span.seconds for span in spans))
