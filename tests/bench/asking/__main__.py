"""How long a question for every prediction takes until its last answer has come, unpacked.

    python -m tests.bench.asking --json asking.json
    python -m tests.bench.asking --zenohd ~/.cargo/bin/zenohd

1,000 aircraft with 4 workers that predict each anew once a second and do nothing else; what is asked for is packed
the first time. `wildcard`: `parauav/*/prediction`, an answer each, unpacked;
`batch`: `parauav/@fleet/prediction/*`, an answer of each worker, whose predictions are unpacked by who reads them. Both
are asked of all, without consolidation. `frozen`: the same while one worker is stopped, as a suspended machine is; the
others' answers count. `plain`: the same bytes and as many answers by Zenoh alone, not unpacked.
"""

import argparse
import json
import os
import platform
import signal
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

from fleet.bus.bus_protocol import key_of
from fleet.bus.session import Bus, _raw_message, connect
from fleet.cli import make_parser, run_command
from fleet.contract import Prediction, Predictions
from tests.bench.referee.site import Site

from . import plain

KINDS = {"wildcard": Prediction, "batch": Predictions}
LIMITS = {"wildcard": 10.0, "batch": 3.0}  # of the median [ms]
_TIMEOUT_S = 0.5  # of a question while one worker is frozen: nobody waits for its end to count


def once(bus: Bus, kind: type, wanted: int, timeout_s: float = 5.0) -> float | None:
    """Ask once; give how long the last of so many answers took [s]; None where fewer came."""
    begun, last, came = time.perf_counter(), 0.0, 0
    for reply in bus._iter_replies(key_of(kind, "*"), timeout_s):
        if reply.ok is None or bus._decode(kind, *_raw_message(reply.ok)[:3]) is None:
            continue
        last, came = time.perf_counter() - begun, came + 1
        if came == wanted:
            break
    return last if came >= wanted else None


def beside(bus: Bus, wanted: dict[str, int], times: int) -> dict[str, dict[str, Any]]:
    """Measure Zenoh alone."""
    return {name: _summary([plain.once(bus, name, wanted[name]) for _ in range(times)]) for name in KINDS}


def measured(bus: Bus, wanted: dict[str, int], times: int, timeout_s: float = 5.0) -> dict[str, dict[str, Any]]:
    """Ask many times, both ways by turns."""
    found: dict[str, list[float | None]] = {name: [] for name in KINDS}
    for _ in range(times):
        for name, kind in KINDS.items():
            found[name].append(once(bus, kind, wanted[name], timeout_s))
    return {name: _summary(took) for name, took in found.items()}


def _summary(took: list[float | None]) -> dict[str, Any]:
    whole = sorted(1e3 * one for one in took if one is not None)
    if not whole:
        return {"asked": len(took), "incomplete": len(took)}
    return {
        "asked": len(took), "incomplete": len(took) - len(whole), "p50_ms": round(statistics.median(whole), 2),
        "p95_ms": round(whole[int(0.95 * (len(whole) - 1))], 2), "least_ms": round(whole[0], 2),
    }  # fmt: skip


@contextmanager
def answering(
    router: str, uavs: int, workers: int, module: str, *more: str
) -> Iterator[tuple[list[subprocess.Popen[str]], int]]:
    """Start who answers; give them and the number that they say first."""
    bounds = [uavs * k // workers for k in range(workers + 1)]
    with ExitStack() as stack:
        running = []
        for low, high in pairwise(bounds):
            command = [sys.executable, "-m", f"tests.bench.asking.{module}", router, str(low), str(high), *more]
            child = stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
            stack.callback(child.kill)
            running.append(child)
        said = [child.stdout.readline() for child in running]  # type: ignore[union-attr]
        yield running, int(said[0].split()[0])


def _run(args: argparse.Namespace) -> int:
    with Site(args.uavs, args.router, zenohd=args.zenohd) as site:
        site.open_router()
        sizes = args.router, args.uavs, args.workers
        wanted = {"wildcard": args.uavs, "batch": args.workers}
        with answering(*sizes, "answerer") as (running, size), connect(args.router) as bus:
            measured(bus, wanted, 3)
            found = {"all": measured(bus, wanted, args.times)}
            running[-1].send_signal(signal.SIGSTOP)
            threading.Event().wait(0.1)
            left = args.uavs * (args.workers - 1) // args.workers
            fewer = {"wildcard": left, "batch": args.workers - 1}
            found["frozen"] = measured(bus, fewer, 1, _TIMEOUT_S)  # before its lease is over
            running[-1].send_signal(signal.SIGCONT)
        with answering(*sizes, "plain", str(size)), connect(args.router) as bus:
            found["plain"] = beside(bus, wanted, args.times)
    ratio = {name: round(found["all"][name]["p50_ms"] / found["plain"][name]["p50_ms"], 2) for name in KINDS}
    summary = {
        "machine": platform.processor() or platform.machine(), "processors": os.cpu_count(), "uavs": args.uavs,
        "workers": args.workers, "router": args.zenohd or "embedded", "bytes_each": size, **found,
        "over_plain_zenoh": ratio,
        "over": [name for name in KINDS if not found["all"][name].get("p50_ms", 1e9) <= LIMITS[name]],
        "load": os.getloadavg()[0],
    }  # fmt: skip
    print(json.dumps(summary, indent=1))
    if args.json:
        args.json.write_text(json.dumps(summary, indent=1) + "\n")
    return int(bool(summary["over"]))


def main(argv: list[str] | None = None) -> int:
    """Measure."""
    parser = make_parser("python -m tests.bench.asking", "Measure how long a question for all takes.", __doc__ or "")
    parser.add_argument("--uavs", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=4)
    parser.add_argument("--times", type=int, default=50, help="questions of each kind")
    parser.add_argument("--router", default="tcp/127.0.0.1:7465")
    parser.add_argument("--zenohd", help="the real router; without it a session of ours in router mode")
    parser.add_argument("--json", type=Path, metavar="FILE")
    return run_command("bench.asking", _run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
