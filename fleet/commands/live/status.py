"""Show every UAV of a running fleet (state, fit, horizon, alerts, verdict) and the processes of each machine."""

import argparse
import json
import sys
import threading
import time
from collections.abc import Sequence
from math import atan2, degrees, hypot, isfinite

import msgspec
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from fleet.bus.codec import is_plausible_epoch
from fleet.bus.session import Bus, connect
from fleet.cli import stop_on_signal
from fleet.config import bus_config_from, router_arguments
from fleet.contract import (
    Claim,
    FleetRow,
    FleetState,
    GatewayCounters,
    Siblings,
    Status,
    TwinState,
    WindField,
    claimed_horizon_s,
)
from fleet.process.sanitise import printable
from fleet.report.report_text import id_ranges

STATE_COLOUR = {TwinState.VERIFIED: "green", TwinState.PLAUSIBLE: "yellow"}  # of the table; others: none
WATCH_S = 1.0  # pause between two queries of `--watch` [s]
LATE_S = 5.0  # an older prediction is shown in red; the viewer reports it as late from the same age on [s]
EXAMPLES = """
  fleet status
  fleet status --watch                          until Ctrl-C
  fleet status --json
  fleet status --router tcp/192.168.1.10:7447
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    router_arguments(parser)
    parser.add_argument("--json", action="store_true", help="a list of objects instead of a table")
    parser.add_argument("--watch", action="store_true", help="repeat every second until Ctrl-C")


def run(args: argparse.Namespace) -> int:
    """Query the fleet and print it, once or repeatedly; return exit code 1 if no UAV is known."""
    if args.json and args.watch:
        raise ValueError("--watch: found --json too, expected only one; drop one, or repeat `fleet status --json`")
    if args.watch:
        stop = stop_on_signal()
        with connect(bus_config_from(args)) as bus:
            return watch(bus, stop, Console())
    with connect(bus_config_from(args)) as bus:
        rows = fleet_rows(bus)
        if args.json:
            json.dump(as_objects(rows), sys.stdout, indent=1)
            print()
        else:
            Console().print(_overview(rows, processes(bus), (wind_text(bus), *sibling_texts(bus))))
    return 0 if rows else 1


def watch(bus: Bus, stop: threading.Event, console: Console) -> int:
    """Print the fleet every second until stopped; in place on a terminal, one below the other elsewhere."""
    rows: list[FleetRow] = []
    with Live(console=console, auto_refresh=False, vertical_overflow="crop") as live:
        while not stop.is_set():
            rows = fleet_rows(bus)
            heading = Text(f"{time.strftime('%H:%M:%S')}, every {WATCH_S:g} s until Ctrl-C", style="dim")
            view = Group(heading, _overview(rows, processes(bus), (wind_text(bus), *sibling_texts(bus))))
            if console.is_terminal:
                live.update(view, refresh=True)
            else:
                console.print(view)
            stop.wait(WATCH_S)
    return 0 if rows else 1


def _overview(rows: list[FleetRow], running: list[tuple[str, str, str, str]], shared: Sequence[str]) -> RenderableType:
    """Return the tables of aircraft and processes, and what the aircraft share."""
    empty = Text("no UAV known yet: is a gateway running and an aircraft connected?")
    parts: list[RenderableType] = [fleet_table(rows) if rows else empty]
    texts = [Text(text) for text in shared if text]
    parts += [Text(""), *texts] if texts else []
    return Group(*parts, Text(""), machines(running)) if running else Group(*parts)


def wind_text(bus: Bus) -> str:
    """Query the wind field and describe it; empty without one."""
    fields = [(stamp, one) for one, stamp in bus.get(WindField) if stamp and is_plausible_epoch(stamp.epoch)]
    if not fields:
        return ""
    newest = max(fields, key=lambda pair: pair[0])[1]
    north, east = newest.wind
    direction = degrees(atan2(-east, -north)) % 360.0
    return (
        f"wind field: {hypot(north, east):.1f} m/s from {direction:.0f}° at 100 m, ± {newest.wind_sigma:.1f} m/s, "
        f"estimated from {len(newest.uavs)} aircraft"
    )


def sibling_texts(bus: Bus) -> list[str]:
    """Query what aircraft of each type share; describe each type, and the aircraft that differ."""
    replies = [(stamp, one) for one, stamp in bus.get(Siblings) if stamp and is_plausible_epoch(stamp.epoch)]
    if not replies:
        return []
    types = max(replies, key=lambda pair: pair[0])[1].types
    texts = [f"{printable(one.airframe_type)}: {len(one.uavs)} aircraft share what they have learnt" for one in types]
    return texts + [printable(difference.sentence) for one in types for difference in one.differences]


def fleet_rows(bus: Bus, *, preparing: bool = False) -> list[FleetRow]:
    """Query the rows of every worker and add aircraft without a worker as unclaimed; `preparing`: one compiles."""
    best: dict[int, FleetRow] = {}
    states = list(bus.get(FleetState))
    for state, _ in states:
        for row in state.rows:
            current = best.get(row.uav)
            if not is_plausible_epoch(row.epoch):
                continue
            if current is None or (row.epoch, row.worker) > (current.epoch, current.worker):
                best[row.uav] = row
    sentence = "no worker owns this id: start `twin_worker` with a wider --uavs"
    if not states:
        sentence = (
            "no worker responds: its first start compiles for a minute or more; if none runs, start `twin_worker`"
        )
    if preparing:
        sentence = "its twin starts when the twin worker has compiled"
    for status, _ in bus.get(Status):
        best.setdefault(status.uav, FleetRow(uav=status.uav, state=TwinState.UNCLAIMED, verdict=sentence))
    return [best[uav] for uav in sorted(best)]


def processes(bus: Bus) -> list[tuple[str, str, str, str]]:
    """Query every gateway and worker and return rows of machine, process, aircraft, details."""
    rows = []
    for counters, _ in bus.get(GatewayCounters):
        details = [f"{sum(link.messages_hz for link in counters.per_link):.0f} messages/s", counters.sentence]
        details += [f"{link.link}: {link.sentence}" for link in counters.per_link if link.sentence]
        rows.append((counters.machine, "gateway", id_ranges(counters.uavs), "; ".join(filter(None, details))))
    worker_texts = {row.worker: state.sentence for state, _ in bus.get(FleetState) for row in state.rows}
    for claim, _ in bus.get(Claim):
        details = ["is leaving" if claim.leaving else "", worker_texts.get(claim.worker, "")]
        uavs = id_ranges(uav for uav, _ in claim.owned)
        rows.append((claim.machine, f"worker {claim.worker}", uavs, "; ".join(filter(None, details))))
    return sorted(rows)


def machines(rows: list[tuple[str, str, str, str]]) -> Table:
    """Format the processes as a table."""
    out = Table("machine", "process", "aircraft", "status", box=None, pad_edge=False)
    for row in rows:
        out.add_row(*(escape(printable(cell)) or "-" for cell in row))
    return out


def as_objects(rows: list[FleetRow]) -> list[dict[str, object]]:
    """Return the rows as plain objects for JSON."""
    return [msgspec.to_builtins(row) for row in rows]


def fleet_table(rows: list[FleetRow]) -> Table:
    """Format the rows of the fleet as a table."""
    out = Table(box=None, pad_edge=False)
    for heading, justify in (("UAV", "right"), ("state", "left"), ("fit %", "right"), ("horizon s", "right")):
        out.add_column(heading, justify=justify)  # type: ignore[arg-type]
    out.add_column("sample age s", justify="right")
    out.add_column("prediction age s", justify="right")
    out.add_column("alerts and verdict", overflow="fold")
    for row in rows:
        fit = _number(sum(row.fit.values()) / len(row.fit) if row.fit else None, 0)
        horizon = _number(claimed_horizon_s(row.horizon_s, row.prediction_age_s) or None, 0)
        age = _number(row.prediction_age_s, 1)
        late = row.prediction_age_s is not None and row.prediction_age_s > LATE_S
        ages = _number(row.sample_age_s, 1), f"[red]{age}[/red]" if late else age
        notes = [f"▲ mismatch: {escape(printable(row.mismatch))}"] if row.mismatch else []
        notes += [f"battery: {escape(printable(row.battery))}"] if row.battery else []
        alerts = [f"! {escape(printable(alert))}" for alert in row.alerts]
        details = "\n".join((*alerts, *notes, escape(printable(row.verdict))))
        state = Text(row.state.value, STATE_COLOUR.get(row.state, ""))
        out.add_row(str(row.uav), state, fit, horizon, *ages, details)
    return out


def _number(value: float | None, digits: int) -> str:
    """Format a number; a dash where there is none."""
    return "-" if value is None or not isfinite(value) else f"{value:.{digits}f}"
