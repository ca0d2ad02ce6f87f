"""Retry timer with exponential back-off."""

FIRST_WAIT_S, LONGEST_WAIT_S = 1.0, 60.0  # for a complete list, doubled at every attempt [s]


class Patience:
    """Timer of retries with exponential back-off."""

    def __init__(self, first_s: float = FIRST_WAIT_S) -> None:
        self._wait = self._first = first_s
        self._next = float("-inf")

    def due(self, now: float) -> bool:
        """Return whether to retry now; if so, double the next wait."""
        if now < self._next:
            return False
        self._next, self._wait = now + self._wait, min(2 * self._wait, LONGEST_WAIT_S)
        return True

    def reset(self) -> None:
        """Reset the wait to its first value."""
        self._wait, self._next = self._first, float("-inf")
