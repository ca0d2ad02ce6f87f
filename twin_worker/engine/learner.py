"""A thread that identifies one aircraft after another, so that the telemetry of the others never waits for it."""

import logging
import threading
import time
from collections.abc import Callable

from fleet.contract import Message
from twin_worker.claims.keeper import Held
from twin_worker.engine.pace import Work
from twin_worker.engine.rates import Rates
from twin_worker.twin import identify, identify_due

_log = logging.getLogger(__name__)
_IDLE_S = 0.05
_LEAST, _GROWS = 0.1, 1.2  # share of its time that it may work: never less, and how it recovers after a pause [-]
_REST_S = 1.0  # it pauses no longer, however long it worked: at any pace everyone's turn comes [s]
Publish = Callable[[Message, Held], None]


class Learner:
    """Identifies whoever has waited longest.

    Args:
        holding: gives those whose twins are here
        publish: sends a result
        rates: where it is noted
    """

    def __init__(
        self, holding: Callable[[], list[Held]], publish: Callable[[Message, Held], None], rates: Rates
    ) -> None:
        self._share = 1.0
        self._holding, self._publish, self._rates = holding, publish, rates

    def yield_to_telemetry(self, late: bool) -> None:
        """Work less where telemetry is late; every piece of work after that may be followed sooner by the next."""
        self._share = max(0.5 * self._share, _LEAST) if late else self._share

    def rest(self, worked: float) -> float:
        """Give how long to pause after so long a piece of work [s]; after none it looks again soon."""
        return min(worked * (1.0 / self._share - 1.0), _REST_S) if worked else _IDLE_S

    def run(self, stop: threading.Event) -> None:
        """Identify until told to stop, at the priority of those who predict.

        A lower one would turn against them: where all cores are busy it would sleep with what they wait for in hand.
        """
        worked = 0.0
        while not stop.wait(self.rest(worked)):
            held = self._next()
            begun = time.monotonic()
            if held is None:
                worked = 0.0
                continue
            self._share = min(_GROWS * self._share, 1.0)
            try:
                self._identify(held)
            except Exception as error:  # a defect met by one aircraft must not stop the others
                held.failed = f"{held.twin.name}: found a defect ({error}), its model is missing; report it"
                _log.exception(held.failed)
            worked = time.monotonic() - begun

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
