"""Receive MAVLink from links, publish Samples on the bus, request mission and parameters from aircraft."""

import argparse
import contextlib
import gc
import logging
import sys
import threading
from pathlib import Path

from rich.console import Console

from fleet.access.roles import GATEWAY
from fleet.bus.session import connect
from fleet.cli import guarded, parser_for, stop_on_signal
from fleet.config import entry, router_arguments
from fleet.metrics import served
from fleet.process.logs import log_arguments, say
from fleet.process.malloc_trim import give_back
from fleet.report.progress import shown
from fleet.telemetry.mavlink.intake import MOST_UAVS
from fleet.telemetry.mavlink.warm import warm_up
from fleet.telemetry.recording.ids import Ids
from gateway.admission.admission import gates_of
from gateway.links.isolated_replay import divided, played_apart
from gateway.links.link import Link
from gateway.links.opening import open_link
from gateway.links.recorded import Replay
from gateway.onboard.cache import Cache
from gateway.onboard.rates import BUDGET
from gateway.pipeline import Pump
from gateway.record.recorder import Recorder
from gateway.record.size import read_size
from gateway.record.tape import Budget
from gateway.settings.link_spec import read_forward, read_spec
from gateway.status.metrics import counters
from gateway.status.status_table import posted

SWITCH_S = 5e-4  # longest wait of a receiving thread for the interpreter [s]
COLD_S = 2.0  # compilation that takes longer is logged [s]
COLD = "compiling the decoder for this machine, once; links open when that is done"
GARBAGE = 50_000  # allocations between cycle collections; a tick allocates thousands of objects without cycles
LARGE = 1 << 20  # larger allocations are returned to the system: batches of a flood, not those of every tick [bytes]
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


def run(args: argparse.Namespace) -> int:
    """Open the links, connect to the bus, and run until a stop signal or the end of all recordings."""
    specs = [read_spec(text, args.offset) for text in args.link or [DEFAULT_LINK]]
    specs, files = divided(specs)
    specs += [read_forward(text) for text in args.forward]
    if args.most_uavs < 1:
        raise ValueError(f"--most-uavs: found {args.most_uavs}, expected at least 1; write e.g. 250")
    gates = gates_of(specs, len(args.forward), args.keys)
    budget = Budget(args.record, read_size(args.record_budget, "--record-budget")) if args.record is not None else None
    stop = stop_on_signal()
    sys.setswitchinterval(SWITCH_S)
    compiled()
    gc.freeze()
    gc.set_threshold(GARBAGE, *gc.get_threshold()[1:])
    give_back(LARGE)
    with connect(entry(args, GATEWAY), patient=budget is not None) as bus, contextlib.ExitStack() as held:
        held.enter_context(played_apart(files, args, _log.warning))
        links: list[Link] = []
        ids = Ids()
        for spec in specs:
            link = open_link(spec, ids)
            held.callback(link.close)
            links.append(link)
            _say(spec.text)
        replays = [link for link in links if isinstance(link, Replay)]
        with shown(replays, _say):
            for replay in replays:
                replay.look(stop)
            recorder = None if budget is None else held.enter_context(Recorder(budget, [spec.text for spec in specs]))
            pump = Pump(
                links,
                bus,
                args.listen_only,
                gates=gates,
                stations=len(args.forward),
                most=args.most_uavs,
                recorder=recorder,
                budget=args.budget,
                cache=None if args.listen_only else Cache(),
            )
            if len(replays) < len(links):
                console = Console() if sys.stdout.isatty() and not replays else None
                held.enter_context(posted(pump.publisher.newest, _say, console))
            if args.metrics:
                _say(f"counters at {held.enter_context(served(args.metrics, counters(pump.publisher.newest)))}")
            pump.run(stop)
    return 0


def compiled() -> None:
    """Compile the decoder, or load it from the cache; log a warning if it takes long, once per machine."""
    slow = threading.Timer(COLD_S, _log.warning, (COLD,))
    slow.start()
    try:
        warm_up()
    finally:
        slow.cancel()


def _say(line: str) -> None:
    say("gateway", line)


def main(argv: list[str] | None = None) -> int:
    """Run the `gateway` command."""
    parser = parser_for("gateway", (__doc__ or "").strip().splitlines()[0], EXAMPLES)
    parser.add_argument(
        "--link", action="append", metavar="LINK", help=f"link to aircraft; may be repeated ({DEFAULT_LINK})"
    )
    parser.add_argument(
        "--forward", action="append", default=[], metavar="LINK", help="link to another ground station; may be repeated"
    )
    parser.add_argument("--offset", type=int, default=0, help="UAV id = MAVLink system id + this (0)")
    parser.add_argument(
        "--most-uavs", type=int, default=MOST_UAVS, metavar="N", help=f"maximum number of aircraft ({MOST_UAVS})"
    )
    parser.add_argument("--keys", type=Path, metavar="FILE", help="keys of signed links, readable only by the owner")
    router_arguments(parser)
    parser.add_argument("--listen-only", action="store_true", help="send nothing to the aircraft")
    parser.add_argument(
        "--budget",
        default="",
        metavar="SIZE",
        help=f"bytes/s aircraft may send on a link ({BUDGET}; serial: 70 %% of baud)",
    )
    parser.add_argument("--record", type=Path, metavar="DIR", help="write a .tlog of each link into this folder")
    parser.add_argument(
        "--record-budget",
        default="10G",
        metavar="SIZE",
        help="disk space for .tlog files; the oldest are deleted (10G)",
    )
    log_arguments(parser)
    parser.add_argument("--metrics", metavar="HOST:PORT", help="counters for Prometheus, e.g. 127.0.0.1:9100")
    return guarded("gateway", run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
