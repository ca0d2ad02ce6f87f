"""Start a complete fleet on this machine: router, aircraft, gateway, worker, viewer."""

import argparse
import json
import socket
import sys
import threading
import time
from pathlib import Path

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from fleet.access.knock import probe_router
from fleet.bus.session import Bus, connect, open_router
from fleet.cli import check_link, check_port, host_and_port, stop_on_signal
from fleet.commands.live.fly import AIRCRAFT_HELP, AUTOPILOTS, CHOICES, STORIES, fault_arguments, faults_of
from fleet.commands.live.replay import check_arguments as check_playing
from fleet.commands.live.replay import replay_link
from fleet.commands.live.status import as_objects, fleet_rows, fleet_table
from fleet.config import bus_config_from, router_arguments, router_options
from fleet.contract import FleetRow, FleetState, TwinState
from fleet.process.children import Children
from fleet.process.file_options import check_file, input_file, model_of, output_file
from fleet.process.logs import add_time, report_progress
from fleet.process.sanitise import printable
from fleet.report.story import ConflictStory
from fleet.telemetry.recording.options import add_recording_arguments

EXAMPLES = """
  fleet up --uavs 8
  fleet up --uavs 4 --autopilot px4 --aircraft c172p
  fleet up --uavs 8 --aircraft mixed                                         wings and quadrotors in turn
  fleet up --uavs 8 --story conflict                                         alert, proposals, your approval
  fleet up --uavs 4 --fault drag_increase,dCD=0.04,at=120 --fault-uav 2      its twin should diagnose the fault
  fleet up --link udpin:0.0.0.0:14550
  fleet up --link serial:/dev/ttyUSB0:57600 --forward udpin:127.0.0.1:14551      QGroundControl in addition, at 14551
  fleet up --replay flight.tlog.xz log7.bin --speed 4
  fleet up --replay monday.parauav --results
  fleet up --uavs 8 --for 240 --no-viewer --summary summary.json
  fleet up --router tcp/127.0.0.1:7448 --mavlink 127.0.0.1:14551 --port 8081      a second fleet
"""
_MAVLINK = "127.0.0.1:14550"
_LOG_PERIOD_S = 10.0  # between progress lines where the output is not a terminal [s]


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--uavs", type=int, default=8, metavar="N", help="simulated aircraft, ids 0 to N-1 (8)")
    parser.add_argument("--autopilot", choices=AUTOPILOTS, default="ardupilot", help="simulated autopilot (ardupilot)")
    parser.add_argument("--aircraft", choices=CHOICES, default="small", help=AIRCRAFT_HELP)
    fault_arguments(parser)
    parser.add_argument(
        "--story",
        choices=STORIES,
        help="conflict: two aircraft meet after 2 min; these simulated ones execute approved proposals",
    )
    parser.add_argument(
        "--mavlink", default=_MAVLINK, metavar="HOST:PORT", help=f"UDP address they send to ({_MAVLINK})"
    )
    parser.add_argument("--link", action="append", default=[], help="real aircraft instead, e.g. udpin:0.0.0.0:14550")
    parser.add_argument("--forward", action="append", default=[], help="another ground station, as in gateway --help")
    parser.add_argument(
        "--keys", type=input_file("a file of keys"), metavar="FILE", help="keys of signed links, as in gateway --help"
    )
    parser.add_argument(
        "--replay", action="extend", nargs="+", default=[], metavar="FILE", help="recordings of any kind instead"
    )
    parser.add_argument("--speed", default="1", help="replay speed, a number or max (1)")
    parser.add_argument("--copies", type=int, default=1, metavar="N", help="aircraft for each recorded one (1)")
    add_recording_arguments(parser)
    parser.add_argument("--results", action="store_true", help="show the recorded results, compute none")
    parser.add_argument("--for", dest="seconds", type=float, default=0.0, help="stop this long after the first sample")
    parser.add_argument("--no-viewer", action="store_true", help="without the web page")
    parser.add_argument("--port", type=int, default=8080, help="port of the web page (8080)")
    parser.add_argument("--terrain", metavar="FILE", help="terrain heights for alerts and page, as in viewer --help")
    parser.add_argument(
        "--areas", type=input_file("a GeoJSON file"), metavar="FILE", help="geofence areas, as in twin_worker --help"
    )
    parser.add_argument("--imagery", metavar="FILE", help="ground imagery for the page, as in viewer --help")
    parser.add_argument("--map", metavar="FILE", help="map tiles for the page, as in viewer --help")
    parser.add_argument("--seed", type=int, default=1, help="seed of the simulated aircraft (1)")
    router_arguments(parser)
    parser.add_argument(
        "--baseline",
        action="append",
        type=model_of,
        default=[],
        metavar="[ID=]MODEL",
        help="reference model for mismatches, of one aircraft or of all (each aircraft's own first flight)",
    )
    parser.add_argument("--summary", type=output_file, metavar="FILE", help="write the last state of every UAV as JSON")


