"""Rows of one aircraft between two publications: in time order, the better source first, bounded."""

from typing import Any

from fleet.contract import COLUMNS, Array, Rows, Sample

MOST_ROWS = 2_000  # rows one aircraft may put between two publications
YIELD_S = 3.0  # a lower-ranked source speaks again after this silence of the better one [s]
_DTYPE = {"position": "<i4", "leg": "<i4", "target": "<i4"}


class Shelf:
    """Collect rows per `Sample` field, then hand them over as one `Sample`."""

    def __init__(self) -> None:
        self._rows: dict[str, list[tuple[float, tuple[float, ...]]]] = {field: [] for field in COLUMNS}
        self._last = dict.fromkeys(COLUMNS, float("-inf"))
        self._best = dict.fromkeys(COLUMNS, (-1, float("-inf")))
        self._count = 0

    def put(self, field: str, rank: int, t: float, values: tuple[float, ...]) -> bool:
        """Add one row; False when it is not newer than the last of its field, or the shelf is full."""
        best, when = self._best[field]
        if rank < best and t < when + YIELD_S:
            return True
        self._best[field] = (rank, t)
        if t <= self._last[field] or self._count >= MOST_ROWS:
            return False
        self._last[field] = t
        self._rows[field].append((t, values))
        self._count += 1
        return True

    def take(self, uav: int) -> Sample | None:
        """Hand over what was collected since the last call; None where nothing was."""
        if not self._count:
            return None
        made: dict[str, Any] = {}
        for field, rows in self._rows.items():
            if rows:
                values = Array.of([v for _, v in rows], _DTYPE.get(field, "<f4"))
                made[field] = Rows(t=Array.of([t for t, _ in rows], "<f8"), x=values)
                rows.clear()
        self._count = 0
        return Sample(uav=uav, t=max(self._last[field] for field in made), **made)
