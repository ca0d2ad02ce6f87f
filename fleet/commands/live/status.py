"""Show every UAV of a running fleet (state, fit, horizon, alerts, verdict) and the processes of each machine."""

import argparse
import json
import sys

import msgspec
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from fleet.bus.bus_protocol import Bus
from fleet.bus.codec import timely
from fleet.bus.session import connect
from fleet.config import entry, router_arguments
from fleet.contract import Account, Claim, FleetRow, FleetState, State, Status
from fleet.process.sanitise import plain
from fleet.report.report_text import spans

EXAMPLES = """
  fleet status
  fleet status --json
  fleet status --router tcp/192.168.1.10:7447
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    router_arguments(parser)
    parser.add_argument("--json", action="store_true", help="a list of objects instead of a table")


def run(args: argparse.Namespace) -> int:
    """Query the fleet once and print it; return exit code 1 if no UAV is known."""
    with connect(entry(args)) as bus:
        rows = fleet_rows(bus)
        on = [] if args.json else processes(bus)
    if args.json:
        json.dump(as_objects(rows), sys.stdout, indent=1)
        print()
    else:
        console = Console()
        console.print(table(rows) if rows else "no UAV known yet: is a gateway running and an aircraft connected?")
        if on:
            console.print("", machines(on), sep="\n")
    return 0 if rows else 1


def fleet_rows(bus: Bus) -> list[FleetRow]:
    """Query the rows of every worker and add aircraft without a worker as unclaimed."""
    best: dict[int, FleetRow] = {}
    for state, _ in bus.ask(FleetState):
        for row in state.rows:
            held = best.get(row.uav)
            if not timely(row.epoch):
                continue
            if held is None or (row.epoch, row.worker) > (held.epoch, held.worker):
                best[row.uav] = row
    for status, _ in bus.ask(Status):
        sentence = "no worker owns this id: start `twin_worker` with a wider --uavs"
        best.setdefault(status.uav, FleetRow(uav=status.uav, state=State.UNCLAIMED, verdict=sentence))
    return [best[uav] for uav in sorted(best)]


def processes(bus: Bus) -> list[tuple[str, str, str, str]]:
    """Query every gateway and worker and return rows of machine, process, aircraft, details."""
    found = []
    for account, _ in bus.ask(Account):
        words = [f"{sum(link.messages_hz for link in account.per_link):.0f} messages/s", account.sentence]
        words += [f"{link.link}: {link.sentence}" for link in account.per_link if link.sentence]
        found.append((account.machine, "gateway", spans(account.uavs), "; ".join(filter(None, words))))
    said = {row.worker: state.sentence for state, _ in bus.ask(FleetState) for row in state.rows}
    for claim, _ in bus.ask(Claim):
        words = ["is leaving" if claim.leaving else "", said.get(claim.worker, "")]
        held = spans(uav for uav, _ in claim.held)
        found.append((claim.machine, f"worker {claim.worker}", held, "; ".join(filter(None, words))))
    return sorted(found)


def machines(found: list[tuple[str, str, str, str]]) -> Table:
    """Format the processes as a table."""
    out = Table("machine", "process", "aircraft", "status", box=None, pad_edge=False)
    for line in found:
        out.add_row(*(escape(plain(word)) or "-" for word in line))
    return out


def as_objects(rows: list[FleetRow]) -> list[dict[str, object]]:
    """Return the rows as plain objects for JSON."""
    return [msgspec.to_builtins(row) for row in rows]


def table(rows: list[FleetRow]) -> Table:
    """Format the rows of the fleet as a table."""
    out = Table(box=None, pad_edge=False)
    for heading, justify in (("UAV", "right"), ("state", "left"), ("fit %", "right"), ("horizon s", "right")):
        out.add_column(heading, justify=justify)  # type: ignore[arg-type]
    out.add_column("sample age s", justify="right")
    out.add_column("alerts and verdict", overflow="fold")
    for row in rows:
        fit = f"{sum(row.fit.values()) / len(row.fit):.0f}" if row.fit else "-"
        horizon = f"{row.horizon_s:.0f}" if row.horizon_s else "-"
        age = "-" if row.sample_age_s is None else f"{row.sample_age_s:.1f}"
        found = [f"▲ mismatch: {escape(plain(row.mismatch))}"] if row.mismatch else []
        said = "\n".join((*(f"! {escape(plain(alert))}" for alert in row.alerts), *found, escape(plain(row.verdict))))
        out.add_row(str(row.uav), row.state.value, fit, horizon, age, said)
    return out
