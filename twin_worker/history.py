"""The last minutes of one aircraft's telemetry, as it came."""

import numpy as np

from fleet.contract import COLUMNS, UNTOLD, Rows, Sample

_AHEAD_S = 1.0  # rows newer than their message by more are refused [s]
_CHUNKS = 40  # chunks of one kind before they are joined
_MOST = 1e5  # values beyond are noise [m/s, rad, us, ...]
_MOST_OF = {"position": 2e9, "target": 2e9, "gnss": 2e9, "pressure": 1e6}  # the same [1e-7 deg, mm, Pa]


class History:
    """Rows of every kind over the last `keep_s` seconds; out-of-order and repeated rows are sorted out on reading."""

    def __init__(self, keep_s: float = 160.0) -> None:
        self.keep_s = keep_s
        self.newest = -np.inf
        self._chunks: dict[str, list[tuple[np.ndarray, np.ndarray, float]]] = {name: [] for name in COLUMNS}

    def add(self, sample: Sample) -> int:
        """Take one message; give how many of its kinds did not fit the contract."""
        bad = 0
        for name in COLUMNS:
            rows: Rows | None = getattr(sample, name)
            if rows is None:
                continue
            try:
                t, x = rows.t.numpy(), rows.x.numpy()
            except ValueError:
                bad += 1
                continue
            if x.ndim != 2 or t.shape != x.shape[:1] or x.shape[1] != len(COLUMNS[name]) or not len(t):
                bad += 1
                continue
            timed = t <= sample.t + _AHEAD_S  # false for nan; a message that dates its rows later contradicts itself
            timed &= t > 0
            if not timed.all():
                bad, t, x = bad + 1, t[timed], x[timed]
            if len(t):
                newest = float(t.max())
                self._chunks[name].append((t, x, newest))
                self.newest = max(self.newest, newest)
        self._join()
        return bad

    def _join(self) -> None:
        """Join many small chunks to one, and forget what is too old."""
        for chunks in self._chunks.values():
            if len(chunks) > _CHUNKS:
                t, x = (np.concatenate([chunk[part] for chunk in chunks]) for part in (0, 1))
                young = t >= self.newest - self.keep_s
                newest = max(chunk[2] for chunk in chunks)
                chunks.clear()
                chunks.append((t[young], x[young], newest))

    def rows(self, name: str, since: float = -np.inf) -> tuple[np.ndarray, np.ndarray]:
        """Give times (n,) and values (n, k) of one kind from `since` on, rising in time, believable, once each."""
        found = [chunk for chunk in self._chunks[name] if len(chunk[0]) and chunk[2] >= since]
        if not found:
            return np.empty(0), np.empty((0, len(COLUMNS[name])))
        t = np.concatenate([chunk[0] for chunk in found])
        x = np.concatenate([chunk[1] for chunk in found]).astype(float)
        good = (t >= since) & (np.abs(x[:, : UNTOLD.get(name)]) < _MOST_OF.get(name, _MOST)).all(axis=1)  # nan is not
        t, x = t[good], x[good]
        if (np.diff(t) > 0).all():
            return t, x
        t, first = np.unique(t, return_index=True)
        return t, x[first]

    def put(self, name: str, t: np.ndarray, x: np.ndarray) -> None:
        """Have these rows, (n,) and (n, k), instead of all of their kind."""
        self._chunks[name] = [(t, x, float(t[-1]))] if len(t) else []

    def clear(self) -> None:
        """Forget everything, as after a jump of the clock."""
        for chunks in self._chunks.values():
            chunks.clear()
        self.newest = -np.inf