def run(args: argparse.Namespace) -> int:
    """Start, show and stop all processes; return exit code 1 if one failed, 2 if one rejected its options."""
    _check(args)
    stop = stop_on_signal()
    bus_config = bus_config_from(args)
    router = None if probe_router(bus_config) else open_router(bus_config)
    try:
        with connect(bus_config) as bus, Children() as children:
            _start(children, args)
            return _watch(bus, children, args, stop)
    finally:
        if router is not None:
            router.close()


def _check(args: argparse.Namespace) -> None:
    """Validate the options before anything is started."""
    if not 1 <= args.uavs <= 250:
        raise ValueError(f"--uavs: found {args.uavs}, expected 1 to 250 aircraft; start several fleets for more")
    if not 0 <= args.seconds < float("inf"):
        raise ValueError(f"--for: found {args.seconds} s, expected 0 (until Ctrl-C) or more; change it")
    check_playing(args)
    if args.fault and (args.link or args.replay):
        raise ValueError("--fault: found --link or --replay, expected simulated aircraft; leave one out")
    if args.story and (args.link or args.replay or args.fault or args.aircraft != "small" or args.uavs < 2):
        given = "--link, --replay, --fault, another --aircraft or fewer than 2 --uavs"
        raise ValueError(f"--story: found {given}, expected 2 or more simulated small aircraft; leave these out")
    faults_of(args, range(args.uavs))
    if args.results and not args.replay:
        raise ValueError("--results: found no --replay, expected a recording made by `fleet record`; name one")
    for text in args.link:
        check_link("--link", text)
    for text in args.forward:
        check_link("--forward", text)
    for name in args.replay:
        check_file("--replay", name)
    for option in ("terrain", "imagery"):
        if (file := getattr(args, option)) and not (option == "imagery" and args.no_viewer):
            check_file(f"--{option}", file if Path(file).exists() else file.rpartition("@")[0] or file, "a raster file")
    if args.map and not args.no_viewer:
        check_file("--map", args.map, "an MBTiles or PMTiles file")
    check_port("--port", args.port)
    if not (args.link or args.replay):
        _check_free(args.mavlink)


def _check_free(mavlink: str) -> None:
    address = host_and_port("--mavlink", mavlink)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
        try:
            trial.bind(address)
        except OSError as error:
            reason = f"UDP {mavlink} not free ({error.strerror or error}), expected a port for the simulated aircraft"
            raise ValueError(f"--mavlink: found {reason}; stop the other fleet, or name another port") from None


def _start(children: Children, args: argparse.Namespace) -> None:
    router = router_options(args)
    if not args.results:
        ids = "0-999999" if args.replay else "0-249"
        baselines = [f"--baseline={text}" for text in args.baseline]
        ground = [f"--{name}={file}" for name in ("terrain", "areas") if (file := getattr(args, name))]
        children.start("twin worker", "twin_worker", "--uavs", ids, *baselines, *ground, *router)
    gateway_options = [f"--forward={text}" for text in args.forward] + router
    gateway_options += [f"--keys={args.keys}"] if args.keys else []
    links = [f"--link={text}" for text in args.link]
    links += [f"--link={replay_link(file, args)}" for file in args.replay]
    if links:
        children.start("gateway", "gateway", *links, *gateway_options)
    else:
        gateway_options += [f"--allow=commands:0-{args.uavs - 1}"] if args.story else []
        children.start("gateway", "gateway", f"--link=udpin:{args.mavlink}", "--offset=-1", *gateway_options)
        if not args.story:  # its aircraft start when the worker is ready
            _start_aircraft(children, args)
    if not args.no_viewer:
        names = ("terrain", "areas", "imagery", "map")
        map_options = [f"--{name}={file}" for name in names if (file := getattr(args, name))]
        map_options += ["--allow=approvals"] if args.story else []
        children.start("viewer", "viewer", "--port", str(args.port), *map_options, *router)


