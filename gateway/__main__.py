"""Receive MAVLink from links, publish Samples on the bus, request mission and parameters from aircraft."""

import argparse
import contextlib
import gc
import logging
import sys
import threading

from fleet.access.entry import BusConfig
from fleet.access.roles import GATEWAY
from fleet.cli import id_range, make_parser, run_command, stop_on_signal
from fleet.config import MAX_UAVS, bus_config_from, has_operators, router_arguments
from fleet.process.file_options import audit_file, input_file, output_folder
from fleet.process.logs import log_arguments, report_status
from fleet.process.malloc_trim import enable_malloc_trim
from fleet.process.private_files import state_folder
from gateway import DEFAULT_BUDGET

SWITCH_S = 5e-4  # longest wait of a receiving thread for the interpreter [s]
COLD_S = 2.0  # compilation that takes longer is logged [s]
COMPILING = "compiling the decoder for this machine, once; links open when that is done"
GC_THRESHOLD = 50_000  # allocations between cycle collections; a tick allocates thousands of objects without cycles
TRIM_BYTES = 1 << 20  # larger allocations are returned to the system: batches of a flood, not of every tick [bytes]
DEFAULT_LINK = "udpin:127.0.0.1:14550"
EXAMPLES = """
  gateway                                              listen on loopback, port 14550
  gateway --link udpin:0.0.0.0:14550                   listen on every network
  gateway --link "udpin:127.0.0.1:14550#offset=-1"     UAV id = system id - 1
  gateway --link serial:/dev/ttyUSB0:57600 --link tcp:192.168.1.10:5760
  gateway --link udpbcast:192.168.1.255:14550          broadcast to a network, receive from all that answer
  gateway --forward udpin:127.0.0.1:14551              serve another ground station: QGroundControl, MAVProxy
  gateway --forward "udpout:10.0.0.9:14550#no-messages=RAW_IMU&systems=1-20"
  gateway --keys keys.txt --link "udpin:0.0.0.0:14550#sign=require&key=swarm"
  gateway --link "replay:flight.tlog.xz?speed=4"       play a recording four times as fast
  gateway --link "replay:flight.tlog?speed=max&copies=50"
  gateway --listen-only                                send nothing to any aircraft
  gateway --metrics 127.0.0.1:9100                     counters for Prometheus, at http://127.0.0.1:9100/metrics
  gateway --record flights --record-budget 20G         also record what is received, with or without a router
  gateway --config fleet.toml --allow commands:0-9     execute proposals that an operator approves, of UAVs 0 to 9
  gateway --allow commands --dry-run                   print what an approved proposal would send

links:
  udpin:HOST:PORT   udpout:HOST:PORT   udpbcast:HOST:PORT   tcpin:HOST:PORT   tcp:HOST:PORT   serial:PATH[:BAUD]
  replay:FILE[?speed=N&copies=N&results=1]
settings behind a #, joined by &:
  offset=N                                UAV id = MAVLink system id + N (of aircraft only)
  messages= systems= components=          accept only these, names or numbers: messages=ATTITUDE,30, systems=1-50
  no-messages= no-systems= no-components= accept all but these; with --forward: filter what is sent there
  sign=accept|require  key=NAME           check signatures, sign what we send; require: refuse unsigned frames

A file of keys has lines of NAME and 64 hex digits; only its owner may have read permission (chmod 600).
"""

_log = logging.getLogger(__name__)


COMMANDS = "commands"
"""What `--allow` allows."""


def allowed_uavs(text: str) -> range:
    """Parse `commands` or `commands:0-9` as the ids of the aircraft that may be commanded.

    Raises:
        ArgumentTypeError: when it is neither; argparse shows the text.
    """
    what, colon, ids = text.partition(":")
    if what != COMMANDS:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected {COMMANDS} or e.g. {COMMANDS}:0-9; correct it")
    return id_range(ids) if colon else range(1_000_000)


def check_commands(args: argparse.Namespace, bus_config: BusConfig) -> None:
    """Check the options of approved execution.

    Raises:
        ValueError: when they disagree, or other machines could approve without the certificate of an operator.
    """
    if args.allow is None:
        if args.dry_run or args.audit is not None:
            raise ValueError("--dry-run, --audit: found no --allow commands, expected it; add it or leave these out")
        return
    if args.listen_only:
        raise ValueError("--allow commands: found --listen-only as well, expected one of both; leave one out")
    if not has_operators("--allow commands", bus_config):
        _log.warning("commands are allowed on a router without roles: every process of this machine can approve them")


