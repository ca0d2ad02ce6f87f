"""Measure the actual rates of heavy work, describe those that are too low, and export metrics."""

from collections import Counter, deque
from collections.abc import Callable, Iterator

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from fleet.bus.session import Bus
from fleet.contract import FleetRow, FleetState, TwinState
from fleet.metrics import Families, MetricNaming, families
from twin_worker.twin.state.budget import Schedule, Work

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


_INSTANT_FIELDS = {"horizon_s", "sample_age_s", "prediction_age_s", "t10_s", "t10_censored", "t10_n", "epoch"}
_TWIN = MetricNaming("parauav_twin", ("uav",), _INSTANT_FIELDS)


def counters(state: Callable[[], FleetState], bus: Bus) -> Families:
    """Return the metric families of a worker."""
    return lambda: _counters(state(), bus)


def _counters(state: FleetState, bus: Bus) -> Iterator[Metric]:
    yield GaugeMetricFamily("parauav_worker_uavs", "owned aircraft", len(state.rows))
    yield GaugeMetricFamily("parauav_worker_router", "1 if a router is connected", float(bool(bus.router)))
    yield CounterMetricFamily("parauav_worker_undecodable", "messages that cannot be decoded", bus.bad)
    yield CounterMetricFamily("parauav_worker_dropped_messages", "messages dropped, inbox full", state.dropped_messages)
    work_counter = CounterMetricFamily("parauav_worker_tasks", "completed heavy work", labels=["work"])
    for work, count in state.tasks.items():
        work_counter.add_metric([work], count)
    yield work_counter
    yield from families(FleetRow, [((str(row.uav),), row) for row in state.rows], _TWIN)
    states = GaugeMetricFamily("parauav_worker_state", "aircraft in each state", labels=["state"])
    for twin_state in TwinState:
        states.add_metric([twin_state.value], sum(row.state is twin_state for row in state.rows))
    yield states
    fits = GaugeMetricFamily("parauav_twin_fit_ratio", "fit on held-out data", labels=["uav", "state"])
    alerts = GaugeMetricFamily("parauav_twin_alerts", "active alerts", labels=["uav"])
    mismatch = GaugeMetricFamily("parauav_twin_mismatch", "1 if a mismatch is detected", labels=["uav"])
    for row in state.rows:
        for name, fit in row.fit.items():
            fits.add_metric([str(row.uav), name], fit / 100.0)
        alerts.add_metric([str(row.uav)], len(row.alerts))
        mismatch.add_metric([str(row.uav)], float(bool(row.mismatch)))
    yield from (fits, alerts, mismatch)
