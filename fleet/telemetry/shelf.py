"""Rows of one aircraft that wait for their publication: in time order, handed over as far as they had arrived."""

from bisect import bisect_right
from math import inf

import numpy as np

from fleet.contract import COLUMNS, Array, Rows, Sample

MOST_ROWS = 2_000  # rows of one kind in one publication; more is a flood
_DTYPE = {"position": "<i4", "leg": "<i4", "target": "<i4", "gnss": "<i4"}


class _Pile:
    """Rows of one kind; numbers are packed once, publications cut from the bytes."""

    def __init__(self, field: str) -> None:
        self.due = inf  # arrival of the next row to hand over [s since 1970]
        self._dtype = np.dtype(_DTYPE.get(field, "<f4"))
        self._name, self._width = self._dtype.str, len(COLUMNS[field])
        self._row = self._width * self._dtype.itemsize  # [bytes]
        self._arrival: list[float] = []
        self._t: list[float] = []
        self._t_bytes = self._x_bytes = b""
        self._start = 0

    def lay(self, arrival: np.ndarray, t: np.ndarray, x: np.ndarray) -> None:
        start = self._start
        self._arrival = self._arrival[start:] + arrival.tolist()
        self._t = self._t[start:] + t.tolist()
        self._t_bytes = self._t_bytes[8 * start :] + t.astype("<f8").tobytes()
        self._x_bytes = self._x_bytes[self._row * start :] + x[:, : self._width].astype(self._dtype).tobytes()
        self._start, self.due = 0, self._arrival[0]

    def take(self, now: float) -> tuple[Rows, float, int]:
        """Hand over what arrived up to `now`, something is due: rows, newest time; and how many were too many."""
        start, row = self._start, self._row
        stop = bisect_right(self._arrival, now, start)
        self._start = stop
        self.due = self._arrival[stop] if stop < len(self._arrival) else inf
        cut = min(stop, start + MOST_ROWS)
        t = Array("<f8", (cut - start,), self._t_bytes[8 * start : 8 * cut])
        x = Array(self._name, (cut - start, self._width), self._x_bytes[row * start : row * cut])
        return Rows(t, x), self._t[cut - 1], stop - cut


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
        newest = -inf
        for field, pile in self._piles.items():
            if pile.due <= now:
                made[field], t, refused = pile.take(now)
                self.refused += refused
                newest = max(newest, t)
        return Sample(uav=uav, t=newest, **made) if made else None  # type: ignore[arg-type]