def run(args: argparse.Namespace) -> int:
    """Open the links, connect to the bus, and run until a stop signal or the end of all recordings."""
    from rich.console import Console  # here, as --help and --version need none of these

    from fleet.bus.session import connect
    from fleet.metrics import serve
    from fleet.report.progress import show_progress
    from fleet.telemetry.recording.ids import IdAllocator
    from gateway.admission import make_admissions
    from gateway.commands.audit import AuditLog
    from gateway.link_spec import read_forward, read_spec
    from gateway.links.opening import open_link
    from gateway.links.recorded import ReplayLink, replay_process, split_replays
    from gateway.onboard.parameter_cache_check import Cache
    from gateway.pipeline import Pipeline
    from gateway.record.recorder import LinkRecorder
    from gateway.record.tape import DiskBudget, read_size
    from gateway.status import counters, status_display

    specs = [read_spec(text, args.offset) for text in args.link or [DEFAULT_LINK]]
    specs, files = split_replays(specs)
    specs += [read_forward(text) for text in args.forward]
    if args.most_uavs < 1:
        raise ValueError(f"--most-uavs: found {args.most_uavs}, expected at least 1; write e.g. 250")
    gates = make_admissions(specs, len(args.forward), args.keys)
    bus_config = bus_config_from(args, GATEWAY)
    check_commands(args, bus_config)
    disk = DiskBudget(args.record, read_size(args.record_budget, "--record-budget")) if args.record else None
    stop = stop_on_signal()
    sys.setswitchinterval(SWITCH_S)
    compile_decoder()
    gc.freeze()
    gc.set_threshold(GC_THRESHOLD, *gc.get_threshold()[1:])
    enable_malloc_trim(TRIM_BYTES)
    with connect(bus_config, retry=disk is not None) as bus, contextlib.ExitStack() as stack:
        stack.enter_context(replay_process(files, args))
        links, ids = [], IdAllocator()
        for spec in specs:
            link = open_link(spec, ids)
            stack.callback(link.close)
            links.append(link)
            _report(spec.text)
        replays = [link for link in links if isinstance(link, ReplayLink)]
        with show_progress(replays, _report):
            for replay in replays:
                replay.read_ahead(stop)
            recorder = LinkRecorder(disk, [spec.text for spec in specs]) if disk is not None else None
            if recorder is not None:
                stack.enter_context(recorder)
            pipeline = Pipeline(
                links,
                bus,
                args.listen_only,
                admissions=gates,
                stations=len(args.forward),
                max_uavs=args.most_uavs,
                recorder=recorder,
                budget=args.budget,
                cache=None if args.listen_only else Cache(),
            )
            if args.allow is not None:
                audit = AuditLog(args.audit or state_folder() / "commands.jsonl")
                stack.callback(audit.close)
                pipeline.enable_commands(bus, args.allow.__contains__, audit, dry_run=args.dry_run)
                _report(f"approved proposals are {'printed' if args.dry_run else 'executed'}; audit: {audit.path}")
            if len(replays) < len(links):
                console = Console() if sys.stdout.isatty() and not replays else None
                stack.enter_context(status_display(pipeline.publisher.snapshot, _report, console))
            if args.metrics:
                address = stack.enter_context(serve(args.metrics, counters(pipeline.publisher.snapshot)))
                _report(f"counters at {address}")
            pipeline.run(stop)
    return 0


def compile_decoder() -> None:
    """Compile the decoder, or load it from the cache; log a warning if it takes long, once per machine."""
    from fleet.telemetry.mavlink.warm import warm_up

    timer = threading.Timer(COLD_S, _log.warning, (COMPILING,))
    timer.start()
    try:
        warm_up()
    finally:
        timer.cancel()


def _report(line: str) -> None:
    report_status("gateway", line)


def main(argv: list[str] | None = None) -> int:
    """Run the `gateway` command."""
    parser = make_parser("gateway", (__doc__ or "").strip().splitlines()[0], EXAMPLES)
    parser.add_argument(
        "--link", action="append", metavar="LINK", help=f"link to aircraft; may be repeated ({DEFAULT_LINK})"
    )
    parser.add_argument(
        "--forward", action="append", default=[], metavar="LINK", help="link to another ground station; may be repeated"
    )
    parser.add_argument("--offset", type=int, default=0, help="UAV id = MAVLink system id + this (0)")
    parser.add_argument(
        "--most-uavs", type=int, default=MAX_UAVS, metavar="N", help=f"maximum number of aircraft ({MAX_UAVS})"
    )
    parser.add_argument(
        "--keys",
        type=input_file("a file of keys"),
        metavar="FILE",
        help="keys of signed links, readable only by the owner",
    )
    router_arguments(parser)
    parser.add_argument("--listen-only", action="store_true", help="send nothing to the aircraft")
    parser.add_argument(
        "--allow",
        type=allowed_uavs,
        metavar="commands[:IDS]",
        help="execute proposals that an operator approves, of these UAVs (off)",
    )
    parser.add_argument("--dry-run", action="store_true", help="print the messages of approved proposals, send none")
    parser.add_argument(
        "--audit", type=audit_file, metavar="FILE", help="audit of all commands (~/.local/state/parauav/commands.jsonl)"
    )
    parser.add_argument(
        "--budget",
        default="",
        metavar="SIZE",
        help=f"bytes/s aircraft may send on a link ({DEFAULT_BUDGET}; serial: 70 %% of baud)",
    )
    parser.add_argument(
        "--record", type=output_folder, metavar="DIR", help="write a .tlog of each link into this folder"
    )
    parser.add_argument(
        "--record-budget",
        default="10G",
        metavar="SIZE",
        help="disk space for .tlog files; the oldest are deleted (10G)",
    )
    log_arguments(parser)
    parser.add_argument("--metrics", metavar="HOST:PORT", help="counters for Prometheus, e.g. 127.0.0.1:9100")
    return run_command("gateway", run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
