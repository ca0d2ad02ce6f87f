"""Telemetry of one aircraft over the last minutes, as received."""

from struct import Struct

import numpy as np

from fleet.contract import COLUMNS, DTYPES, FIRST_OPTIONAL_COLUMN, Array, Rows, Sample
from twin_worker.telemetry.row_buffer import RowBuffer

_MAX_FUTURE_S = 1.0  # rows further in the future of their message are rejected [s]
_MAX_VALUE = 1e5  # larger values are invalid [m/s, rad, us, ...]
_MAX_VALUE_OF = {"position": 2e9, "target": 2e9, "gnss": 2e9, "pressure": 1e6}  # exceptions [1e-7 deg, mm, Pa]
_WIDTHS = tuple((name, len(columns)) for name, columns in COLUMNS.items())
_SIZES = {name: np.dtype(name).itemsize for name in DTYPES}
_UNPACK_TIMES = tuple(Struct(f"<{n}d").unpack for n in range(17))  # by number of rows; faster than an array


class TelemetryHistory:
    """Buffer rows of every kind over the last `keep_s` seconds; reading sorts rows and drops duplicates."""

    def __init__(self, keep_s: float = 160.0) -> None:
        self.keep_s = keep_s
        self.newest = -np.inf
        self._buffers: dict[str, RowBuffer] = {}

    def add(self, sample: Sample) -> int:
        """Add one message; return how many of its kinds violate the contract."""
        rejected, max_t = 0, sample.t + _MAX_FUTURE_S
        for name, width in _WIDTHS:
            rows: Rows | None = getattr(sample, name)
            if rows is None:
                continue
            newest = _newest_time(rows.t, rows.x, width, max_t)
            if newest:
                self._buffer_of(name, newest).add_bytes(
                    rows.t.data, rows.x.data, rows.x.dtype, self.newest - self.keep_s
                )
            else:
                rejected += self._add_checked(name, rows, max_t)
        return rejected

    def _add_checked(self, name: str, rows: Rows, max_t: float) -> bool:
        """Add the valid rows of a large or irregular batch; return whether some rows are invalid."""
        try:
            t, x = rows.t.numpy(), rows.x.numpy()
        except ValueError:
            return True
        if x.ndim != 2 or t.shape != x.shape[:1] or x.shape[1] != len(COLUMNS[name]) or not len(t):
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

    def shift_times(self, before_t: float, shift_s: float) -> None:
        """Shift rows before `before_t` [s since 1970] by `shift_s` [s], after a correction of their clock."""
        for buffer in self._buffers.values():
            buffer.shift_times(before_t, shift_s)
        self.newest = max(
            (float(buffer.t[: buffer.n].max()) for buffer in self._buffers.values() if buffer.n), default=-np.inf
        )

    def is_consistent(self) -> bool:
        """Return whether every kind has its columns; compiled code does not check bounds."""
        widths = dict(_WIDTHS)
        kinds = self._buffers.items() if isinstance(self._buffers, dict) else [("", None)]
        return all(isinstance(buffer, RowBuffer) and buffer.x.shape[1] == widths.get(name) for name, buffer in kinds)

    def clear(self) -> None:
        """Remove all rows, for example after a clock jump."""
        self._buffers.clear()
        self.newest = -np.inf


def _newest_time(t: Array, x: Array, width: int, max_t: float) -> float:
    """Return the newest time of a small valid batch, none later than `max_t`; 0 for any other batch."""
    n = len(t.data) >> 3
    if not 0 < n < len(_UNPACK_TIMES) or t.dtype != "<f8" or t.shape != (n,) or x.shape != (n, width):
        return 0.0
    if len(t.data) != 8 * n or len(x.data) != n * width * _SIZES.get(x.dtype, 0):
        return 0.0
    times: tuple[float, ...] = _UNPACK_TIMES[n](t.data)
    for row_t in times:
        if not 0 < row_t <= max_t:  # true for nan
            return 0.0
    return max(times)
