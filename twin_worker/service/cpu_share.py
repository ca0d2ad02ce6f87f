"""Limit the share of this process's CPU time used by background threads."""

import threading
import time
from collections.abc import Callable

MIN_SHARE = 0.2  # lower limit [-]
_RECOVERY_FACTOR = 1.2  # recovery factor per task [-]
_POLL_S = 0.05  # between checks of the CPU time of the other threads [s]


class CpuShareLimiter:
    """Make background threads rest after each task until the other threads received their share.

    The share is measured in CPU time: a process with little CPU time slows all of its work equally, and a task delayed
    by other processes does not lengthen the rest.
    """

    def __init__(self) -> None:
        self.share = 1.0

    def yield_to_telemetry(self, late: bool) -> None:
        """Halve the share if telemetry is late; each later task raises it again."""
        self.share = max(0.5 * self.share, MIN_SHARE) if late else self.share

    def rest_s(self, used_s: float) -> float:
        """Return the rest after `used_s` of work [s]."""
        return used_s * (1.0 / self.share - 1.0)

    def run(self, task: Callable[[], None], stop: threading.Event | None = None) -> None:
        """Run a task, then rest until the other threads used their CPU time or had the wall time for it."""
        self.share = min(_RECOVERY_FACTOR * self.share, 1.0)
        cpu, wall = time.thread_time(), time.monotonic()
        task()
        cpu, wall = time.thread_time() - cpu, time.monotonic() - wall
        self._rest(cpu, wall, stop or threading.Event())

    def _rest(self, cpu: float, wall: float, stop: threading.Event) -> None:
        process_cpu, started = time.process_time(), time.monotonic()
        while (
            time.process_time() - process_cpu < self.rest_s(cpu)
            and (remaining_s := self.rest_s(wall) - (time.monotonic() - started)) > 0.0
            and not stop.wait(min(remaining_s, _POLL_S))
        ):
            pass
