"""Statistics of one gateway, collected from its links once a second."""

import platform
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from fleet import SOURCES
from fleet.contract import GatewayCounters, LinkCounters, Status
from fleet.metrics import Families, MetricNaming, families
from fleet.telemetry.mavlink.intake import MavlinkReceiver
from fleet.telemetry.mavlink.parsing.received import ReceivedBytes
from gateway.links.link import Endpoint
from gateway.onboard.rates import RateShare
from gateway.publication.publish import RouterSession, StatusSnapshot
from gateway.record.recorder import LinkRecorder, RecordingCounters

SMOOTHING = 0.3  # weight of the newest second in a rate
_PROC_FILES = (Path("/proc/net/udp"), Path("/proc/net/udp6"))


class _LinkTraffic:
    """Traffic counters and rates of one link."""

    def __init__(self) -> None:
        self.datagrams = self.bytes_in = self.sent = self.bytes_out = 0
        self.bytes_s = self.messages_hz = 0.0
        self._previous = (float("-inf"), 0, 0)

    def measure(self, t: float, messages: int) -> None:
        """Update the rates at `t` [s since 1970]."""
        previous_t, bytes_in, previous_messages = self._previous
        elapsed = t - previous_t
        self._previous = (t, self.bytes_in, messages)
        if 0 < elapsed < float("inf"):
            self.bytes_s += SMOOTHING * ((self.bytes_in - bytes_in) / elapsed - self.bytes_s)
            self.messages_hz += SMOOTHING * ((messages - previous_messages) / elapsed - self.messages_hz)


class StatisticsCollector:
    """Counters of bytes received, before decoding, and of bytes sent."""

    def __init__(self, links: Sequence[Endpoint], recorder: LinkRecorder | None = None) -> None:
        self._links, self._recorder = links, recorder
        self._flows = [_LinkTraffic() for _ in links]
        self._overruns: dict[int, int] = {}

    def add(self, link: int, received: ReceivedBytes) -> None:
        """Count received bytes of a link."""
        flow = self._flows[link]
        flow.datagrams += len(received.start)
        flow.bytes_in += int((received.stop - received.start).sum())

    def sent(self, link: int, size: int) -> None:
        """Count one datagram sent."""
        flow = self._flows[link]
        flow.sent += 1
        flow.bytes_out += size

    def account(
        self,
        t: float,
        intakes: Sequence[MavlinkReceiver],
        replayed: set[int],
        session: RouterSession,
        shares: Sequence[RateShare],
    ) -> GatewayCounters:
        """Return the statistics message; `t` is fleet time [s since 1970], `replayed` the UAV ids of recordings."""
        recordings = (
            self._recorder.counters() if self._recorder is not None else [RecordingCounters() for _ in self._links]
        )
        self._overruns = overruns()
        accounts = tuple(self._link(t, k, intakes[k], recordings[k], share) for k, share in enumerate(shares))
        refused: Counter[str] = Counter()
        uavs = set(replayed)
        for intake in intakes:
            refused.update(intake.rejected)
            uavs.update(aircraft.uav for aircraft in intake.aircraft.values())
        if dropped := sum(link.dropped for link in accounts):
            refused["dropped: decoding fell behind"] += dropped
        if unsent := sum(link.unsent for link in accounts):
            refused["not sent: no peer, or send queue full"] += unsent
        return GatewayCounters(
            t=t,
            links=tuple(link.link for link in accounts),
            uavs=tuple(sorted(uavs)),
            datagrams=sum(link.datagrams for link in accounts),
            bytes_in=sum(link.bytes_in for link in accounts),
            messages=sum(link.messages for link in accounts),
            bad_bytes=sum(link.bad_bytes for link in accounts),
            bad_frames=sum(link.bad_frames for link in accounts),
            refused=dict(refused),
            sentence="" if uavs else "no aircraft received yet; send its telemetry to one of the links",
            per_link=accounts,
            published=session.published,
            unsent=session.unsent,
            unconfirmed=session.unconfirmed,
            router=session.connected,
            removed=self._recorder.budget.removed if self._recorder is not None else 0,
            wall_t=time.time(),
            machine=platform.node(),
            code=SOURCES,
        )

    def _link(
        self, t: float, number: int, intake: MavlinkReceiver, recording: RecordingCounters, share: RateShare
    ) -> LinkCounters:
        flow, link, counts = self._flows[number], self._links[number], intake.counters()
        flow.measure(t, counts["messages"])
        return LinkCounters(
            link=link.spec.text,
            datagrams=flow.datagrams,
            bytes_in=flow.bytes_in,
            messages=counts["messages"],
            bad_bytes=counts["bad_bytes"],
            bad_frames=counts["bad_frames"] + counts["unknown"],
            dropped=link.dropped,
            overrun=self._overruns.get(link.spec.port) if link.spec.kind == "udpin" else None,
            sent=flow.sent,
            bytes_out=flow.bytes_out,
            unsent=link.unsent,
            bytes_s=round(flow.bytes_s, 1),
            messages_hz=round(flow.messages_hz, 1),
            recorded=recording.recorded,
            noise=recording.noise,
            unrecorded=recording.lost + recording.dropped,
            unwritten=recording.waiting,
            rate_fraction=share.value,
            sentence="; ".join(filter(None, (recording.fault, share.sentence, getattr(link, "damage", "")))),
        )


def overruns(files: Sequence[Path] = _PROC_FILES) -> Counter[int]:
    """Return the datagrams dropped by the system at each UDP port because of a full buffer; empty if unknown."""
    dropped: Counter[int] = Counter()
    for path in files:
        try:
            rows = [row.split() for row in path.read_text().splitlines()[1:]]
        except OSError:  # not Linux
            continue
        for row in rows:
            dropped[int(row[1].rpartition(":")[2], 16)] += int(row[-1])
    return dropped


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
