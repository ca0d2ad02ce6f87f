"""Measure the actual rates of heavy work, and describe those that are too low."""

from collections import Counter, deque

from twin_worker.twin.state.schedule import Schedule, Work

RATE_WINDOW_S = 30.0  # averaging time of the rates [s]
_OVERLOAD_FACTOR = 1.3  # ratio of actual to scheduled period that is reported [-]
_MAX_EVENTS = 20_000


class WorkRates:
    """Work of one worker: recent rates and totals."""

    def __init__(self) -> None:
        self._done: dict[Work, deque[float]] = {work: deque(maxlen=_MAX_EVENTS) for work in Work}
        self._since: float | None = None
        self.total: Counter[Work] = Counter()

    def record(self, work: Work, now: float, count: int = 1) -> None:
        """Record work done at `now`, monotonic [s]."""
        self._since = now if self._since is None else self._since
        self._done[work].extend([now] * count)
        self.total[work] += count

    def period(self, work: Work, aircraft: int, now: float) -> float:
        """Return the mean period of the work per aircraft [s]; 0: not known yet, inf: never."""
        if self._since is None or now - self._since < RATE_WINDOW_S:
            return 0.0
        done = self._done[work]
        while done and done[0] < now - RATE_WINDOW_S:
            done.popleft()
        return aircraft * RATE_WINDOW_S / len(done) if done else float("inf")

    def overload_messages(self, schedule: Schedule, aircraft: int, now: float) -> list[str]:
        """Describe the work that is less frequent than scheduled; empty if there is none."""
        scheduled = {Work.PREDICT: schedule.predict, Work.IDENTIFY: schedule.identify}
        periods = {work: self.period(work, aircraft, now) for work in scheduled}
        late = [
            f"{work.value} every {periods[work]:.1f} s instead of {scheduled[work]:.1f} s"
            for work in scheduled
            if periods[work] > _OVERLOAD_FACTOR * max(scheduled[work], 1.0)
        ]
        return [f"too many UAVs for this worker: {', '.join(late)}"] if late else []