def _start_aircraft(children: Children, args: argparse.Namespace) -> None:
    aircraft = ["--uavs", f"0-{args.uavs - 1}", "--to", args.mavlink, "--seed", str(args.seed)]
    aircraft += ["--autopilot", args.autopilot, "--aircraft", args.aircraft]
    aircraft += [f"--fault={text}" for text in args.fault]
    aircraft += [] if args.fault_uav is None else [f"--fault-uav={args.fault_uav}"]
    aircraft += [f"--story={args.story}"] if args.story else []
    children.start("aircraft", "fleet.cli", "fly", *aircraft)


def _watch(bus: Bus, children: Children, args: argparse.Namespace, stop: threading.Event) -> int:
    """Show the fleet once a second until stopped, a process fails or the duration has elapsed."""
    ready = threading.Event()  # the worker publishes
    worker_texts: list[str] = [""]  # texts of the worker, the newest last; none is lost between two polls

    def on_state(state: FleetState, _: object) -> None:
        if (text := printable(state.sentence)) != worker_texts[-1]:
            worker_texts.append(text)
        if state.t > 0.0 or state.tasks:  # not while it compiles
            ready.set()

    bus.subscribe(FleetState, on_state)
    story = _story(bus, args)
    rows: list[FleetRow] = []
    first_sample_t = None
    display = _Display(Console(stderr=True))
    with display.live:
        while not stop.wait(1.0):
            rows = fleet_rows(bus, preparing=bool(worker_texts[-1]) and not ready.is_set()) or rows
            if story is not None and not story.sentences and ready.is_set():
                _start_aircraft(children, args)
                story.begin()
            if first_sample_t is None and any(row.sample_age_s is not None for row in rows):
                first_sample_t = time.monotonic()
            elapsed = 0.0 if first_sample_t is None else time.monotonic() - first_sample_t
            scene = [] if story is None else list(story.sentences)
            display.draw([*_lines(rows, children, worker_texts[-1], elapsed, args), *scene], rows, worker_texts)
            if children.failures() or (args.seconds and elapsed >= args.seconds):
                break
    failed = children.failures()
    if args.summary:
        args.summary.write_text(json.dumps(as_objects(rows), indent=1) + "\n")
    for _, sentence in failed:
        report_progress("fleet up", sentence)
    if stop.is_set():
        report_progress("fleet up", "stopping")
    return (2 if all(code == 2 for code, _ in failed) else 1) if failed else 0


def _story(bus: Bus, args: argparse.Namespace) -> ConflictStory | None:
    """Return the scene of `--story`, subscribed; None without one."""
    if not args.story:
        return None
    router = f" --router {args.router}" if args.router else ""
    story = ConflictStory("" if args.no_viewer else f"http://127.0.0.1:{args.port}", router)
    story.subscribe(bus)
    return story


class _Display:
    """Display: a live table on a terminal, otherwise a line for every new text."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self.live = Live(console=console, refresh_per_second=4, transient=not console.is_terminal)
        self._printed: set[str] = set()
        self._due = 0.0

    def draw(self, lines: list[str], rows: list[FleetRow], texts: list[str]) -> None:
        if self.console.is_terminal:
            self.live.update(Group(Text("\n".join(lines)), *([fleet_table(rows[:40])] if rows else [])))
            return
        new_lines = [line for line in dict.fromkeys([*texts, *lines[1:]]) if line and line not in self._printed]
        if time.monotonic() >= self._due:
            self._due = time.monotonic() + _LOG_PERIOD_S
            new_lines.insert(0, lines[0])
        self._printed.update(new_lines)
        for line in new_lines:
            print(add_time(printable(line)), file=sys.stderr, flush=True)


def _lines(
    rows: list[FleetRow], children: Children, sentence: str, elapsed: float, args: argparse.Namespace
) -> list[str]:
    count = {state: sum(row.state is state for row in rows) for state in TwinState}
    states = ", ".join(f"{n} {state.value}" for state, n in count.items() if n)
    since = f"{elapsed:.0f} s since the first sample" if elapsed else "workers are starting"
    lines = [
        f"fleet up · {len(rows)} UAVs · {since} · {states}" if rows else "fleet up · waiting for the first aircraft"
    ]
    lines += [f"twin worker: {sentence}"] if sentence else []
    lines += children.last_lines()
    if args.replay and "gateway" in children.finished():
        lines.append("the recording has ended; the twins predict without telemetry until Ctrl-C")
    if not args.no_viewer:
        lines.append(f"viewer: http://127.0.0.1:{args.port}   (Ctrl-C stops everything)")
    return lines
