"""Statistics of links and aircraft: live table on a terminal, otherwise lines; published counters and metrics."""

import platform
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from fleet import SOURCES
from fleet.contract import GatewayCounters, Link, LinkCounters, Status
from fleet.metrics import Families, MetricNaming, families
from fleet.process.sanitise import printable
from fleet.report.progress import run_alongside
from fleet.telemetry.mavlink.intake import MavlinkReceiver
from fleet.telemetry.mavlink.parsing.received import ReceivedBytes
from gateway.links.link import Endpoint
from gateway.onboard import RequestSender
from gateway.publication import RouterSession, StatusSnapshot
from gateway.record.recorder import LinkRecorder, RecordingCounters
from gateway.record.tape import format_size

REFRESH_S = 1.0
PLAIN_S = 30.0  # between lines where the output is not a terminal [s]
MAX_UAVS_SHOWN = 40  # UAVs shown, those with warnings first


def status_display(
    snapshot: Callable[[], StatusSnapshot], report: Callable[[str], None], console: Console | None = None
) -> AbstractContextManager[None]:
    """Show the status until the block ends.

    Args:
        snapshot: returns the newest statistics; called on a separate thread
        report: prints a line where there is no terminal
        console: the terminal; None without one
    """
    return run_alongside(
        partial(_print_lines, report, snapshot) if console is None else partial(_table, console, snapshot)
    )


def _table(console: Console, snapshot: Callable[[], StatusSnapshot], done: threading.Event) -> None:
    with Live(console=console, auto_refresh=False) as live:
        finished = False
        while not finished:
            finished = done.wait(REFRESH_S)
            account, statuses = snapshot()
            if account is not None:
                live.update(render(account, statuses), refresh=True)


def _print_lines(report: Callable[[str], None], snapshot: Callable[[], StatusSnapshot], done: threading.Event) -> None:
    due, reported, uavs = time.monotonic() + PLAIN_S, "", 0
    while not done.wait(REFRESH_S):
        account, statuses = snapshot()
        if account is None:
            continue
        sentences = "; ".join(link.sentence for link in account.per_link if link.sentence)
        if sentences != reported:
            reported = sentences
            report(sentences or "all links are normal again")
        if time.monotonic() >= due or len(account.uavs) != uavs:
            due, uavs = time.monotonic() + PLAIN_S, len(account.uavs)
            report(format_line(account, statuses))


def format_line(account: GatewayCounters, statuses: list[Status]) -> str:
    """Format the statistics in one line."""
    lost = sum(status.link is Link.LOST for status in statuses)
    rate = sum(link.messages_hz for link in account.per_link)
    text = f"{len(account.uavs)} aircraft{f', {lost} of them lost' if lost else ''}, {rate:.0f} messages/s"
    counts = {
        "bad frames": account.bad_frames,
        **{f"messages refused ({reason})": n for reason, n in account.refused.items()},
        "missing by sequence number": sum(status.missed for status in statuses),
        "lost in the socket buffer": sum(link.overrun or 0 for link in account.per_link),
        "unsent without a router": account.unsent,
    }
    text += "".join(f", {count:,} {label}" for label, count in counts.items() if count)
    recorded = sum(link.recorded for link in account.per_link)
    unrecorded = sum(link.unrecorded for link in account.per_link)
    text += f", {format_size(recorded)} recorded" if recorded else ""
    text += f", {format_size(unrecorded)} not recorded" if unrecorded else ""
    return text if account.router else f"{text}; no router"


def render(account: GatewayCounters, statuses: list[Status]) -> Group:
    """Render the statistics as tables."""
    warnings = [link.sentence for link in account.per_link if link.sentence]
    warnings += [] if account.uavs or not account.sentence else [account.sentence]
    tables = [_links(account), *([_uavs(statuses)] if statuses else [])]
    return Group(
        Text(format_line(account, statuses)), *tables, *(Text(f"! {printable(warning)}") for warning in warnings)
    )


