"""A thread that identifies one aircraft after another, so that the telemetry of the others never waits for it."""

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
    """Identifies whoever has waited longest.

    Args:
        holding: gives those whose twins are here
        publish: sends a result
        rates: where it is noted
        beside: the share of CPU time it may take
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
        """Identify until told to stop, at the priority of those who predict.

        A lower one would turn against them: where all cores are busy it would sleep with what they wait for in hand.
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
        except Exception as error:  # a defect met by one aircraft must not stop the others
            held.failed = f"{held.twin.name}: found a defect ({error}), its model is missing; report it"
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
