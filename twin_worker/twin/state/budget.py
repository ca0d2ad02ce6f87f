"""Schedule of a twin, timers, CPU budget for heavy work in each sweep; telemetry of every aircraft has priority.

A token bucket. While sweeps are on time, each sweep adds a fixed amount. A late sweep adds a fraction of the CPU time
that this thread received since the previous sweep. On a shared or limited processor, heavy work therefore falls in
proportion to the CPU time, independent of the wall-clock delay. While rollouts wait in late sweeps, no other work
starts.
"""

import argparse
import time
from collections import Counter
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum

import msgspec
import numpy as np

LONGEST_PERIOD_S = 10.0  # after which a rollout or identification that was put off is due [s]
EARLY_FRACTION = 0.9  # share of a period after which dependent work is due, so that jitter does not skip a cycle [-]


class Work(StrEnum):
    """Kinds of work in order of priority, highest first."""

    RENEW = "renew"
    PREDICT = "predict"
    IDENTIFY = "identify"
    ENSEMBLE = "ensemble"


@dataclass(frozen=True)
class Schedule:
    """Periods of work, and the size of an ensemble.

    Attributes:
        predict: between rollouts [s]
        identify: between identifications [s]
        ensemble: between ensembles [s]
        renew: between predictions extrapolated from the newest position without a new rollout; inf: none [s]
        members: rollouts per ensemble
        span: look-ahead of ensemble rollouts; beyond it, the spread grows by the method's growth law [s]
        departure: distance of the aircraft from the last rollout, in half-axes of its region, below which the next
            rollout is put off; 0: a rollout in every period [-]
        information: new information on the model, as a share of that of the last window, below which the next
            identification is put off; 0: an identification in every period [-]
    """

    predict: float = 1.0
    identify: float = 1.0
    ensemble: float = 10.0
    renew: float = float("inf")
    members: int = 24
    span: float = 180.0
    departure: float = 0.0
    information: float = 0.0

    @property
    def longest_predict(self) -> float:
        """Return the longest period between rollouts [s]."""
        return max(self.predict, LONGEST_PERIOD_S) if self.departure else self.predict

    @property
    def longest_identify(self) -> float:
        """Return the longest period between identifications [s]."""
        return max(self.identify, LONGEST_PERIOD_S) if self.information else self.identify


LIVE_SCHEDULE = Schedule(ensemble=20.0, renew=1.0, departure=0.5, information=0.2)
"""Schedule of a worker: heavy work where it changes the result. Its loss of accuracy: `tests/bench/schedule.py`."""

# of all other fields: `_PERIOD_LIMITS`
_LIMITS = {"members": (12, 1000), "span": (10.0, 180.0), "departure": (0.0, 10.0), "information": (0.0, 10.0)}
_PERIOD_LIMITS = (0.02, 3600.0)  # [s]


def parse_schedule(text: str) -> Schedule:
    """Parse `--pace predict=2,identify=5,members=50`.

    Raises:
        argparse.ArgumentTypeError: when a name or a value is invalid; argparse prints the message.
    """
    names = [field.name for field in fields(Schedule)]
    values = {}
    for part in text.split(","):
        name, _, seconds = part.partition("=")
        try:
            values[name] = float(seconds)
        except ValueError:
            values[name] = float("nan")
        low, high = _LIMITS.get(name, _PERIOD_LIMITS)
        if name not in names or not low <= values[name] <= high:
            error_text = (
                f"found {part!r}, expected one of {', '.join(names)}, {low:g} to {high:g}, e.g. identify=5; correct it"
            )
            raise argparse.ArgumentTypeError(error_text)
    members = int(values.pop("members", LIVE_SCHEDULE.members))
    return replace(LIVE_SCHEDULE, **values, members=members)  # type: ignore[arg-type]


class Timer(msgspec.Struct):
    """When a task was last done. It is due after its period, and also when the clock was set back.

    Attributes:
        last: time of the last run [s since 1970]; -inf before any
    """

    last: float = -np.inf

    def due(self, now: float, period: float) -> bool:
        """Return whether the task is due at `now`, `period` after its last run [s]."""
        return not self.last <= now < self.last + period

    def restart(self, now: float) -> None:
        """Start a period at `now`."""
        self.last = now

    def expire(self) -> None:
        """Make the task due at once."""
        self.last = -np.inf