def _links(account: GatewayCounters) -> Table:
    titles = ("link", "bytes/s", "messages/s", "bad frames", "bad bytes", "dropped", "overrun", "sent", "recorded")
    table = _columns(*titles)
    for link in account.per_link:
        overrun = "-" if link.overrun is None else link.overrun
        counts = (link.bad_frames, link.bad_bytes, link.dropped, overrun, link.sent)
        recorded = format_size(link.recorded) if link.recorded or link.unrecorded else "-"
        recorded += f" (-{format_size(link.unrecorded)})" if link.unrecorded else ""
        rates = (format_size(link.bytes_s), f"{link.messages_hz:.0f}")
        table.add_row(escape(printable(link.link)), *rates, *map(str, counts), recorded)
    return table


def _uavs(statuses: list[Status]) -> Table:
    titles = ("UAV", "link", "mode", "messages/s", "received", "missed", "rejected", "latency ms", "round trip ms")
    table = _columns(*titles)
    table.add_column("", overflow="fold")
    shown = sorted(statuses, key=lambda s: (s.link is Link.LIVE and not s.sentence, s.uav))[:MAX_UAVS_SHOWN]
    for s in sorted(shown, key=lambda s: s.uav):
        later = f"{s.latency_s * 1e3:.0f} ({s.latency_worst_s * 1e3:.0f})"
        trip = "-" if s.round_trip_s is None else f"{s.round_trip_s * 1e3:.0f}"
        counts = (f"{sum(s.rates_hz.values()):.0f}", str(s.received), str(s.missed), str(s.rejected))
        mode, sentence = escape(printable(s.mode)), escape(printable(s.sentence))
        table.add_row(str(s.uav), s.link.value, mode, *counts, later, trip, sentence)
    if len(statuses) > len(shown):
        table.caption = f"{len(statuses) - len(shown)} more without warnings"
    return table


def _columns(first: str, *others: str) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column(first)
    for name in others:
        table.add_column(name, justify="left" if name in ("link", "mode") else "right")
    return table


SMOOTHING = 0.3  # weight of the newest second in a rate
_SUMMED = ("datagrams", "bytes_in", "messages", "bad_bytes", "bad_frames")  # over the links; exported per link
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
        requesters: Sequence[RequestSender],
    ) -> GatewayCounters:
        """Return the statistics message; `t` is fleet time [s since 1970], `replayed` the UAV ids of recordings."""
        recorder = self._recorder
        recordings = [RecordingCounters()] * len(self._links) if recorder is None else recorder.counters()
        self._overruns = overruns()
        rows = zip(intakes, recordings, requesters, strict=True)
        accounts = tuple(self._link(t, number, *row) for number, row in enumerate(rows))
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
            **{name: sum(getattr(link, name) for link in accounts) for name in _SUMMED},
            refused=dict(refused),
            sentence="" if uavs else "no aircraft received yet; send its telemetry to one of the links",
            per_link=accounts,
            published=session.published,
            unsent=session.unsent,
            unconfirmed=session.unconfirmed,
            router=session.connected,
            removed=0 if recorder is None else recorder.budget.removed,
            wall_t=time.time(),
            machine=platform.node(),
            code=SOURCES,
        )

    def _link(
        self, t: float, number: int, intake: MavlinkReceiver, recording: RecordingCounters, requester: RequestSender
    ) -> LinkCounters:
        flow, link, counts = self._flows[number], self._links[number], intake.decoder.counters()
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
            rate_fraction=requester.share,
            sentence="; ".join(filter(None, (recording.fault, requester.sentence, getattr(link, "damage", "")))),
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


GAUGES = {"bytes_s", "messages_hz", "unwritten", "rate_fraction", "router", "history_bytes", "link", "armed"}
GAUGES |= {"clock_offset_s", "clock_drift", "latency_s", "latency_worst_s", "round_trip_s", "gps_offset_s"}
_RENAMED = {"bytes_s": "bytes_per_second"}
_RENAMED |= {name: f"{name}_datagrams" for name in ("overrun", "dropped", "sent")}
_GATEWAY = MetricNaming("parauav_gateway", gauges=GAUGES, renamed=_RENAMED, excluded=("t", "wall_t", *_SUMMED))
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
