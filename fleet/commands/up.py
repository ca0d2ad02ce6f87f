"""Start a whole fleet on this machine: router, aircraft, gateway, worker, viewer."""

import argparse
import json
import sys
import threading
import time
from pathlib import Path

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from fleet.bus import ROUTER, Bus, connect, open_router, reachable
from fleet.children import Children
from fleet.cli import stop_on_signal
from fleet.commands.status import as_objects, fleet_rows, table
from fleet.contract import FleetRow, FleetState, State

EXAMPLES = """
  fleet up --uavs 8
  fleet up --link udpin:0.0.0.0:14550
  fleet up --replay flight.tlog.xz --speed 4
  fleet up --uavs 8 --for 240 --no-viewer --summary summary.json
"""
_MAVLINK = "127.0.0.1:14550"


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--uavs", type=int, default=8, metavar="N", help="simulated aircraft, ids 0 to N-1 (8)")
    parser.add_argument("--link", action="append", default=[], help="real aircraft instead, e.g. udpin:0.0.0.0:14550")
    parser.add_argument("--replay", action="append", default=[], metavar="FILE", help="recordings instead")
    parser.add_argument("--speed", default="1", help="replay speed, a number or max (1)")
    parser.add_argument("--for", dest="seconds", type=float, default=0.0, help="stop this long after the first sample")
    parser.add_argument("--no-viewer", action="store_true", help="without the web page")
    parser.add_argument("--port", type=int, default=8080, help="port of the web page (8080)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the simulated aircraft (1)")
    parser.add_argument("--router", default=ROUTER, help=f"Zenoh router, opened here if none is there ({ROUTER})")
    parser.add_argument("--summary", type=Path, metavar="FILE", help="write the last state of every UAV as JSON")


def run(args: argparse.Namespace) -> int:
    """Start everything, show it, stop it; exit code 1 where a part died on its own."""
    if not 1 <= args.uavs <= 250:
        raise ValueError(f"--uavs: found {args.uavs}, expected 1 to 250 aircraft; start several fleets for more")
    stop = stop_on_signal()
    router = None if reachable(args.router) else open_router(args.router)
    try:
        with connect(args.router) as bus, Children() as children:
            _start(children, args)
            return _watch(bus, children, args, stop)
    finally:
        if router is not None:
            router.close()


def _start(children: Children, args: argparse.Namespace) -> None:
    router = ["--router", args.router]
    children.start("twin worker", "twin_worker", "--uavs", "0-249", *router)
    links = [f"--link={link}" for link in args.link]
    links += [f"--link=replay:{Path(file).resolve()}?speed={args.speed}" for file in args.replay]
    if links:
        children.start("gateway", "gateway", *links, *router)
    else:
        children.start("gateway", "gateway", f"--link=udpin:{_MAVLINK}", "--offset=-1", *router)
        aircraft = ["--uavs", f"0-{args.uavs - 1}", "--to", _MAVLINK, "--seed", str(args.seed)]
        children.start("aircraft", "fleet.cli", "fly", *aircraft)
    if not args.no_viewer:
        children.start("viewer", "viewer", "--port", str(args.port), *router)


def _watch(bus: Bus, children: Children, args: argparse.Namespace, stop: threading.Event) -> int:
    """Show the fleet once a second until told to stop, a part dies or the time is over."""
    sentences: dict[str, str] = {}
    bus.subscribe(FleetState, lambda state, _: sentences.update(worker=state.sentence))
    rows: list[FleetRow] = []
    first = None
    console = Console(stderr=True)
    with Live(console=console, refresh_per_second=4, transient=False) as live:
        while not stop.wait(1.0):
            rows = fleet_rows(bus) or rows
            if first is None and any(row.sample_age_s is not None for row in rows):
                first = time.monotonic()
            flown = 0.0 if first is None else time.monotonic() - first
            live.update(_picture(rows, children, sentences.get("worker", ""), flown, args))
            if children.dead() or (args.seconds and flown >= args.seconds):
                break
    died = "; ".join(children.dead())
    if args.summary:
        args.summary.write_text(json.dumps(as_objects(rows), indent=1) + "\n")
    if died:
        print(f"fleet up: {died}; see its words above", file=sys.stderr)
    return 1 if died else 0


def _picture(rows: list[FleetRow], children: Children, sentence: str, flown: float, args: argparse.Namespace) -> Group:
    count = {state: sum(row.state is state for row in rows) for state in State}
    said = ", ".join(f"{n} {state.value}" for state, n in count.items() if n) or "waiting for the first sample"
    lines = [f"fleet up · {len(rows)} UAVs · {flown:.0f} s since the first sample · {said}"]
    lines += [sentence] if sentence else []
    lines += children.words()
    if not args.no_viewer:
        lines.append(f"viewer: http://127.0.0.1:{args.port}   (Ctrl-C stops everything)")
    return Group(Text("\n".join(lines)), table(rows[:40]))
