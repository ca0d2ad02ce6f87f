"""Export a worker's Prometheus metrics: owned aircraft, data age, completed work, dropped messages."""

from collections.abc import Callable, Iterator
from typing import Protocol

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from fleet.contract import FleetRow, FleetState, TwinState
from fleet.metrics import Families, MetricNaming, families

_INSTANT_FIELDS = {"horizon_s", "sample_age_s", "prediction_age_s", "t10_s", "t10_censored", "t10_n", "epoch"}
_TWIN = MetricNaming("parauav_twin", ("uav",), _INSTANT_FIELDS)


class BusStatus(Protocol):
    """Bus attributes used for metrics."""

    bad: int

    @property
    def router(self) -> str:
        """Return the router's address; empty if not connected."""


def counters(state: Callable[[], FleetState], bus: BusStatus) -> Families:
    """Return the metric families of a worker."""
    return lambda: _counters(state(), bus)


def _counters(state: FleetState, bus: BusStatus) -> Iterator[Metric]:
    yield GaugeMetricFamily("parauav_worker_uavs", "owned aircraft", len(state.rows))
    yield GaugeMetricFamily("parauav_worker_router", "1 if a router is connected", float(bool(bus.router)))
    yield CounterMetricFamily("parauav_worker_undecodable", "messages that cannot be decoded", bus.bad)
    yield CounterMetricFamily("parauav_worker_dropped_messages", "messages dropped, inbox full", state.dropped_messages)
    work_counter = CounterMetricFamily("parauav_worker_tasks", "completed heavy work", labels=["work"])
    for work, count in state.tasks.items():
        work_counter.add_metric([work], count)
    yield work_counter
    yield from families(FleetRow, [((str(row.uav),), row) for row in state.rows], _TWIN)
    yield from _state_metrics(state.rows)


def _state_metrics(rows: tuple[FleetRow, ...]) -> Iterator[Metric]:
    states = GaugeMetricFamily("parauav_worker_state", "aircraft in each state", labels=["state"])
    for state in TwinState:
        states.add_metric([state.value], sum(row.state is state for row in rows))
    yield states
    fits = GaugeMetricFamily("parauav_twin_fit_ratio", "fit on held-out data", labels=["uav", "state"])
    alerts = GaugeMetricFamily("parauav_twin_alerts", "active alerts", labels=["uav"])
    mismatch = GaugeMetricFamily("parauav_twin_mismatch", "1 if a mismatch is detected", labels=["uav"])
    for row in rows:
        for name, fit in row.fit.items():
            fits.add_metric([str(row.uav), name], fit / 100.0)
        alerts.add_metric([str(row.uav)], len(row.alerts))
        mismatch.add_metric([str(row.uav)], float(bool(row.mismatch)))
    yield from (fits, alerts, mismatch)
