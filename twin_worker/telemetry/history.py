"""Telemetry of one aircraft over the last minutes, as received: row buffers and arrival delays."""

from collections.abc import Callable
from dataclasses import dataclass, field
from struct import Struct
from typing import Any

import numba as nb
import numpy as np

from fleet.contract import COLUMNS, DTYPES, FIRST_OPTIONAL_COLUMN, ROW_WIDTHS, Rows, Sample

_MIN_SPARE_ROWS = 40  # minimum spare capacity [rows]
_MAX_PENDING_ROWS = 256  # largest number of undecoded rows


class RowBuffer:
    """Buffer rows of one kind: times (n,) and values (n, k) float, with spare capacity; the newest rows are unsorted.

    Received rows stay bytes until reading, because decoding a few rows takes as long as decoding many.
    """

    def __init__(self, t: np.ndarray, x: np.ndarray) -> None:
        self.t, self.x = t, x
        self.n, self.n_sorted = len(t), 0  # number of rows, and of sorted rows
        self._pending_t: list[bytes] = []
        self._pending_x: list[bytes] = []
        self._pending_form, self._n_pending = ("", 0), 0  # type and columns of pending values; number of pending rows

    def add_bytes(self, t: bytes, x: bytes, form: tuple[str, int], since: float) -> None:
        """Append undecoded rows of checked length: times <f8, values of a type and columns; `since` as for `add`."""
        if form != self._pending_form or self._n_pending >= _MAX_PENDING_ROWS:
            self.flush(since)
            self._pending_form = form
        self._pending_t.append(t)
        self._pending_x.append(x)
        self._n_pending += len(t) >> 3

    def flush(self, since: float = -np.inf) -> None:
        """Decode pending rows."""
        if self._n_pending:
            t = np.frombuffer(b"".join(self._pending_t), "<f8")
            x = np.frombuffer(b"".join(self._pending_x), self._pending_form[0]).reshape(len(t), -1)
            self._pending_t, self._pending_x, self._n_pending = [], [], 0
            self.add(t, x, since)

    def add(self, t: np.ndarray, x: np.ndarray, since: float) -> None:
        """Append rows; if capacity is exhausted, drop rows before `since`. Columns that a row does not have are 0."""
        self.flush(since)
        width = self.x.shape[1]
        if x.shape[1] > width:
            self.x = np.pad(self.x[: self.n], ((0, len(self.t) - self.n), (0, x.shape[1] - width)))
        elif x.shape[1] < width:
            x = np.pad(x, ((0, 0), (0, width - x.shape[1])))
        end = self.n + len(t)
        if end > len(self.t):
            self._grow(len(t), since)
            end = self.n + len(t)
        self.t[self.n : end], self.x[self.n : end] = t, x
        self.n = end

    def _grow(self, n_new: int, since: float) -> None:
        recent = self.t[: self.n] >= since
        t, x = self.t[: self.n][recent], self.x[: self.n][recent]
        self.n_sorted = int(recent[: self.n_sorted].sum())
        self.n = len(t)
        size = self.n + n_new + max(self.n // 4, _MIN_SPARE_ROWS)
        self.t, self.x = np.empty(size), np.empty((size, self.x.shape[1]))
        self.t[: self.n], self.x[: self.n] = t, x

    def sort_new_rows(self, max_value: float, n_checked: int | None) -> None:
        """Sort new rows by time, drop duplicates (the first is kept) and invalid values."""
        n_checked = self.x.shape[1] if n_checked is None else n_checked
        if not _is_sorted(self.t[: self.n], self.x, (self.n_sorted, n_checked), max_value):
            valid = (np.abs(self.x[self.n_sorted : self.n, :n_checked]) < max_value).all(axis=1)  # false for nan
            keep = np.concatenate([np.ones(self.n_sorted, bool), valid])
            t, first = np.unique(self.t[: self.n][keep], return_index=True)
            self.x[: len(t)] = self.x[: self.n][keep][first]
            self.t[: len(t)] = t
            self.n = len(t)
        self.n_sorted = self.n

    def shift_times(self, before_t: float, shift_s: float) -> None:
        """Shift rows before `before_t` by `shift_s` [s]."""
        self.flush()
        t = self.t[: self.n]
        t[t < before_t] += shift_s
        self.n_sorted = 0  # later rows may overlap the shifted ones

    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Return all rows in order of arrival, (n,) and (n, k)."""
        self.flush()
        return self.t[: self.n], self.x[: self.n]


@nb.njit(cache=True, nogil=True, _nrt=False)  # type: ignore[call-overload]
def _is_sorted(t: np.ndarray, x: np.ndarray, bounds: tuple[int, int], max_value: float) -> bool:
    """Return whether rows from bounds[0] on rise in time and their first bounds[1] columns are valid, not nan."""
    for k in range(bounds[0], len(t)):
        if k > 0 and not t[k] > t[k - 1]:
            return False
        for i in range(bounds[1]):
            if not abs(x[k, i]) < max_value:
                return False
    return True


_TOLERATED_S = 0.5  # usual delay of a radio link; treated as zero [s]


@dataclass
class ArrivalDelay:
    """Estimate how far telemetry times are behind the gateway clock, from the order of arrival.

    Samples have aircraft time, status messages have gateway time. A sample of time t that arrives after a status of
    time G is delayed by at least G - t. The largest such bound between two status messages is the delay. The delay of
    a simulator that is paused or slower than real time is unbounded.

    Attributes:
        gateway_t: newest time of a status [s since 1970]
        bound: largest lower bound since that status [s]
        established: delay established at that status [s]
    """

    gateway_t: float = float("-inf")
    bound: float = float("-inf")
    established: float = 0.0

    @property
    def newest_sample_delay(self) -> float:
        """Return the delay of the newest sample [s]; 0 within the tolerance."""
        return _zero_if_tolerated(max(self.established, self.bound))

    def on_sample(self, newest: float, clock_jumped: bool) -> None:
        """Update with telemetry up to `newest` [s since 1970]; a clock jump discards earlier bounds."""
        bound = self.gateway_t - newest
        self.bound = bound if clock_jumped else max(self.bound, bound)
        self.established = 0.0 if clock_jumped else self.established

    def delay_at_status(self, t: float, newest: float) -> float:
        """Return the delay at a status of time `t` before `on_status`; the first status follows a sample."""
        if self.gateway_t == float("-inf"):
            return _zero_if_tolerated(t - newest)
        return self.established if self.bound == float("-inf") else _zero_if_tolerated(self.bound)

    def on_status(self, t: float, newest: float) -> None:
        """Update with a status of time `t` that follows telemetry up to `newest` [s since 1970]."""
        self.established = self.delay_at_status(t, newest)
        self.gateway_t, self.bound = max(t, self.gateway_t), float("-inf")


def _zero_if_tolerated(delay: float) -> float:
    return delay if _TOLERATED_S < delay < float("inf") else 0.0


FROZEN_S = 6.0  # time for which a sensor repeats one reading until it is frozen: in flight the last digit varies [s]
_MIN_FROZEN_ROWS = 5
_MAX_FUTURE_S = 1.0  # rows further in the future of their message are rejected [s]
_MAX_VALUE = 1e5  # larger values are invalid [m/s, rad, us, ...]
_MAX_VALUE_OF = {"position": 2e9, "target": 2e9, "gnss": 2e9, "pressure": 1e6}  # exceptions [1e-7 deg, mm, Pa]
# of batches of few rows: function that unpacks the times, bytes of times and values, type and columns of the values
_Layout = tuple[Callable[[bytes], tuple[Any, ...]], int, int, tuple[str, int]]
_NO_LAYOUT: _Layout = (Struct("").unpack, 0, 0, ("", 0))
_SMALL_BATCHES: dict[tuple[str, tuple[int, ...], str, tuple[int, ...]], _Layout] = {
    ("<f8", (n,), dtype, (n, width)): (
        Struct(f"<{n}d").unpack,  # faster than an array
        8 * n,
        n * width * np.dtype(dtype).itemsize,
        (dtype, width),
    )
    for n in range(1, 17)
    for dtype in DTYPES
    for width in sorted({width for widths in ROW_WIDTHS.values() for width in widths})
}


@dataclass(eq=False)
class TelemetryHistory:
    """Buffer rows of every kind over the last `keep_s` seconds; reading sorts rows and drops duplicates."""

    keep_s: float = 160.0
    newest: float = -np.inf
    _buffers: dict[str, RowBuffer] = field(default_factory=dict)

    def add(self, sample: Sample) -> int:
        """Add one message; return how many of its kinds violate the contract."""
        rejected, max_t = 0, sample.t + _MAX_FUTURE_S
        for name, widths in ROW_WIDTHS.items():
            rows: Rows | None = getattr(sample, name)
            if rows is None:
                continue
            t, x = rows.t, rows.x
            layout = _SMALL_BATCHES.get((t.dtype, t.shape, x.dtype, x.shape), _NO_LAYOUT)
            unpack, t_size, x_size, form = layout
            if form[1] not in widths or len(t.data) != t_size or len(x.data) != x_size:
                rejected += self._add_checked(name, rows, max_t)
                continue
            newest = 0.0
            for row_t in unpack(t.data):
                if not 0 < row_t <= max_t:  # true for nan
                    rejected += self._add_checked(name, rows, max_t)
                    break
                if row_t > newest:
                    newest = row_t
            else:
                self._buffer_of(name, newest).add_bytes(t.data, x.data, form, self.newest - self.keep_s)
        return rejected

    def _add_checked(self, name: str, rows: Rows, max_t: float) -> bool:
        """Add the valid rows of a large or irregular batch; return whether some rows are invalid."""
        try:
            t, x = rows.t.numpy(), rows.x.numpy()
        except ValueError:
            return True
        if x.ndim != 2 or t.shape != x.shape[:1] or x.shape[1] not in ROW_WIDTHS[name] or not len(t):
            return True
        valid = (t <= max_t) & (t > 0)  # false for nan; rows later than their message are inconsistent
        if valid.any():
            t, x = t[valid], x[valid]
            self._buffer_of(name, float(t.max())).add(t, x, self.newest - self.keep_s)
        return not valid.all()

    def _buffer_of(self, name: str, newest: float) -> RowBuffer:
        """Return the buffer of a kind and record its newest row time."""
        if newest > self.newest:
            self.newest = newest
        buffer = self._buffers.get(name)
        if buffer is None:
            buffer = self._buffers[name] = RowBuffer(np.empty(0), np.empty((0, len(COLUMNS[name]))))
        return buffer

    def rows(self, name: str, since: float = -np.inf) -> tuple[np.ndarray, np.ndarray]:
        """Return copies of times (n,) and values (n, k) of one kind from `since` on: valid, rising in time, unique."""
        t, x = self.rows_since(name, since)
        return t.copy(), x.copy()

    def rows_since(self, name: str, since: float = -np.inf) -> tuple[np.ndarray, np.ndarray]:
        """Return the same as read-only views, valid until the next message."""
        buffer = self._buffers.get(name)
        if buffer is None:
            return np.empty(0), np.empty((0, len(COLUMNS[name])))
        buffer.flush(self.newest - self.keep_s)
        if buffer.n_sorted < buffer.n:
            buffer.sort_new_rows(_MAX_VALUE_OF.get(name, _MAX_VALUE), FIRST_OPTIONAL_COLUMN.get(name))
        t = buffer.t[: buffer.n]
        first = 0 if since == -np.inf else int(t.searchsorted(since))
        return t[first:], buffer.x[first : buffer.n]

    def replace_rows(self, name: str, t: np.ndarray, x: np.ndarray) -> None:
        """Replace all rows of one kind, (n,) and (n, k)."""
        self._buffers[name] = RowBuffer(np.array(t, float), np.array(x, float))

    def blank_frozen(self, name: str, value: float) -> float:
        """Set the first column to 0 where a sensor repeats one reading; return that reading, nan while it varies.

        Args:
            name: kind of row
            value: reading that the sensor repeated at the previous call; nan: it did not
        """
        t, x = self.rows_since(name, self.newest - FROZEN_S)
        readings = x[:, 0]
        if not np.isfinite(value):
            if len(t) < _MIN_FROZEN_ROWS or t[-1] - t[0] < 0.8 * FROZEN_S or not readings[0] or np.ptp(readings):
                return float("nan")
            value = float(readings[0])
        _, every = self.rows_since(name)
        others = np.flatnonzero((every[:, 0] != value) & (every[:, 0] != 0.0))
        since = int(others[-1]) + 1 if len(others) else 0
        every[since:, 0] = 0.0
        return value if since < len(every) else float("nan")

    def shift_times(self, before_t: float, shift_s: float) -> None:
        """Shift rows before `before_t` [s since 1970] by `shift_s` [s], after a correction of their clock."""
        for buffer in self._buffers.values():
            buffer.shift_times(before_t, shift_s)
        self.newest = max(
            (float(buffer.t[: buffer.n].max()) for buffer in self._buffers.values() if buffer.n), default=-np.inf
        )

    def is_consistent(self) -> bool:
        """Return whether every kind has its columns; compiled code does not check bounds."""
        return all(buffer.x.shape[1] in ROW_WIDTHS.get(name, ()) for name, buffer in self._buffers.items())

    def clear(self) -> None:
        """Remove all rows, for example after a clock jump."""
        self._buffers.clear()
        self.newest = -np.inf
