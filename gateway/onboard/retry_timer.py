"""Retry timer with exponential back-off."""

FIRST_WAIT_S, LONGEST_WAIT_S = 1.0, 60.0  # for a complete list, doubled at every attempt [s]


class RetryTimer:
    """Timer of retries with exponential back-off."""

    def __init__(self, first_s: float = FIRST_WAIT_S) -> None:
        self._wait_s = self._first_s = first_s
        self._due_t = float("-inf")

    def due(self, now: float) -> bool:
        """Return whether to retry now; if so, double the next wait."""
        if now < self._due_t:
            return False
        self._due_t, self._wait_s = now + self._wait_s, min(2 * self._wait_s, LONGEST_WAIT_S)
        return True

    def reset(self) -> None:
        """Reset the wait to its first value."""
        self._wait_s, self._due_t = self._first_s, float("-inf")
