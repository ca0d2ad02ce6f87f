"""The counters as Prometheus reads them: plain text over HTTP, on request."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, get_type_hints

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from fleet.commands.schema import meaning
from fleet.contract import Account, Link, LinkAccount, Status
from gateway.publish import Told

NOW = {"bytes_s", "messages_hz", "unwritten", "share", "router", "history_bytes", "link", "armed", "clock_offset_s"}
NOW |= {"clock_drift", "latency_s", "latency_worst_s", "round_trip_s", "gps_offset_s"}
"""Fields that go up and down; the other numbers only grow."""
_NAMED = {"overrun": "overrun_datagrams", "dropped": "dropped_datagrams", "sent": "sent_datagrams"}
_IN_SUM = {
    "t",
    "datagrams",
    "bytes_in",
    "messages",
    "bad_bytes",
    "bad_frames",
}  # of the account: the sum over its links


class _Collector:
    """Read the newest counters whenever Prometheus asks."""

    def __init__(self, told: Callable[[], Told]) -> None:
        self._told = told

    def collect(self) -> Iterable[Metric]:
        account, statuses = self._told()
        if account is not None:
            yield from _families("parauav_gateway", Account, [((), account)], ())
            links = [((link.link,), link) for link in account.per_link]
            yield from _families("parauav_link", LinkAccount, links, ("link",))
            refused = CounterMetricFamily(
                "parauav_gateway_refused", "good frames refused, by reason", labels=["reason"]
            )
            for reason, count in account.refused.items():
                refused.add_metric([reason], count)
            yield refused
            yield GaugeMetricFamily("parauav_gateway_uavs", "aircraft heard", len(account.uavs))
        rates = GaugeMetricFamily("parauav_uav_rate_hz", "received of each message [Hz]", labels=["uav", "message"])
        for one in statuses:
            for name, hz in one.rates_hz.items():
                rates.add_metric([str(one.uav), name], hz)
        yield rates
        yield from _families("parauav_uav", Status, [((str(one.uav),), one) for one in statuses], ("uav",))


def _families(prefix: str, kind: type, told: list[Any], labels: tuple[str, ...]) -> Iterator[Metric]:
    """Make a metric of every number and flag of a message class; told: (label values, message)."""
    for name, hint in get_type_hints(kind, include_extras=True).items():
        values = [(who, _number(getattr(message, name))) for who, message in told]
        known = [(who, value) for who, value in values if value is not None]
        if not known or name in ("t", "uav") or (kind is Account and name in _IN_SUM):
            continue
        family = GaugeMetricFamily if name in NOW else CounterMetricFamily
        metric = family(f"{prefix}_{_NAMED.get(name, name)}", meaning(hint) or name, labels=labels)
        for who, value in known:
            metric.add_metric(who, value)
        yield metric


def _number(value: Any) -> float | None:
    if isinstance(value, Link):
        return float(value is Link.LIVE)
    return float(value) if isinstance(value, bool | int | float) else None


@contextmanager
def served(where: str, told: Callable[[], Told]) -> Iterator[str]:
    """Answer at `HOST:PORT` for as long as the block lasts; gives the address.

    Raises:
        ValueError: when it is no address.
        OSError: when it is not free.
    """
    host, _, port = where.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65_535:
        raise ValueError(f"--metrics: found {where!r}, expected HOST:PORT such as 127.0.0.1:9100; correct it")
    registry = CollectorRegistry()
    registry.register(_Collector(told))  # type: ignore[arg-type]
    try:
        server, thread = start_http_server(int(port), host.strip("[]"), registry)
    except OSError as error:
        raise OSError(f"--metrics: {where} is not free ({error.strerror or error}); name another port") from None
    try:
        yield f"http://{host}:{server.server_address[1]}/metrics"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
