"""Allocate unique aircraft ids for several recordings and their copies."""

from collections.abc import Hashable
from itertools import chain

MAX_PER_LINK = 250  # system ids 1 to 250; higher ones are for ground stations


class IdAllocator:
    """Allocator of ids.

    Args:
        min_id, max_id: range of ids
    """

    def __init__(self, min_id: int = 0, max_id: int = 999_999) -> None:
        self._min, self._max = min_id, max_id
        self._by_key: dict[Hashable, int] = {}
        self._allocated: set[int] = set()

    def allocate(self, key: Hashable, preferred: int) -> int:
        """Return the id of `key`: the allocated one, else `preferred`, else the next free one above, else any free one.

        Raises:
            ValueError: if no id is free; replay fewer aircraft or copies.
        """
        if key in self._by_key:
            return self._by_key[key]
        after = max(preferred, self._min)
        candidates = chain(range(after, self._max + 1), range(self._min, after))
        free = next((candidate for candidate in candidates if candidate not in self._allocated), None)
        if free is None:
            count = self._max - self._min + 1
            raise ValueError(f"ids: found all {count} taken, expected a free one; replay fewer aircraft or copies")
        self._by_key[key] = free
        self._allocated.add(free)
        return free
