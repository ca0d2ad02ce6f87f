"""The CPU time that heavy work may take in each sweep over all twins; telemetry of every aircraft goes first.

A token bucket. While sweeps are in time it is filled with a fixed amount in each. A late sweep fills it with a share of
the CPU time that this thread was really given since the sweep before: where the processor is shared with others, or
limited, heavy work falls in proportion to the CPU time and no faster, however late every sweep is by the wall clock.
While flights ahead wait in late sweeps, nothing else is begun.
"""

import time
from collections import Counter
from dataclasses import dataclass, field

from twin_worker.twin.state.schedule import Work

SWEEP_S = 0.05  # of heavy work in one sweep, CPU [s]
LEAST_S = 1e-3  # the same in a late sweep: so that it does not end [s]
EARNED = 0.5  # of the CPU time of this thread, which heavy work may take while sweeps are late [-]
_GROWS = 1.2  # how it recovers with every sweep that was not late [-]
_SHARE = {Work.PREDICT: 1.0, Work.IDENTIFY: 0.7, Work.ENSEMBLE: 0.5}  # of a sweep, up to which each kind may begin [-]


@dataclass
class Quota:
    """What may be begun in one sweep; without a limit everything.

    Attributes:
        limit: of heavy work in one sweep, CPU [s]; what one piece of work takes beyond is missing in the next
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
    _late: bool = False  # the last sweep was
    _waits: bool = False  # a flight ahead was refused in the last sweep
    _wanted: bool = False  # and in this one
    _swept: float = float("nan")  # CPU time of this thread when the sweep began [s]

    @property
    def limited(self) -> bool:
        """Return whether there is a limit: not offline."""
        return self.limit < float("inf")

    def sweep(self, *, hurry: bool = False) -> None:
        """Begin another sweep."""
        self.settle()
        self._waits, self._wanted = self._wanted, False
        self._spent, self.hurry = max(self._spent - self.limit, 0.0), hurry and self.limited

    def yield_to_telemetry(self, late: bool) -> None:
        """Grant a share of the CPU time of the last sweep where that was late, else a little more again."""
        limit, now = min(self.limit, self.most), time.thread_time()
        used, self._swept, self._late = now - self._swept, now, late
        if not late:
            self.limit = min(_GROWS * limit, self.most)
        elif used == used:
            self.limit = min(max(EARNED * used, LEAST_S), self.most)

    def settle(self) -> None:
        """End the work in hand, if any."""
        if self._since is not None:
            self._spent += time.thread_time() - self._since
            self._since = None

    def grants(self, work: Work) -> bool:
        """Return whether work that is due may be begun."""
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
