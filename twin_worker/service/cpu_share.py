"""The share of this process's CPU time that work on threads beside the sweep may take."""

import threading
import time
from collections.abc import Callable

LEAST = 0.2  # it never is less [-]
_GROWS = 1.2  # how it recovers with every piece of work [-]
_LOOK_S = 0.05  # between looks at how much the others had [s]


class Beside:
    """Threads that rest after a piece of work until the others had their share.

    It is measured as CPU time: a process that is given little of it works as little on everything, and a piece of work
    that took long because the processor was busy elsewhere is not paid for twice.
    """

    def __init__(self) -> None:
        self.share = 1.0

    def yield_to_telemetry(self, late: bool) -> None:
        """Take less where telemetry is late; every piece of work after that may take a little more again."""
        self.share = max(0.5 * self.share, LEAST) if late else self.share

    def owed(self, worked: float) -> float:
        """Return how much the others are to have after so much work [s]."""
        return worked * (1.0 / self.share - 1.0)

    def do(self, work: Callable[[], None], stop: threading.Event | None = None) -> None:
        """Work, then rest until the other threads had their CPU time, or had time enough to take it."""
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
