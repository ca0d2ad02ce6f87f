"""How many aircraft one machine holds, what each costs, and what gives way first.

    python -m tests.bench.scale --json scale.json
    python -m tests.bench.scale --only hundred
    python -m tests.bench.scale --only curve --uavs 50 100 200 500 --pace predict=5,identify=10,ensemble=10

hundred   identification every second, ensembles of 50 members of 60 s every two, flights ahead with them: nothing may
          be late, nothing shed
most      500 aircraft, every sample kept, a flight ahead every second; identification and ensembles as often as fits
curve     CPU of the workers over the number of aircraft at fixed rates; the slope of its logarithms

Aircraft are copies of one flight, each at a place of its own, that a gateway plays; workers are processes, one for each
core. A kind of work is late where its period is over 1.1 times the one wanted.
"""

import argparse
import json
import os
import platform
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fleet.cli import make_parser, run_command
from tests.bench.referee.site import fly

from .watched import Size, watch

HUNDRED = "predict=2,identify=1,ensemble=2,renew=1,members=50,span=60"
MOST = "predict=1,identify=30,ensemble=30"
CURVE = "predict=5,identify=10,ensemble=10"
KINDS = ("hundred", "most", "curve")


def sizes(args: argparse.Namespace) -> Iterator[tuple[str, Size]]:
    """Give what is tried, by kind."""
    if "hundred" in args.only:
        yield "hundred", Size(args.hundred, args.workers, HUNDRED, args.seconds)
    if "most" in args.only:
        yield "most", Size(args.most, args.workers, MOST, args.seconds)
    for uavs in args.uavs if "curve" in args.only else ():
        yield "curve", Size(uavs, args.workers, args.pace, args.seconds)


def slope(rows: list[dict[str, Any]]) -> float | None:
    """Give the slope of log CPU over log aircraft; None with fewer than two sizes."""
    if len(rows) < 2:
        return None
    x, y = (np.log([row[name] for row in rows]) for name in ("uavs", "worker_cores"))
    return round(float(np.polyfit(x, y, 1)[0]), 3)


def megabytes(rows: list[dict[str, Any]]) -> float | None:
    """Give the memory of one more aircraft [MB]; None with fewer than two sizes."""
    if len(rows) < 2:
        return None
    return round(float(np.polyfit([row["uavs"] for row in rows], [sum(row["worker_mb"]) for row in rows], 1)[0]), 2)


def _run(args: argparse.Namespace) -> int:
    found: dict[str, list[dict[str, Any]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        recording = args.recording or fly(Path(folder) / "flight.tlog")
        for kind, size in sizes(args):
            row = watch(size, recording, args.router)
            found.setdefault(kind, []).append(row)
            print(json.dumps({"kind": kind, **row}), flush=True)
    curve = found.get("curve", [])
    summary = {
        "machine": platform.processor() or platform.machine(), "processors": os.cpu_count(), **found,
        "slope": slope(curve), "mb_a_uav": megabytes(curve),
        "gives_way_first": next((row["late"][-1] for rows in found.values() for row in rows if row["late"]), None),
    }  # fmt: skip
    print(json.dumps({key: summary[key] for key in ("slope", "mb_a_uav", "gives_way_first")}))
    if args.json:
        args.json.write_text(json.dumps(summary, indent=1) + "\n")
    return 0


def main(argv: list[str] | None = None) -> int:
    """Measure."""
    parser = make_parser("python -m tests.bench.scale", "Measure how many aircraft a machine holds.", __doc__ or "")
    parser.add_argument("--only", nargs="+", default=list(KINDS), choices=KINDS)
    parser.add_argument("--hundred", type=int, default=100, metavar="N", help="aircraft of `hundred`")
    parser.add_argument("--most", type=int, default=500, metavar="N", help="aircraft of `most`")
    parser.add_argument("--uavs", type=int, nargs="+", default=[50, 100, 200, 500], help="sizes of `curve`")
    parser.add_argument("--pace", default=CURVE, help=f"of `curve` ({CURVE})")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes (one a core)")
    parser.add_argument("--seconds", type=float, default=30.0, help="watched, each")
    parser.add_argument("--router", default="tcp/127.0.0.1:7463")
    parser.add_argument("--recording", type=Path, help="a flight to play; without it one is flown first")
    parser.add_argument("--json", type=Path, metavar="FILE")
    return run_command("bench.scale", _run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
