"""Exponential back-off between connection attempts, up to a few seconds."""

import threading

FIRST_S, MAX_S = 0.25, 5.0


class BackOff:
    """Back-off between attempts to open a link."""

    def __init__(self) -> None:
        self._wait_s = FIRST_S

    def wait(self, stop: threading.Event) -> None:
        """Wait before the next attempt, or until `stop` is set."""
        stop.wait(self._wait_s)
        self._wait_s = min(2 * self._wait_s, MAX_S)

    def reset(self) -> None:
        """Reset the delay after data from the peer."""
        self._wait_s = FIRST_S
