"""The share of each sweep over all twins that heavy work may take: telemetry of every aircraft always goes first."""

import time
from collections import Counter
from dataclasses import dataclass, field

from twin_worker.engine.pace import Work

SWEEP_S = 0.05  # of heavy work in one sweep, CPU [s]
LEAST_S = 1e-3  # the same where telemetry stays late: as much as one piece of work [s]
_GROWS = 1.2  # how it recovers with every sweep that was not late [-]
_SHARE = {Work.PREDICT: 1.0, Work.IDENTIFY: 0.7, Work.ENSEMBLE: 0.5}  # of a sweep, up to which each kind may begin [-]


@dataclass
class Quota:
    """What may be begun in one sweep; without a limit everything.

    Attributes:
        limit: of heavy work in one sweep, CPU [s]
        most: the same where there is one, while telemetry is in time
        hurry: an aircraft waits for its first prediction, so that nothing else is begun
        behind: telemetry of this aircraft waits: what would be foreseen now is old already
        aside: kinds that are done by another hand
        done, refused: how often each other kind was
    """

    limit: float = float("inf")
    most: float = SWEEP_S
    hurry: bool = False
    behind: bool = False
    aside: frozenset[Work] = frozenset()
    done: Counter[Work] = field(default_factory=Counter)
    refused: Counter[Work] = field(default_factory=Counter)
    _spent: float = 0.0
    _since: float | None = None  # when the work in hand was begun

    def sweep(self, *, hurry: bool = False) -> None:
        """Begin another sweep."""
        self.settle()
        self._spent, self.hurry = 0.0, hurry and self.limit < float("inf")

    def yield_to_telemetry(self, late: bool) -> None:
        """Grant half as much in a sweep as in the last where telemetry is late, else a little more again."""
        limit = min(self.limit, self.most)
        self.limit = max(0.5 * limit, LEAST_S) if late else min(_GROWS * limit, self.most)

    def settle(self) -> None:
        """End the work in hand, if any."""
        if self._since is not None:
            self._spent += time.thread_time() - self._since
            self._since = None

    def grants(self, work: Work) -> bool:
        """Tell whether work that is due may be begun."""
        if work in self.aside or (self.behind and self.limit < float("inf")):
            return False
        if work is Work.RENEW:
            return True
        self.settle()
        granted = self._spent < self.limit * _SHARE[work] and not (self.hurry and work is not Work.PREDICT)
        (self.done if granted else self.refused)[work] += 1
        if granted:
            self._since = time.thread_time()
        return granted
