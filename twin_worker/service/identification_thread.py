"""Identify one aircraft after another in a thread, so that telemetry of the others is not delayed."""

import logging
import threading
import time
from collections.abc import Callable
from functools import partial

from fleet.contract import Message
from twin_worker.ownership.twin_store import OwnedTwin
from twin_worker.service.cpu_share import CpuShareLimiter
from twin_worker.service.work_rates import WorkRates
from twin_worker.twin.state.schedule import Work
from twin_worker.twin.step import identify, identify_due

_log = logging.getLogger(__name__)
_IDLE_S = 0.05
Publish = Callable[[Message, OwnedTwin], None]


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
            self._identify(owned)
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

    def _identify(self, owned: OwnedTwin) -> None:
        with owned.lock:
            if not owned.ready:
                return
            results = identify(owned.twin)
        self._rates.record(Work.IDENTIFY, time.monotonic())
        for result in results:
            self._publish(result, owned)
