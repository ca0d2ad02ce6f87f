"""Measure the actual rates of heavy work, describe those that are too low, and export metrics."""

import os
from collections import Counter, deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from fleet.bus.session import Bus
from fleet.contract import FleetRow, FleetState, TwinState
from fleet.metrics import Families, MetricNaming, families
from twin_worker.twin.state.budget import Schedule, Work

RATE_WINDOW_S = 30.0  # averaging time of the rates [s]
_OVERLOAD_FACTOR = 1.3  # ratio of actual to scheduled period that is reported [-]
_MAX_EVENTS = 20_000


class CpuTimes(NamedTuple):
    """CPU times since the start [s]."""

    own: float  # of this process and its ended children
    used: float  # of all programs on all cores, the hypervisor's share included
    total: float  # used and idle


def read_cpu_times() -> CpuTimes | None:
    """Read the CPU times; None where the system does not report them. Source: proc(5), /proc/stat."""
    try:
        fields = Path("/proc/stat").read_text(encoding="ascii").partition("\n")[0].split()[1:9]
        user, nice, system, idle, wait, irq, softirq, steal = (int(x) / os.sysconf("SC_CLK_TCK") for x in fields)
    except (OSError, ValueError):
        return None
    used = user + nice + system + irq + softirq + steal
    return CpuTimes(sum(os.times()[:4]), used, used + idle + wait)


class WorkRates:
    """Work of one worker: recent rates and totals."""

    def __init__(self, cpu_times: Callable[[], CpuTimes | None] = read_cpu_times) -> None:
        self._cpu_times = cpu_times
        self._cpu: deque[tuple[float, CpuTimes]] = deque(maxlen=_MAX_EVENTS)  # monotonic [s]
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
        scheduled = {Work.PREDICT: schedule.longest_predict, Work.IDENTIFY: schedule.longest_identify}
        periods = {work: self.period(work, aircraft, now) for work in scheduled}
        late = [
            _period_text(work, periods[work], scheduled[work])
            for work in scheduled
            if periods[work] > _OVERLOAD_FACTOR * max(scheduled[work], 1.0)
        ]
        others = self._others_share(now)
        if not late:
            return []
        if others is not None and others > 0.5:
            usage = f"other programs use {others:.0%} of this machine's CPU: {', '.join(late)}"
            return [f"{usage}; stop them, or move this worker"]
        return [f"too many UAVs for this worker: {', '.join(late)}"]

    def _others_share(self, now: float) -> float | None:
        """Return the share of all cores that other programs used in the window, 0..1; None where it is unknown."""
        if (times := self._cpu_times()) is None:
            return None
        while self._cpu and self._cpu[0][0] < now - RATE_WINDOW_S:
            self._cpu.popleft()
        self._cpu.append((now, times))
        first = self._cpu[0][1]
        if times.total - first.total < 1.0:
            return None
        return max(times.used - first.used - (times.own - first.own), 0.0) / (times.total - first.total)


def _period_text(work: Work, period_s: float, scheduled_s: float) -> str:
    """Describe the period of late work."""
    if period_s == float("inf"):
        return f"no {work.value} for {RATE_WINDOW_S:.0f} s instead of every {scheduled_s:.1f} s"
    return f"{work.value} every {period_s:.1f} s instead of {scheduled_s:.1f} s"


_INSTANT_FIELDS = {"horizon_s", "sample_age_s", "prediction_age_s", "t10_s", "t10_censored", "t10_n", "epoch"}
_TWIN = MetricNaming("parauav_twin", ("uav",), _INSTANT_FIELDS)


def counters(state: Callable[[], FleetState], bus: Bus) -> Families:
    """Return the metric families of a worker."""
    return lambda: _counters(state(), bus)


def _counters(state: FleetState, bus: Bus) -> Iterator[Metric]:
    yield GaugeMetricFamily("parauav_worker_uavs", "owned aircraft", len(state.rows))
    yield GaugeMetricFamily("parauav_worker_router", "1 if a router is connected", float(bool(bus.router)))
    yield CounterMetricFamily("parauav_worker_undecodable", "messages that cannot be decoded", bus.bad)
    yield CounterMetricFamily("parauav_worker_dropped_messages", "messages dropped, overload", state.dropped_messages)
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
