"""Period of a recurring task, in data time."""

import msgspec
import numpy as np


class Timer(msgspec.Struct):
    """When a task was last done. It is due after its period, and also when the clock was set back.

    Attributes:
        last: time of the last run [s since 1970]; -inf before any
    """

    last: float = -np.inf

    def due(self, now: float, period: float) -> bool:
        """Return whether the task is due at `now`, `period` after its last run [s]."""
        return not self.last <= now < self.last + period

    def restart(self, now: float) -> None:
        """Start a period at `now`."""
        self.last = now

    def expire(self) -> None:
        """Make the task due at once."""
        self.last = -np.inf
