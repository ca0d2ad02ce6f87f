"""When to try again."""

FIRST_WAIT_S, LONGEST_WAIT_S = 1.0, 60.0  # for a whole list, doubled at every try [s]


class Patience:
    """When to try again: soon at first, then ever later."""

    def __init__(self, first_s: float = FIRST_WAIT_S) -> None:
        self._wait = self._first = first_s
        self._next = float("-inf")

    def due(self, now: float) -> bool:
        """Return whether to try now; if so the next wait is doubled."""
        if now < self._next:
            return False
        self._next, self._wait = now + self._wait, min(2 * self._wait, LONGEST_WAIT_S)
        return True

    def reset(self) -> None:
        """Forget earlier failures."""
        self._wait, self._next = self._first, float("-inf")
