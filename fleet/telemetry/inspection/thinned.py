"""Rows of one field in bounded memory: decimated rows, and statistics of all intervals."""

from heapq import nlargest
from typing import NamedTuple

import numpy as np

from fleet.window import MAX_GAP_S, longest_gap

MAX_ROWS = 200_000  # stored rows of one field [-]
_BLOCK_ROWS = 4_096  # rows processed at once
_MAX_WIDE_INTERVALS = 1_000  # wide intervals stored with their start
_MIN_STRETCH_S = 1.0  # shorter continuous stretches are ignored [s]
_BINS, _PER_DECADE, _LOWEST_DECADE = 180, 20, -5  # interval histogram: 10 us to 10,000 s


class TimeInterval(NamedTuple):
    """A time interval [s since 1970]."""

    start: float
    stop: float

    @property
    def seconds(self) -> float:
        """Return the length [s]."""
        return self.stop - self.start


class DecimatedRows:
    """Store rows in order; beyond `max_rows`, halve the stored rows and double the stride.

    Args:
        max_interval_s: an interval longer than this ends a stretch, at usual rates [s]
        max_rows: maximum number of stored rows
        dtype: type of the stored values; positions need double precision
    """

    def __init__(self, max_interval_s: float, max_rows: int = MAX_ROWS, dtype: str = "<f4") -> None:
        self.max_interval_s, self.max_rows, self.dtype = max_interval_s, max_rows, dtype
        self._count, self._stride = 0, 1
        self._pending: list[tuple[np.ndarray, np.ndarray]] = []
        self._pending_count = 0
        self._stored: list[tuple[np.ndarray, np.ndarray]] = []
        self._newest_t = self._stretch_start = np.nan
        self._interval_counts, self._interval_seconds = np.zeros(_BINS), np.zeros(_BINS)
        self._wide_intervals: list[tuple[float, float]] = []  # (length, start)
        self._stretches: list[TimeInterval] = []

    def add(self, t: np.ndarray, x: np.ndarray) -> None:
        """Add rows: times (n,) [s since 1970] and values (n, k)."""
        self._pending.append((t, x))
        self._pending_count += len(t)
        if self._pending_count >= _BLOCK_ROWS:
            self._process_pending()

    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Return times and values of the stored rows, (m,) and (m, k)."""
        self._process_pending()
        if not self._stored:
            return np.zeros(0), np.zeros((0, 0), self.dtype)
        if len(self._stored) > 1:
            self._stored = [_joined(self._stored)]
        return self._stored[0]

    @property
    def count(self) -> int:
        """Return the number of rows added."""
        self._process_pending()
        return self._count

    @property
    def stride(self) -> int:
        """Return the decimation stride: one row in `stride` is stored."""
        self._process_pending()
        return self._stride

    @property
    def rate_hz(self) -> float:
        """Return rows per second outside gaps; 0 with fewer than two rows."""
        self._process_pending()
        usual = _edges() <= self._gap_s()
        seconds = float(self._interval_seconds[usual].sum())
        return float(self._interval_counts[usual].sum()) / seconds if seconds else 0.0

    def gaps(self) -> list[TimeInterval]:
        """Return at most 1,000 gaps in time order.

        A gap is longer than `max_interval_s` and than three times the median interval.
        """
        self._process_pending()
        limit = self._gap_s()
        return sorted(TimeInterval(start, start + length) for length, start in self._wide_intervals if length > limit)

    def stretches(self) -> list[TimeInterval]:
        """Return the stretches of at least 1 s without an interval that the twin does not fill."""
        self._process_pending()
        limit = self.longest_gap_s
        wide = sorted(TimeInterval(start, start + length) for length, start in self._wide_intervals if length > limit)
        stretches: list[TimeInterval] = []
        for span in [*self._stretches, TimeInterval(float(self._stretch_start), float(self._newest_t))]:
            inner = [gap for gap in wide if span.start <= gap.start and gap.stop <= span.stop]
            edges = [span.start, *(t for gap in inner for t in gap), span.stop]
            stretches += map(TimeInterval, edges[::2], edges[1::2])
        return [stretch for stretch in stretches if stretch.seconds >= _MIN_STRETCH_S]

    @property
    def longest_gap_s(self) -> float:
        """Return the longest interval that the twin fills at the rate of these rows [s]."""
        return longest_gap(self.max_interval_s, self._usual_interval_s())

    def _gap_s(self) -> float:
        """Return the interval above which there is a gap [s]."""
        return float(max(self.max_interval_s, 3 * self._usual_interval_s()))

    def _usual_interval_s(self) -> float:
        """Return the median interval, the upper edge of its bin [s]; 0 without intervals."""
        n = self._interval_counts.sum()
        return float(_edges()[np.searchsorted(np.cumsum(self._interval_counts), 0.5 * n)]) if n else 0.0

    def _process_pending(self) -> None:
        if not self._pending:
            return
        t, x = _joined(self._pending)
        self._pending, self._pending_count = [], 0
        good = np.isfinite(t) & np.isfinite(x).all(axis=1)
        t, x = t[good], x[good].astype(self.dtype)
        if not len(t):
            return
        if not self._count:
            self._newest_t = self._stretch_start = t[0]
        self._measure_intervals(t)
        self._store(t, x)
        self._newest_t = t[-1]

    def _measure_intervals(self, t: np.ndarray) -> None:
        """Add all intervals up to the last of these times to the statistics."""
        previous = np.concatenate([[self._newest_t], t[:-1]])
        dt = t - previous
        positive = dt[dt > 0]
        bin_index = np.clip(((np.log10(positive) - _LOWEST_DECADE) * _PER_DECADE).astype(int), 0, _BINS - 1)
        self._interval_counts += np.bincount(bin_index, minlength=_BINS)
        self._interval_seconds += np.bincount(bin_index, positive, minlength=_BINS)
        wide = np.flatnonzero(dt > self.max_interval_s)
        if len(wide):
            intervals = zip(dt[wide].tolist(), previous[wide].tolist(), strict=True)
            self._wide_intervals = nlargest(_MAX_WIDE_INTERVALS, [*self._wide_intervals, *intervals])
        breaks = np.flatnonzero((dt > max(self.max_interval_s, MAX_GAP_S)) | (dt < 0))
        starts = np.concatenate([[self._stretch_start], t[breaks]])
        long_enough = previous[breaks] - starts[:-1] >= _MIN_STRETCH_S
        self._stretches += map(TimeInterval, starts[:-1][long_enough].tolist(), previous[breaks][long_enough].tolist())
        self._stretch_start = starts[-1]

    def _store(self, t: np.ndarray, x: np.ndarray) -> None:
        selection = slice(-self._count % self._stride, None, self._stride)
        self._stored.append((t[selection].copy(), x[selection].copy()))  # a view would hold the full array in memory
        self._count += len(t)
        while sum(len(stored_t) for stored_t, _ in self._stored) > self.max_rows:
            t, x = _joined(self._stored)
            self._stored = [(t[::2].copy(), x[::2].copy())]
            self._stride *= 2


def _joined(parts: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    width = max(x.shape[1] for _, x in parts)  # a column that some parts do not have is 0 in them
    values = [x if x.shape[1] == width else np.pad(x, ((0, 0), (0, width - x.shape[1]))) for _, x in parts]
    return np.concatenate([t for t, _ in parts]), np.concatenate(values)


def _edges() -> np.ndarray:
    """Return the upper edge of each histogram bin, (n,) [s]."""
    return 10.0 ** (_LOWEST_DECADE + (np.arange(_BINS) + 1) / _PER_DECADE)


def overlap(first: list[TimeInterval], second: list[TimeInterval]) -> list[TimeInterval]:
    """Return the intersection of two lists of intervals, each in time order."""
    out, i, j = [], 0, 0
    while i < len(first) and j < len(second):
        common = TimeInterval(max(first[i].start, second[j].start), min(first[i].stop, second[j].stop))
        if common.seconds > 0:
            out.append(common)
        if first[i].stop < second[j].stop:
            i += 1
        else:
            j += 1
    return out


def inside(t: np.ndarray, spans: list[TimeInterval]) -> np.ndarray:
    """Return a mask of the times inside any interval, (n,) bool."""
    out = np.zeros(len(t), bool)
    for span in spans:
        out |= (t >= span.start) & (t <= span.stop)
    return out


def seconds(spans: list[TimeInterval]) -> float:
    """Return the total length [s]."""
    return float(sum(span.seconds for span in spans))
