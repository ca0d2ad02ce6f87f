"""Identify one aircraft after another in a thread, so that telemetry of the others is not delayed."""

import logging
import threading
import time
from collections.abc import Callable
from functools import partial

from fleet.contract import Message
from twin_worker.ownership.twin_store import Held
from twin_worker.service.cpu_share import Beside
from twin_worker.service.work_rates import Rates
from twin_worker.twin.state.schedule import Work
from twin_worker.twin.step import identify, identify_due

_log = logging.getLogger(__name__)
_IDLE_S = 0.05
Publish = Callable[[Message, Held], None]


class Learner:
    """Identifies the aircraft whose identification is oldest.

    Args:
        owned_twins: returns the ready twins
        publish: publishes a result
        rates: counts the identifications
        cpu_share: limits the CPU time
    """

    def __init__(
        self,
        holding: Callable[[], list[Held]],
        publish: Callable[[Message, Held], None],
        rates: Rates,
        beside: Beside | None = None,
    ) -> None:
        self._holding, self._publish, self._rates = holding, publish, rates
        self._beside = beside or Beside()

    def run(self, stop: threading.Event) -> None:
        """Identify until `stop` is set, at the same priority as the prediction thread.

        At a lower priority, a busy machine could suspend it while it holds a lock that the prediction thread needs.
        """
        while not stop.is_set():
            held = self._next()
            if held is None:
                stop.wait(_IDLE_S)
            else:
                self._beside.do(partial(self._try, held), stop)

    def _try(self, held: Held) -> None:
        try:
            self._identify(held)
        except Exception as error:  # an error in one aircraft must not stop the others
            held.failed = f"{held.twin.name}: found an internal error ({error}), expected a model; report it"
            _log.exception(held.failed)

    def _next(self) -> Held | None:
        found = [held for held in self._holding() if held.twin.prediction is not None and identify_due(held.twin)]
        return min(found, key=lambda held: held.twin.identify_t, default=None)

    def _identify(self, held: Held) -> None:
        with held.lock:
            if not held.ready:
                return
            results = identify(held.twin)
        self._rates.note(Work.IDENTIFY, time.monotonic())
        for result in results:
            self._publish(result, held)
