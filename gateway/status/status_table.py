"""Status display: a live table on a terminal; otherwise a line periodically and at every change of warnings."""

import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial

from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from fleet.contract import GatewayCounters, Link, Status
from fleet.process.sanitise import printable
from fleet.report.progress import run_alongside
from gateway.publication.publish import StatusSnapshot
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
    due, reported = time.monotonic() + PLAIN_S, ""
    while not done.wait(REFRESH_S):
        account, statuses = snapshot()
        if account is None:
            continue
        sentences = "; ".join(link.sentence for link in account.per_link if link.sentence)
        if sentences != reported:
            reported = sentences
            report(sentences or "all links are normal again")
        if time.monotonic() >= due:
            due = time.monotonic() + PLAIN_S
            report(format_line(account, statuses))


def format_line(account: GatewayCounters, statuses: list[Status]) -> str:
    """Format the statistics in one line."""
    lost = sum(status.link is Link.LOST for status in statuses)
    rate = sum(link.messages_hz for link in account.per_link)
    text = f"{len(account.uavs)} aircraft{f', {lost} of them lost' if lost else ''}, {rate:.0f} messages/s"
    counts = {
        "bad frames": account.bad_frames,
        "refused": sum(account.refused.values()),
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
    parts: list[Text | Table] = [
        Text(format_line(account, statuses)),
        _links(account),
        *([_uavs(statuses)] if statuses else []),
    ]
    return Group(*parts, *(Text(f"! {printable(warning)}") for warning in warnings))


def _links(account: GatewayCounters) -> Table:
    table = _columns(
        "link", "bytes/s", "messages/s", "bad frames", "bad bytes", "dropped", "overrun", "sent", "recorded"
    )
    for link in account.per_link:
        numbers = (
            link.bad_frames,
            link.bad_bytes,
            link.dropped,
            "-" if link.overrun is None else link.overrun,
            link.sent,
        )
        size_text = format_size(link.recorded) + (f" (-{format_size(link.unrecorded)})" if link.unrecorded else "")
        rates = (format_size(link.bytes_s), f"{link.messages_hz:.0f}")
        recorded_text = size_text if link.recorded or link.unrecorded else "-"
        table.add_row(escape(printable(link.link)), *rates, *map(str, numbers), recorded_text)
    return table


def _uavs(statuses: list[Status]) -> Table:
    table = _columns(
        "UAV", "link", "mode", "messages/s", "received", "missed", "rejected", "latency ms", "round trip ms"
    )
    table.add_column("", overflow="fold")
    shown = sorted(statuses, key=lambda s: (s.link is Link.LIVE and not s.sentence, s.uav))[:MAX_UAVS_SHOWN]
    for s in sorted(shown, key=lambda s: s.uav):
        later = f"{s.latency_s * 1e3:.0f} ({s.latency_worst_s * 1e3:.0f})"
        trip = "-" if s.round_trip_s is None else f"{s.round_trip_s * 1e3:.0f}"
        counts = (f"{sum(s.rates_hz.values()):.0f}", str(s.received), str(s.missed), str(s.rejected))
        table.add_row(
            str(s.uav), s.link.value, escape(printable(s.mode)), *counts, later, trip, escape(printable(s.sentence))
        )
    if len(statuses) > len(shown):
        table.caption = f"{len(statuses) - len(shown)} more without warnings"
    return table


def _columns(first: str, *others: str) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column(first)
    for name in others:
        table.add_column(name, justify="left" if name in ("link", "mode") else "right")
    return table
