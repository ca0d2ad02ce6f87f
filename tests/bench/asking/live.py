"""The line of the README, as it stands: a router, two workers of one range, 50 aircraft; asked as any tool would.

    python -m tests.bench.asking.live --json live.json
    python -m tests.bench.asking.live --zenohd ~/.cargo/bin/zenohd

The question is asked with nothing but zenoh and msgpack, while the workers work; `asked_ms` is until its end.
"""

import argparse
import json
import os
import statistics
import struct
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import msgpack

from fleet.bus.session import connect
from fleet.cli import make_parser, run_command
from tests.bench.referee.site import Site, until

_PATIENCE_S = 300.0
_PACE = "predict=1,identify=5,ensemble=10"


def ask(session: Any) -> dict[int, tuple[int, int, dict[str, Any]]]:
    """Ask for every prediction as a foreign tool does; give epoch, writer and prediction by UAV id."""
    import zenoh

    found: dict[int, tuple[int, int, dict[str, Any]]] = {}
    for reply in session.get("parauav/*/prediction", consolidation=zenoh.ConsolidationMode.NONE, timeout=2.0):
        if reply.ok is not None and reply.ok.attachment is not None:
            made = msgpack.unpackb(reply.ok.payload.to_bytes())
            epoch, writer = struct.unpack("<QQ", reply.ok.attachment.to_bytes())
            found[made["uav"]] = max(found.get(made["uav"], (0, 0, {})), (epoch, writer, made), key=lambda one: one[:2])
    return found


def _run(args: argparse.Namespace) -> int:
    with Site(args.uavs, args.router, zenohd=args.zenohd, pace=args.pace) as site:
        site.open(args.recording, 2)
        begun = time.monotonic()
        with connect(args.router) as bus:
            session = bus._session
            until(lambda: len(ask(session)) == args.uavs, _PATIENCE_S, f"a prediction of {args.uavs} aircraft")
            took = time.monotonic() - begun
            asked = []
            for _ in range(args.times):
                at = time.perf_counter()
                found = ask(session)
                asked.append(1e3 * (time.perf_counter() - at))
    writers = Counter(f"{writer:016x}" for _, writer, _ in found.values())
    summary = {
        "router": args.zenohd or "embedded", "uavs": args.uavs, "answered": len(found), "by_writer": dict(writers),
        "all_after_s": round(took, 1), "asked_ms": round(statistics.median(asked), 1),
        "bytes_each": round(statistics.mean(len(msgpack.packb(made)) for _, _, made in found.values())),
        "states": dict(Counter(made["state"] for _, _, made in found.values())), "load": os.getloadavg()[0],
    }  # fmt: skip
    print(json.dumps(summary, indent=1))
    if args.json:
        args.json.write_text(json.dumps(summary, indent=1) + "\n")
    return int(len(found) != args.uavs or len(writers) != 2)


def main(argv: list[str] | None = None) -> int:
    """Ask."""
    parser = make_parser("python -m tests.bench.asking.live", "Ask two workers for 50 predictions.", __doc__ or "")
    parser.add_argument("--uavs", type=int, default=50)
    parser.add_argument("--pace", default=_PACE)
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--router", default="tcp/127.0.0.1:7469")
    parser.add_argument("--zenohd", help="the real router; without it a session of ours in router mode")
    parser.add_argument("--recording", type=Path, help="a flight to play; without it one is flown first")
    parser.add_argument("--json", type=Path, metavar="FILE")
    return run_command("bench.asking.live", _run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
