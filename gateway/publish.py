"""Contract messages to the bus; the latest of each aircraft answers whoever asks."""

import threading
from collections.abc import Iterable
from functools import partial

from fleet.bus import Answers, Bus
from fleet.contract import Account, Message, Mission, Params, Status

KEPT = (Status, Mission, Params)
REPEAT_S = 10.0  # mission and parameters are said again, for those who missed them [s]


class Publisher:
    """Publish, remember the latest, answer queries."""

    def __init__(self, bus: Bus) -> None:
        self.published = 0
        self._bus = bus
        self._lock = threading.Lock()  # answers come from a thread of the bus
        self._latest: dict[type, dict[int, Message]] = {kind: {} for kind in KEPT}
        self._account: Account | None = None
        self._repeated = 0.0
        for kind in KEPT:
            bus.answer(kind, partial(self._answers, kind))
        bus.answer(Account, self._account_answer)

    def publish(self, messages: Iterable[Message]) -> None:
        """Put messages on the bus."""
        for message in messages:
            if type(message) in self._latest:
                with self._lock:
                    self._latest[type(message)][message.uav] = message
            self._put(message)

    def account(self, account: Account) -> None:
        """Put the counters on the bus."""
        self._account = account
        self._bus.publish(account)

    def repeat(self, mono: float) -> None:
        """Say missions and parameters again when it is time; `mono` is any clock that only goes forward [s]."""
        if mono - self._repeated < REPEAT_S:
            return
        self._repeated = mono
        for kind in (Mission, Params):
            for message in list(self._latest[kind].values()):
                self._put(message)

    def _put(self, message: Message) -> None:
        self._bus.publish(message)
        self.published += 1

    def _answers(self, kind: type, uav: int | None, settings: dict[str, str], payload: bytes) -> Answers:
        del settings, payload
        with self._lock:
            found = list(self._latest[kind].values())
        return [(message, None) for message in found if uav is None or message.uav == uav]

    def _account_answer(self, uav: int | None, settings: dict[str, str], payload: bytes) -> Answers:
        del uav, settings, payload
        return [] if self._account is None else [(self._account, None)]
