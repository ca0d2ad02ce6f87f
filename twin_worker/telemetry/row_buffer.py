"""Buffer of telemetry rows of one kind; bytes are decoded on reading."""

import numba as nb
import numpy as np

_SPARE = 40  # minimum spare capacity [rows]
_LATER = 256  # largest number of undecoded rows


class Kept:
    """Buffer rows of one kind: times (n,) and values (n, k) float, with spare capacity; the newest rows are unsorted.

    Received rows stay bytes until reading, because decoding a few rows takes as long as decoding many.
    """

    def __init__(self, t: np.ndarray, x: np.ndarray) -> None:
        self.t, self.x = t, x
        self.n, self.settled = len(t), 0  # number of rows, and of sorted rows
        self._t: list[bytes] = []
        self._x: list[bytes] = []
        self._dtype, self._waiting = "", 0  # type of pending values; number of pending rows

    def hear(self, t: bytes, x: bytes, dtype: str, since: float) -> None:
        """Append undecoded rows of checked length: times <f8, values of `dtype`; `since` as for `add`."""
        if dtype != self._dtype or self._waiting >= _LATER:
            self.lay(since)
            self._dtype = dtype
        self._t.append(t)
        self._x.append(x)
        self._waiting += len(t) >> 3

    def lay(self, since: float = -np.inf) -> None:
        """Decode pending rows."""
        if self._waiting:
            t = np.frombuffer(b"".join(self._t), "<f8")
            x = np.frombuffer(b"".join(self._x), self._dtype).reshape(len(t), -1)
            self._t, self._x, self._waiting = [], [], 0
            self.add(t, x, since)

    def add(self, t: np.ndarray, x: np.ndarray, since: float) -> None:
        """Append rows; if capacity is exhausted, drop rows before `since`."""
        self.lay(since)
        end = self.n + len(t)
        if end > len(self.t):
            self._make_place(len(t), since)
            end = self.n + len(t)
        self.t[self.n : end], self.x[self.n : end] = t, x
        self.n = end

    def _make_place(self, more: int, since: float) -> None:
        young = self.t[: self.n] >= since
        t, x = self.t[: self.n][young], self.x[: self.n][young]
        self.settled = int(young[: self.settled].sum())
        self.n = len(t)
        size = self.n + more + max(self.n // 4, _SPARE)
        self.t, self.x = np.empty(size), np.empty((size, self.x.shape[1]))
        self.t[: self.n], self.x[: self.n] = t, x

    def settle(self, most: float, told: int | None) -> None:
        """Sort new rows by time, drop duplicates (the first is kept) and invalid values."""
        told = self.x.shape[1] if told is None else told
        if not _settled(self.t[: self.n], self.x, (self.settled, told), most):
            good = (np.abs(self.x[self.settled : self.n, :told]) < most).all(axis=1)  # false for nan
            keep = np.concatenate([np.ones(self.settled, bool), good])
            t, first = np.unique(self.t[: self.n][keep], return_index=True)
            self.x[: len(t)] = self.x[: self.n][keep][first]
            self.t[: len(t)] = t
            self.n = len(t)
        self.settled = self.n

    def advance(self, before: float, by: float) -> None:
        """Shift rows before `before_t` by `shift_s` [s]."""
        self.lay()
        t = self.t[: self.n]
        t[t < before] += by
        self.settled = 0  # later rows may overlap the shifted ones

    def whole(self) -> tuple[np.ndarray, np.ndarray]:
        """Return all rows in order of arrival, (n,) and (n, k)."""
        self.lay()
        return self.t[: self.n], self.x[: self.n]


@nb.njit(cache=True, nogil=True, _nrt=False)  # type: ignore[call-overload]
def _settled(t: np.ndarray, x: np.ndarray, what: tuple[int, int], most: float) -> bool:
    """Return whether rows from bounds[0] on rise in time and their first bounds[1] columns are valid, not nan."""
    for k in range(what[0], len(t)):
        if k > 0 and not t[k] > t[k - 1]:
            return False
        for i in range(what[1]):
            if not abs(x[k, i]) < most:
                return False
    return True
