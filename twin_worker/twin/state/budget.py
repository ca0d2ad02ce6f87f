"""CPU time budget for heavy work in each sweep over all twins; telemetry of every aircraft has priority.

A token bucket. While sweeps are on time, each sweep adds a fixed amount. A late sweep adds a fraction of the CPU time
that this thread received since the previous sweep. On a shared or limited processor, heavy work therefore falls in
proportion to the CPU time, independent of the wall-clock delay. While rollouts wait in late sweeps, no other work
starts.
"""

import time
from collections import Counter
from dataclasses import dataclass, field

from twin_worker.twin.state.schedule import Work

SWEEP_S = 0.05  # heavy work per sweep, CPU [s]
LEAST_S = 1e-3  # minimum in a late sweep, so that heavy work continues [s]
EARNED = 0.5  # share of this thread's CPU time for heavy work while sweeps are late [-]
_GROWS = 1.2  # recovery factor per sweep on time [-]
_SHARE = {Work.PREDICT: 1.0, Work.IDENTIFY: 0.7, Work.ENSEMBLE: 0.5}  # of the limit [-]


@dataclass
class Quota:
    """Heavy work that may start in one sweep; unlimited by default.

    Attributes:
        limit: heavy work per sweep, CPU [s]; an overrun is deducted from the next sweep
        max_limit: limit while telemetry is on time, CPU [s]
        first_prediction_pending: an aircraft has no prediction yet; no other work starts
        backlog: telemetry of this aircraft is queued; a prediction made now would be outdated
        offloaded: kinds of work that another thread does
        done, refused: number of starts and refusals of each kind
    """

    limit: float = float("inf")
    most: float = SWEEP_S
    hurry: bool = False
    behind: bool = False
    aside: frozenset[Work] = frozenset()
    done: Counter[Work] = field(default_factory=Counter)
    refused: Counter[Work] = field(default_factory=Counter)
    _spent: float = 0.0
    _since: float | None = None  # start of the running work, thread CPU time [s]
    _late: bool = False  # the previous sweep was late
    _waits: bool = False  # a rollout was refused in the previous sweep
    _wanted: bool = False  # a rollout was refused in this sweep
    _swept: float = float("nan")  # CPU time of this thread at the start of the sweep [s]

    @property
    def limited(self) -> bool:
        """Return whether a limit applies; offline runs have none."""
        return self.limit < float("inf")

    def sweep(self, *, hurry: bool = False) -> None:
        """Begin another sweep."""
        self.settle()
        self._waits, self._wanted = self._wanted, False
        self._spent, self.hurry = max(self._spent - self.limit, 0.0), hurry and self.limited

    def yield_to_telemetry(self, late: bool) -> None:
        """Set the limit to a share of the last sweep's CPU time if it was late; raise it slowly otherwise."""
        limit, now = min(self.limit, self.most), time.thread_time()
        used, self._swept, self._late = now - self._swept, now, late
        if not late:
            self.limit = min(_GROWS * limit, self.most)
        elif used == used:
            self.limit = min(max(EARNED * used, LEAST_S), self.most)

    def settle(self) -> None:
        """Stop the measurement of the running work, if any."""
        if self._since is not None:
            self._spent += time.thread_time() - self._since
            self._since = None

    def grants(self, work: Work) -> bool:
        """Return whether due work may start, and start its measurement."""
        if work in self.aside or (self.behind and self.limited):
            return False
        if work is Work.RENEW:
            return True
        self.settle()
        first = self.hurry or (self._late and self._waits)
        granted = self._spent < self.limit * _SHARE[work] and not (first and work is not Work.PREDICT)
        self._wanted |= work is Work.PREDICT and not granted
        (self.done if granted else self.refused)[work] += 1
        if granted:
            self._since = time.thread_time()
        return granted
