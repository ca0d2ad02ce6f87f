"""Serve counters to Prometheus: plain text over HTTP, on request."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any, NamedTuple, get_type_hints

from prometheus_client import CollectorRegistry, ProcessCollector, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from fleet.contract import Link, meaning

Families = Callable[[], Iterable[Metric]]


class Naming(NamedTuple):
    """Mapping of the fields of a message class to metrics.

    Attributes:
        prefix: of the metric names
        labels: names of the labels that distinguish the messages
        gauges: fields that are gauges; the other numbers are counters
        renamed: metric names that differ from the field name
        excluded: fields without a metric
    """

    prefix: str
    labels: tuple[str, ...] = ()
    now: Collection[str] = ()
    other: Mapping[str, str] = MappingProxyType({})
    left_out: Collection[str] = ("t", "uav")


def families(kind: type, told: list[tuple[tuple[str, ...], Any]], naming: Naming) -> Iterator[Metric]:
    """Yield a metric for every number and flag of a message class; messages: (label values, message)."""
    for name, hint in get_type_hints(kind, include_extras=True).items():
        values = [(who, _number(getattr(message, name))) for who, message in told]
        known = [(who, value) for who, value in values if value is not None]
        if not known or name in naming.left_out:
            continue
        family = GaugeMetricFamily if name in naming.now else CounterMetricFamily
        what = naming.other.get(name, name)
        metric = family(f"{naming.prefix}_{what}", meaning(hint) or name, labels=naming.labels)
        for who, value in known:
            metric.add_metric(who, value)
        yield metric


def _number(value: Any) -> float | None:
    if isinstance(value, Link):
        return float(value is Link.LIVE)
    return float(value) if isinstance(value, bool | int | float) else None


class _Collector:
    """Read the newest counters at every scrape."""

    def __init__(self, told: Families) -> None:
        self._told = told

    def collect(self) -> Iterable[Metric]:
        return self._told()


def address(where: str) -> tuple[str, int]:
    """Parse `HOST:PORT`.

    Raises:
        ValueError: when it is malformed.
    """
    host, _, port = where.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65_535:
        raise ValueError(f"--metrics: found {where!r}, expected HOST:PORT such as 127.0.0.1:9100; correct it")
    return host, int(port)


@contextmanager
def served(where: str, told: Families) -> Iterator[str]:
    """Serve the metrics, and CPU and memory of this process, at `HOST:PORT` within the block; yield the URL.

    Raises:
        ValueError: when the address is malformed.
        OSError: when it is not free.
    """
    host, port = address(where)
    registry = CollectorRegistry()
    registry.register(_Collector(told))  # type: ignore[arg-type]
    ProcessCollector(registry=registry)
    try:
        server, thread = start_http_server(port, host.strip("[]"), registry)
    except OSError as error:
        raise OSError(f"--metrics: {where} is not free ({error.strerror or error}); name another port") from None
    try:
        yield f"http://{host}:{server.server_address[1]}/metrics"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
