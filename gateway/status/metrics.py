"""Prometheus metrics of the gateway."""

from collections.abc import Callable, Iterator

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from fleet.contract import Account, LinkAccount, Status
from fleet.metrics import Families, Naming, families
from gateway.publication.publish import Told

NOW = {"bytes_s", "messages_hz", "unwritten", "share", "router", "history_bytes", "link", "armed", "clock_offset_s"}
NOW |= {"clock_drift", "latency_s", "latency_worst_s", "round_trip_s", "gps_offset_s"}
_OTHER = {"overrun": "overrun_datagrams", "dropped": "dropped_datagrams", "sent": "sent_datagrams"}
_LEFT = {"t", "now", "datagrams", "bytes_in", "messages", "bad_bytes", "bad_frames"}  # exported per link
_GATEWAY = Naming("parauav_gateway", now=NOW, other=_OTHER, left_out=_LEFT)
_LINK = Naming("parauav_link", ("link",), NOW, _OTHER)
_UAV = Naming("parauav_uav", ("uav",), NOW, _OTHER)


def counters(told: Callable[[], Told]) -> Families:
    """Return the collector of the gateway's metrics."""
    return lambda: _counters(*told())


def _counters(account: Account | None, statuses: list[Status]) -> Iterator[Metric]:
    if account is not None:
        yield from families(Account, [((), account)], _GATEWAY)
        yield from families(LinkAccount, [((link.link,), link) for link in account.per_link], _LINK)
        refused = CounterMetricFamily("parauav_gateway_refused", "good frames refused, by reason", labels=["reason"])
        for reason, count in account.refused.items():
            refused.add_metric([reason], count)
        yield refused
        yield GaugeMetricFamily("parauav_gateway_uavs", "aircraft received", len(account.uavs))
    rates = GaugeMetricFamily("parauav_uav_rate_hz", "received of each message [Hz]", labels=["uav", "message"])
    for one in statuses:
        for name, hz in one.rates_hz.items():
            rates.add_metric([str(one.uav), name], hz)
    yield rates
    yield from families(Status, [((str(one.uav),), one) for one in statuses], _UAV)
