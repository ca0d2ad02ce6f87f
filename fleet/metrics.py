"""Serve counters to Prometheus: plain text over HTTP, on request."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, get_origin, get_type_hints

from prometheus_client import CollectorRegistry, ProcessCollector, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from fleet.contract import Link, meaning

Families = Callable[[], Iterable[Metric]]
_UNITS = {"s": "seconds", "hz": "hertz"}


class MetricNaming(NamedTuple):
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
    gauges: Collection[str] = ()
    renamed: Mapping[str, str] = MappingProxyType({})
    excluded: Collection[str] = ("t", "uav")


def families(kind: type, messages: list[tuple[tuple[str, ...], Any]], naming: MetricNaming) -> Iterator[Metric]:
    """Yield a metric for every number and flag of a message class; messages: (label values, message)."""
    for name, hint in get_type_hints(kind, include_extras=True).items():
        values = [(label_values, _number(getattr(message, name))) for label_values, message in messages]
        available = [(label_values, value) for label_values, value in values if value is not None]
        if not available or name in naming.excluded or get_origin(hint) is ClassVar:
            continue
        family = GaugeMetricFamily if name in naming.gauges else CounterMetricFamily
        suffix = naming.renamed.get(name) or with_unit(name)
        metric = family(f"{naming.prefix}_{suffix}", meaning(hint) or name, labels=naming.labels)
        for label_values, value in available:
            metric.add_metric(label_values, value)
        yield metric


def with_unit(name: str) -> str:
    """Return a field name with its unit in full, e.g. `latency_seconds`.

    Source: Prometheus documentation, "Metric and label naming".
    """
    stem, _, unit = name.rpartition("_")
    return f"{stem}_{_UNITS[unit]}" if stem and unit in _UNITS else name


def _number(value: Any) -> float | None:
    if isinstance(value, Link):
        return float(value is Link.LIVE)
    return float(value) if isinstance(value, bool | int | float) else None


class _Collector:
    """Read the newest counters at every scrape."""

    def __init__(self, source: Families) -> None:
        self._source = source

    def collect(self) -> Iterable[Metric]:
        return self._source()


def parse_address(text: str) -> tuple[str, int]:
    """Parse `HOST:PORT`.

    Raises:
        ValueError: when it is malformed.
    """
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65_535:
        raise ValueError(f"--metrics: found {text!r}, expected HOST:PORT such as 127.0.0.1:9100; correct it")
    return host, int(port)


@contextmanager
def serve(endpoint: str, source: Families) -> Iterator[str]:
    """Serve the metrics, and CPU and memory of this process, at `HOST:PORT` within the block; yield the URL.

    Raises:
        ValueError: when the address is malformed.
        OSError: when it is not free.
    """
    host, port = parse_address(endpoint)
    registry = CollectorRegistry()
    registry.register(_Collector(source))  # type: ignore[arg-type]
    ProcessCollector(registry=registry)
    try:
        server, thread = start_http_server(port, host.strip("[]"), registry)
    except OSError as error:
        raise OSError(f"--metrics: {endpoint} is not free ({error.strerror or error}); name another port") from None
    try:
        yield f"http://{host}:{server.server_address[1]}/metrics"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
