"""Identify one aircraft after another in a thread of limited CPU share; telemetry is not delayed."""

import logging
import threading
import time
from collections.abc import Callable
from functools import partial

from fleet.contract import Message
from twin_worker.ownership.twin_store import OwnedTwin
from twin_worker.service.work_rates import WorkRates
from twin_worker.twin.state.budget import Work
from twin_worker.twin.step import identify, identify_due

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
        stop, process_cpu, started = stop or threading.Event(), time.process_time(), time.monotonic()
        while (
            time.process_time() - process_cpu < self.rest_s(cpu)
            and (remaining_s := self.rest_s(wall) - (time.monotonic() - started)) > 0.0
            and not stop.wait(min(remaining_s, _POLL_S))
        ):
            pass


_log = logging.getLogger(__name__)
_IDLE_S = 0.05


class IdentificationThread:
    """Identifies the aircraft whose identification is oldest.

    Args:
        owned_twins: returns the ready twins
        publish: publishes a result
        rates: counts the identifications
        cpu_share: limits the CPU time
    """

    def __init__(
        self,
        owned_twins: Callable[[], list[OwnedTwin]],
        publish: Callable[[Message, OwnedTwin], None],
        rates: WorkRates,
        cpu_share: CpuShareLimiter | None = None,
    ) -> None:
        self._owned_twins, self._publish, self._rates = owned_twins, publish, rates
        self._cpu_share = cpu_share or CpuShareLimiter()

    def run(self, stop: threading.Event) -> None:
        """Identify until `stop` is set, at the same priority as the prediction thread.

        At a lower priority, a busy machine could suspend it while it holds a lock that the prediction thread needs.
        """
        while not stop.is_set():
            owned = self._next_due()
            if owned is None:
                stop.wait(_IDLE_S)
            else:
                self._cpu_share.run(partial(self._run_one, owned), stop)

    def _run_one(self, owned: OwnedTwin) -> None:
        try:
            with owned.lock:
                if not owned.ready:
                    return
                results = identify(owned.twin)
            self._rates.record(Work.IDENTIFY, time.monotonic())
            for result in results:
                self._publish(result, owned)
        except Exception as error:  # an error in one aircraft must not stop the others
            owned.defect = f"{owned.twin.name}: found an internal error ({error}), expected a model; report it"
            _log.exception(owned.defect)

    def _next_due(self) -> OwnedTwin | None:
        due = [
            owned
            for owned in self._owned_twins()
            if owned.twin.prediction.latest is not None and identify_due(owned.twin)
        ]
        return min(due, key=lambda owned: owned.twin.identification.timer.last, default=None)
