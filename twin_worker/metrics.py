"""A worker's numbers as metrics: what it holds, how old that is, how often heavy work is done, what was shed."""

import time
from collections.abc import Iterator
from typing import Protocol

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from fleet.contract import FleetRow, FleetState, State
from fleet.metrics import Families, Naming, families
from twin_worker.engine.pace import Work
from twin_worker.engine.rates import Rates

_NOW = {"horizon_s", "sample_age_s", "prediction_age_s", "t10_s", "t10_censored", "t10_n", "epoch"}
_TWIN = Naming("parauav_twin", ("uav",), _NOW)


class Bussed(Protocol):
    """A worker's side of the bus."""

    bad: int

    @property
    def router(self) -> str:
        """Name the router; empty: none is there."""


class Told(Protocol):
    """Who tells its numbers: a `Worker`."""

    rates: Rates

    def state(self) -> FleetState:
        """Give the fleet table."""

    def shed(self) -> int:
        """Count the messages that found no room."""


def counters(worker: Told, bus: Bussed) -> Families:
    """Give what Prometheus is told."""
    return lambda: _counters(worker, bus)


def _counters(worker: Told, bus: Bussed) -> Iterator[Metric]:
    rows = worker.state().rows
    yield GaugeMetricFamily("parauav_worker_uavs", "aircraft held", len(rows))
    yield GaugeMetricFamily("parauav_worker_router", "a router is there", float(bool(bus.router)))
    yield CounterMetricFamily("parauav_worker_shed", "messages that found no room: too many aircraft", worker.shed())
    yield CounterMetricFamily("parauav_worker_undecodable", "messages heard that do not fit the contract", bus.bad)
    period = GaugeMetricFamily(
        "parauav_worker_period_s", "between two of this work on one aircraft, of late; inf: never [s]", labels=["work"]
    )
    for work in Work:
        period.add_metric([work.value], worker.rates.period(work, len(rows), time.monotonic()))
    yield period
    yield from families(FleetRow, [((str(row.uav),), row) for row in rows], _TWIN)
    yield from _judged(rows)


def _judged(rows: tuple[FleetRow, ...]) -> Iterator[Metric]:
    states = GaugeMetricFamily("parauav_worker_state", "aircraft in each state", labels=["state"])
    for state in State:
        states.add_metric([state.value], sum(row.state is state for row in rows))
    yield states
    fits = GaugeMetricFamily("parauav_twin_fit", "on unseen data, by state of the model [%]", labels=["uav", "of"])
    alerts = GaugeMetricFamily("parauav_twin_alerts", "alerts in force", labels=["uav"])
    mismatch = GaugeMetricFamily("parauav_twin_mismatch", "flight and twin part ways", labels=["uav"])
    for row in rows:
        for name, fit in row.fit.items():
            fits.add_metric([str(row.uav), name], fit)
        alerts.add_metric([str(row.uav)], len(row.alerts))
        mismatch.add_metric([str(row.uav)], float(bool(row.mismatch)))
    yield from (fits, alerts, mismatch)
