"""Prometheus metrics of the gateway."""

from collections.abc import Callable, Iterator

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from fleet.contract import GatewayCounters, LinkCounters, Status
from fleet.metrics import Families, MetricNaming, families
from gateway.publication.publish import StatusSnapshot

GAUGES = {
    "bytes_s",
    "messages_hz",
    "unwritten",
    "rate_fraction",
    "router",
    "history_bytes",
    "link",
    "armed",
    "clock_offset_s",
}
GAUGES |= {"clock_drift", "latency_s", "latency_worst_s", "round_trip_s", "gps_offset_s"}
_RENAMED = {
    "bytes_s": "bytes_per_second",
    "overrun": "overrun_datagrams",
    "dropped": "dropped_datagrams",
    "sent": "sent_datagrams",
}
_PER_LINK = {"t", "wall_t", "datagrams", "bytes_in", "messages", "bad_bytes", "bad_frames"}  # exported per link
_GATEWAY = MetricNaming("parauav_gateway", gauges=GAUGES, renamed=_RENAMED, excluded=_PER_LINK)
_LINK = MetricNaming("parauav_link", ("link",), GAUGES, _RENAMED)
_UAV = MetricNaming("parauav_uav", ("uav",), GAUGES, _RENAMED)


def counters(snapshot: Callable[[], StatusSnapshot]) -> Families:
    """Return the collector of the gateway's metrics."""
    return lambda: _metric_families(*snapshot())


def _metric_families(account: GatewayCounters | None, statuses: list[Status]) -> Iterator[Metric]:
    if account is not None:
        yield from families(GatewayCounters, [((), account)], _GATEWAY)
        yield from families(LinkCounters, [((link.link,), link) for link in account.per_link], _LINK)
        refused = CounterMetricFamily("parauav_gateway_refused", "good frames refused, by reason", labels=["reason"])
        for reason, count in account.refused.items():
            refused.add_metric([reason], count)
        yield refused
        yield GaugeMetricFamily("parauav_gateway_uavs", "aircraft received", len(account.uavs))
    rates = GaugeMetricFamily("parauav_uav_rate_hertz", "received of each message [Hz]", labels=["uav", "message"])
    for status in statuses:
        for name, hz in status.rates_hz.items():
            rates.add_metric([str(status.uav), name], hz)
    yield rates
    yield from families(Status, [((str(one.uav),), one) for one in statuses], _UAV)
