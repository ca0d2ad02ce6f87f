"""Links to bus: hear MAVLink, publish Samples, ask aircraft for mission and parameters."""

import argparse
import contextlib
import logging
import sys

from fleet.bars import shown
from fleet.bus import ROUTER, connect
from fleet.cli import guarded, parser_for, stop_on_signal
from fleet.telemetry.ids import Ids
from gateway.link import Link, Udp
from gateway.pump import Pump
from gateway.recorded import Replay
from gateway.spec import read_spec

DEFAULT_LINK = "udpin:127.0.0.1:14550"
EXAMPLES = """
  gateway                                              listen on loopback, port 14550
  gateway --link udpin:0.0.0.0:14550                   listen on every network
  gateway --link "udpin:127.0.0.1:14550#offset=-1"     UAV id = system id - 1
  gateway --link "replay:flight.tlog.xz?speed=4"       play a recording four times as fast
  gateway --link "replay:flight.tlog?speed=max&copies=50"
  gateway --listen-only                                send nothing to any aircraft
"""


def run(args: argparse.Namespace) -> int:
    """Open the links, join the bus, work until told to stop or the recordings end."""
    specs = [read_spec(text, args.offset) for text in args.link or [DEFAULT_LINK]]
    stop = stop_on_signal()
    with connect(args.router) as bus, contextlib.ExitStack() as held:
        links: list[Link] = []
        ids = Ids()
        for spec in specs:
            link: Link = Udp(spec) if spec.kind == "udpin" else Replay(spec, ids)
            held.callback(link.close)
            links.append(link)
            print(f"gateway: {spec.text}", flush=True)
        replays = [link for link in links if isinstance(link, Replay)]
        with shown(replays, lambda line: print(f"gateway: {line}", flush=True)):
            for replay in replays:
                replay.look(stop)
            Pump(links, bus, args.listen_only).run(stop)
    return 0


def main(argv: list[str] | None = None) -> int:
    """Run the `gateway` command."""
    logging.basicConfig(format="gateway: %(message)s")
    parser = parser_for("gateway", (__doc__ or "").strip().splitlines()[0], EXAMPLES)
    parser.add_argument(
        "--link", action="append", metavar="LINK", help=f"udpin:HOST:PORT or replay:FILE?speed=N ({DEFAULT_LINK})"
    )
    parser.add_argument("--offset", type=int, default=0, help="UAV id = MAVLink system id + this (0)")
    parser.add_argument("--router", default=ROUTER, help=f"where the bus is ({ROUTER})")
    parser.add_argument("--listen-only", action="store_true", help="send nothing at all to the aircraft")
    return guarded("gateway", run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