WORK_PER_SWEEP_S = 0.05  # heavy work per sweep, CPU [s]
LATE_WORK_S = 1.0  # the same in a late sweep, at most: where sweeps are long, a smaller limit would starve rollouts
MIN_WORK_S = 1e-3  # minimum in a late sweep, so that heavy work continues [s]
OVERLOAD_CPU_S = 1.0  # CPU time of a sweep from which telemetry arrives faster than it is processed [s]
LATE_CPU_FRACTION = 0.5  # share of this thread's CPU time for heavy work while sweeps are late [-]
_RECOVERY_FACTOR = 1.2  # recovery factor per sweep on time [-]
_START_FRACTION = {Work.PREDICT: 1.0, Work.IDENTIFY: 0.7, Work.ENSEMBLE: 0.5}  # of the limit [-]


@dataclass
class ComputeBudget:
    """Heavy work that may start in one sweep; unlimited by default.

    Attributes:
        limit: heavy work per sweep, CPU [s]; an overrun is deducted from the next sweep
        max_limit: limit while telemetry is on time, CPU [s]; late sweeps have a share of their own length
        rollouts_only: an aircraft has no prediction yet, or is handed over; no other work starts
        backlog: telemetry of this aircraft is queued; a prediction made now would be outdated
        overloaded: telemetry arrives faster than it is processed; only the newest counts
        offloaded: kinds of work that another thread does
        done, refused: number of starts and refusals of each kind
    """

    limit: float = float("inf")
    max_limit: float = WORK_PER_SWEEP_S
    rollouts_only: bool = False
    backlog: bool = False
    overloaded: bool = False
    offloaded: frozenset[Work] = frozenset()
    done: Counter[Work] = field(default_factory=Counter)
    refused: Counter[Work] = field(default_factory=Counter)
    _spent: float = 0.0
    _work_started: float | None = None  # start of the running work, thread CPU time [s]
    _last_sweep_late: bool = False  # the previous sweep was late
    _rollout_was_refused: bool = False  # a rollout was refused in the previous sweep
    _rollout_refused: bool = False  # a rollout was refused in this sweep
    _sweep_start_cpu: float = float("nan")  # CPU time of this thread at the start of the sweep [s]

    @property
    def limited(self) -> bool:
        """Return whether a limit applies; offline runs have none."""
        return self.limit < float("inf")

    def begin_sweep(self, *, rollouts_only: bool = False) -> None:
        """Begin another sweep."""
        self.end_work()
        self._rollout_was_refused, self._rollout_refused = self._rollout_refused, False
        self._spent, self.rollouts_only = max(self._spent - self.limit, 0.0), rollouts_only and self.limited

    def yield_to_telemetry(self, late: bool) -> None:
        """Set the limit to a share of the last sweep's CPU time if it was late; raise it slowly otherwise."""
        limit, now = min(self.limit, self.max_limit), time.thread_time()
        used, self._sweep_start_cpu, self._last_sweep_late = now - self._sweep_start_cpu, now, late
        self.overloaded = late and used > OVERLOAD_CPU_S
        if not late:
            self.limit = min(_RECOVERY_FACTOR * limit, self.max_limit)
        elif used == used:
            self.limit = min(max(LATE_CPU_FRACTION * used, MIN_WORK_S), LATE_WORK_S)

    def end_work(self) -> None:
        """Stop the measurement of the running work, if any."""
        if self._work_started is not None:
            self._spent += time.thread_time() - self._work_started
            self._work_started = None

    def try_acquire(self, work: Work) -> bool:
        """Return whether due work may start, and start its measurement."""
        if work in self.offloaded or (self.backlog and self.limited):
            return False
        if work is Work.RENEW:
            return True
        self.end_work()
        rollouts_only = self.rollouts_only or (self._last_sweep_late and self._rollout_was_refused)
        granted = self._spent < self.limit * _START_FRACTION[work] and not (rollouts_only and work is not Work.PREDICT)
        self._rollout_refused |= work is Work.PREDICT and not granted
        (self.done if granted else self.refused)[work] += 1
        if granted:
            self._work_started = time.thread_time()
        return granted
