"""Limit the share of this process's CPU time used by background threads."""

import threading
import time
from collections.abc import Callable

LEAST = 0.2  # lower limit [-]
_GROWS = 1.2  # recovery factor per task [-]
_LOOK_S = 0.05  # between checks of the CPU time of the other threads [s]


class Beside:
    """Make background threads rest after each task until the other threads received their share.

    The share is measured in CPU time: a process with little CPU time slows all of its work equally, and a task delayed
    by other processes does not lengthen the rest.
    """

    def __init__(self) -> None:
        self.share = 1.0

    def yield_to_telemetry(self, late: bool) -> None:
        """Halve the share if telemetry is late; each later task raises it again."""
        self.share = max(0.5 * self.share, LEAST) if late else self.share

    def owed(self, worked: float) -> float:
        """Return the rest after `used_s` of work [s]."""
        return worked * (1.0 / self.share - 1.0)

    def do(self, work: Callable[[], None], stop: threading.Event | None = None) -> None:
        """Run a task, then rest until the other threads used their CPU time or had the wall time for it."""
        self.share = min(_GROWS * self.share, 1.0)
        cpu, wall = time.thread_time(), time.monotonic()
        work()
        cpu, wall = time.thread_time() - cpu, time.monotonic() - wall
        self._rest(cpu, wall, stop or threading.Event())

    def _rest(self, cpu: float, wall: float, stop: threading.Event) -> None:
        others, begun = time.process_time(), time.monotonic()
        while (
            time.process_time() - others < self.owed(cpu)
            and (left := self.owed(wall) - (time.monotonic() - begun)) > 0.0
            and not stop.wait(min(left, _LOOK_S))
        ):
            pass
