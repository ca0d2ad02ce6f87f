"""Allocate unique aircraft ids for several recordings and their copies."""

from collections.abc import Hashable


class Ids:
    """Allocator of ids.

    Args:
        min_id, max_id: range of ids
    """

    def __init__(self, least: int = 0, most: int = 999_999) -> None:
        self._least, self._most = least, most
        self._of: dict[Hashable, int] = {}
        self._held: set[int] = set()

    def give(self, who: Hashable, wanted: int) -> int:
        """Return the id of `key`: the allocated one, else `preferred`, else the next free one above, else any free one.

        Raises:
            ValueError: if no id is free; replay fewer aircraft or copies.
        """
        if who in self._of:
            return self._of[who]
        after = max(wanted, self._least)
        free = next((i for i in range(after, self._most + 1) if i not in self._held), None)
        if free is None:
            free = next((i for i in range(self._least, after) if i not in self._held), None)
        if free is None:
            count = self._most - self._least + 1
            raise ValueError(f"ids: found all {count} taken, expected a free one; replay fewer aircraft or copies")
        self._of[who] = free
        self._held.add(free)
        return free
