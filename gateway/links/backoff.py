"""Exponential back-off between connection attempts, up to a few seconds."""

import threading

FIRST_S, LONGEST_S = 0.25, 5.0


class BackOff:
    """Back-off between attempts to open a link."""

    def __init__(self) -> None:
        self._next = FIRST_S

    def wait(self, stop: threading.Event) -> None:
        """Wait before the next attempt, or until `stop` is set."""
        stop.wait(self._next)
        self._next = min(2 * self._next, LONGEST_S)

    def reset(self) -> None:
        """Reset the delay after data from the peer."""
        self._next = FIRST_S
