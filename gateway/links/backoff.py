"""How long to wait before the next try: a little at first, then ever longer, up to a few seconds."""

import threading

FIRST_S, LONGEST_S = 0.25, 5.0


class BackOff:
    """Waits between tries to open a link."""

    def __init__(self) -> None:
        self._next = FIRST_S

    def wait(self, stop: threading.Event) -> None:
        """Wait before the next try, or until `stop` is set."""
        stop.wait(self._next)
        self._next = min(2 * self._next, LONGEST_S)

    def reset(self) -> None:
        """Begin anew: the far end spoke."""
        self._next = FIRST_S
