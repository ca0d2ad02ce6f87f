"""Rows of one aircraft that wait for their publication: in time order, handed over as far as they had arrived."""

from bisect import bisect_right

import numpy as np

from fleet.contract import COLUMNS, Array, Rows, Sample

MOST_ROWS = 2_000  # rows of one kind in one publication; more is a flood
_DTYPE = {"position": "<i4", "leg": "<i4", "target": "<i4"}


class _Pile:
    """Rows of one kind; numbers are packed once, publications cut from the bytes."""

    def __init__(self, field: str) -> None:
        self.dtype = np.dtype(_DTYPE.get(field, "<f4"))
        self.width = len(COLUMNS[field])
        self.arrival: list[float] = []
        self.t: list[float] = []
        self._t_bytes = self._x_bytes = b""
        self._start = 0

    def lay(self, arrival: np.ndarray, t: np.ndarray, x: np.ndarray) -> None:
        start, row = self._start, self.width * self.dtype.itemsize
        self.arrival = self.arrival[start:] + arrival.tolist()
        self.t = self.t[start:] + t.tolist()
        self._t_bytes = self._t_bytes[8 * start :] + t.astype("<f8").tobytes()
        self._x_bytes = self._x_bytes[row * start :] + x[:, : self.width].astype(self.dtype).tobytes()
        self._start = 0

    def take(self, now: float) -> tuple[Rows | None, int]:
        """Hand over what arrived up to `now`; and how many rows were too many."""
        start = self._start
        stop = bisect_right(self.arrival, now, start)
        if stop == start:
            return None, 0
        self._start = stop
        cut = min(stop, start + MOST_ROWS)
        row = self.width * self.dtype.itemsize
        t = Array("<f8", (cut - start,), self._t_bytes[8 * start : 8 * cut])
        x = Array(self.dtype.str, (cut - start, self.width), self._x_bytes[row * start : row * cut])
        return Rows(t=t, x=x), stop - cut


class Shelf:
    """Rows per `Sample` field."""

    def __init__(self) -> None:
        self.refused = 0  # rows beyond `MOST_ROWS`
        self._piles = {field: _Pile(field) for field in COLUMNS}

    def lay(self, field: str, arrival: np.ndarray, t: np.ndarray, x: np.ndarray) -> None:
        """Add rows of one kind.

        Args:
            field: of `Sample`
            arrival: when they were heard, never falling, (n,) [s since 1970]
            t: fleet time, rising and newer than what was laid before, (n,) [s since 1970]
            x: values, (n, k); columns beyond those of the field are left out
        """
        self._piles[field].lay(arrival, t, x)

    def take(self, uav: int, now: float) -> Sample | None:
        """Hand over what was heard up to `now` and not handed over before; None where nothing was."""
        made: dict[str, Rows] = {}
        newest = float("-inf")
        for field, pile in self._piles.items():
            rows, refused = pile.take(now)
            if rows is not None:
                made[field] = rows
                newest = max(newest, pile.t[pile._start - 1 - refused])
                self.refused += refused
        return Sample(uav=uav, t=newest, **made) if made else None  # type: ignore[arg-type]
