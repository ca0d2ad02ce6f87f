"""Measure the actual rates of heavy work, and describe those that are too low."""

from collections import Counter, deque

from twin_worker.twin.state.schedule import Pace, Work

OVER_S = 30.0  # averaging time of the rates [s]
_LATE = 1.3  # ratio of actual to scheduled period that is reported [-]
_MOST = 20_000


class Rates:
    """Work of one worker: recent rates and totals."""

    def __init__(self) -> None:
        self._done: dict[Work, deque[float]] = {work: deque(maxlen=_MOST) for work in Work}
        self._since: float | None = None
        self.total: Counter[Work] = Counter()

    def note(self, work: Work, now: float, times: int = 1) -> None:
        """Record work done at `now`, monotonic [s]."""
        self._since = now if self._since is None else self._since
        self._done[work].extend([now] * times)
        self.total[work] += times

    def period(self, work: Work, aircraft: int, now: float) -> float:
        """Return the mean period of the work per aircraft [s]; 0: not known yet, inf: never."""
        if self._since is None or now - self._since < OVER_S:
            return 0.0
        done = self._done[work]
        while done and done[0] < now - OVER_S:
            done.popleft()
        return aircraft * OVER_S / len(done) if done else float("inf")

    def said(self, pace: Pace, aircraft: int, now: float) -> list[str]:
        """Describe the work that is less frequent than scheduled; empty if there is none."""
        wanted = {Work.PREDICT: pace.predict, Work.IDENTIFY: pace.identify}
        found = {work: self.period(work, aircraft, now) for work in wanted}
        late = [
            f"{work.value} every {found[work]:.1f} s instead of {wanted[work]:.1f} s"
            for work in wanted
            if found[work] > _LATE * max(wanted[work], 1.0)
        ]
        return [f"too many UAVs for this worker: {', '.join(late)}"] if late else []
