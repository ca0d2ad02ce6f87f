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

from fleet.contract import Account, Link, Status
from fleet.process.sanitise import plain
from fleet.report.progress import alongside
from gateway.publication.publish import Told
from gateway.record.size import in_words

REFRESH_S = 1.0
PLAIN_S = 30.0  # between lines where the output is not a terminal [s]
MOST_UAVS = 40  # UAVs shown, those with warnings first


def posted(
    told: Callable[[], Told], say: Callable[[str], None], console: Console | None = None
) -> AbstractContextManager[None]:
    """Show the status until the block ends.

    Args:
        snapshot: returns the newest statistics; called on a separate thread
        report: prints a line where there is no terminal
        console: the terminal; None without one
    """
    return alongside(partial(_lines, say, told) if console is None else partial(_table, console, told))


def _table(console: Console, told: Callable[[], Told], done: threading.Event) -> None:
    with Live(console=console, auto_refresh=False) as live:
        over = False
        while not over:
            over = done.wait(REFRESH_S)
            account, statuses = told()
            if account is not None:
                live.update(drawn(account, statuses), refresh=True)


def _lines(say: Callable[[str], None], told: Callable[[], Told], done: threading.Event) -> None:
    due, said = time.monotonic() + PLAIN_S, ""
    while not done.wait(REFRESH_S):
        account, statuses = told()
        if account is None:
            continue
        news = "; ".join(link.sentence for link in account.per_link if link.sentence)
        if news != said:
            said = news
            say(news or "all links are normal again")
        if time.monotonic() >= due:
            due = time.monotonic() + PLAIN_S
            say(in_line(account, statuses))


def in_line(account: Account, statuses: list[Status]) -> str:
    """Format the statistics in one line."""
    lost = sum(status.link is Link.LOST for status in statuses)
    rate = sum(link.messages_hz for link in account.per_link)
    said = f"{len(account.uavs)} aircraft{f', {lost} of them lost' if lost else ''}, {rate:.0f} messages/s"
    found = {
        "bad frames": account.bad_frames,
        "refused": sum(account.refused.values()),
        "missing by sequence number": sum(status.missed for status in statuses),
        "lost in the socket buffer": sum(link.overrun or 0 for link in account.per_link),
        "unsent without a router": account.unsent,
    }
    said += "".join(f", {count:,} {what}" for what, count in found.items() if count)
    recorded = sum(link.recorded for link in account.per_link)
    unrecorded = sum(link.unrecorded for link in account.per_link)
    said += f", {in_words(recorded)} recorded" if recorded else ""
    said += f", {in_words(unrecorded)} not recorded" if unrecorded else ""
    return said if account.router else f"{said}; no router"


def drawn(account: Account, statuses: list[Status]) -> Group:
    """Render the statistics as tables."""
    said = [link.sentence for link in account.per_link if link.sentence]
    said += [] if account.uavs or not account.sentence else [account.sentence]
    parts: list[Text | Table] = [
        Text(in_line(account, statuses)),
        _links(account),
        *([_uavs(statuses)] if statuses else []),
    ]
    return Group(*parts, *(Text(f"! {plain(one)}") for one in said))


def _links(account: Account) -> Table:
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
        taped = in_words(link.recorded) + (f" (-{in_words(link.unrecorded)})" if link.unrecorded else "")
        rates = (in_words(link.bytes_s), f"{link.messages_hz:.0f}")
        kept = taped if link.recorded or link.unrecorded else "-"
        table.add_row(escape(plain(link.link)), *rates, *map(str, numbers), kept)
    return table


def _uavs(statuses: list[Status]) -> Table:
    table = _columns(
        "UAV", "link", "mode", "messages/s", "received", "missed", "rejected", "latency ms", "round trip ms"
    )
    table.add_column("", overflow="fold")
    shown = sorted(statuses, key=lambda s: (s.link is Link.LIVE and not s.sentence, s.uav))[:MOST_UAVS]
    for s in sorted(shown, key=lambda s: s.uav):
        later = f"{s.latency_s * 1e3:.0f} ({s.latency_worst_s * 1e3:.0f})"
        trip = "-" if s.round_trip_s is None else f"{s.round_trip_s * 1e3:.0f}"
        counts = (f"{sum(s.rates_hz.values()):.0f}", str(s.received), str(s.missed), str(s.rejected))
        table.add_row(str(s.uav), s.link.value, escape(plain(s.mode)), *counts, later, trip, escape(plain(s.sentence)))
    if len(statuses) > len(shown):
        table.caption = f"{len(statuses) - len(shown)} more without warnings"
    return table


def _columns(first: str, *others: str) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column(first)
    for name in others:
        table.add_column(name, justify="left" if name in ("link", "mode") else "right")
    return table
