"""The last minutes of one aircraft's telemetry, as it came."""

import numpy as np

from fleet.contract import COLUMNS, UNTOLD, Rows, Sample

_AHEAD_S = 1.0  # rows newer than their message by more are refused [s]
_SPARE = 40  # rows of one kind that there is always place for
_MOST = 1e5  # values beyond are noise [m/s, rad, us, ...]
_MOST_OF = {"position": 2e9, "target": 2e9, "gnss": 2e9, "pressure": 1e6}  # the same [1e-7 deg, mm, Pa]


class Kept:
    """Rows of one kind: times (n,) and values (n, k) float, with place for more; what came last is not sorted yet."""

    def __init__(self, t: np.ndarray, x: np.ndarray) -> None:
        self.t, self.x = t, x
        self.n, self.settled = len(t), 0  # rows, and how many of them are sorted

    def add(self, t: np.ndarray, x: np.ndarray, since: float) -> None:
        """Take rows; where there is no place left, those of before `since` are forgotten."""
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
        """Sort what is new in: rising in time, each time once, as it came first, and only what can be believed."""
        new = slice(self.settled, self.n)
        good = (np.abs(self.x[new, :told]) < most).all(axis=1)  # nan is not
        rising = np.diff(self.t[max(self.settled - 1, 0) : self.n]) > 0
        if not (good.all() and rising.all()):
            keep = np.concatenate([np.ones(self.settled, bool), good])
            t, first = np.unique(self.t[: self.n][keep], return_index=True)
            self.x[: len(t)] = self.x[: self.n][keep][first]
            self.t[: len(t)] = t
            self.n = len(t)
        self.settled = self.n


class History:
    """Rows of every kind over the last `keep_s` seconds; out-of-order and repeated rows are sorted out on reading."""

    def __init__(self, keep_s: float = 160.0) -> None:
        self.keep_s = keep_s
        self.newest = -np.inf
        self._kept: dict[str, Kept] = {}

    def add(self, sample: Sample) -> int:
        """Take one message; give how many of its kinds did not fit the contract."""
        bad, latest = 0, sample.t + _AHEAD_S
        for name, columns in COLUMNS.items():
            rows: Rows | None = getattr(sample, name)
            if rows is None:
                continue
            try:
                t, x = rows.t.numpy(), rows.x.numpy()
            except ValueError:
                bad += 1
                continue
            n = len(t)
            if x.ndim != 2 or t.shape != x.shape[:1] or x.shape[1] != len(columns) or not n:
                bad += 1
                continue
            times = t.tolist() if n < 9 else [t.min(), t.max()]  # a few numbers are looked at faster than an array
            if not all(0 < at <= latest for at in times):  # a message that dates its rows later contradicts itself
                timed = (t <= latest) & (t > 0)  # false for nan
                bad, t, x = bad + 1, t[timed], x[timed]
                times = t.tolist()
            if times:
                self._keep(name, t, x, float(max(times)))
        return bad

    def _keep(self, name: str, t: np.ndarray, x: np.ndarray, newest: float) -> None:
        self.newest = max(self.newest, newest)
        kept = self._kept.get(name)
        if kept is None:
            kept = self._kept[name] = Kept(np.empty(0), np.empty((0, x.shape[1])))
        kept.add(t, x, self.newest - self.keep_s)

    def rows(self, name: str, since: float = -np.inf) -> tuple[np.ndarray, np.ndarray]:
        """Give times (n,) and values (n, k) of one kind from `since` on, rising in time, believable, once each."""
        kept = self._kept.get(name)
        if kept is None:
            return np.empty(0), np.empty((0, len(COLUMNS[name])))
        if kept.settled < kept.n:
            kept.settle(_MOST_OF.get(name, _MOST), UNTOLD.get(name))
        t = kept.t[: kept.n]
        first = 0 if since == -np.inf else int(t.searchsorted(since))
        return t[first:].copy(), kept.x[first : kept.n].copy()

    def put(self, name: str, t: np.ndarray, x: np.ndarray) -> None:
        """Have these rows, (n,) and (n, k), instead of all of their kind."""
        self._kept[name] = Kept(np.array(t, float), np.array(x, float))

    def clear(self) -> None:
        """Forget everything, as after a jump of the clock."""
        self._kept.clear()
        self.newest = -np.inf
