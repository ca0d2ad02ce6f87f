"""Workers that share a fleet are killed, frozen, cut off, sent away and joined by others; readers keep count.

    python -m tests.bench.referee --json referee.json
    python -m tests.bench.referee --random 100 --seed 3
    python -m tests.bench.referee --zenohd ~/.cargo/bin/zenohd --only kill join

200 aircraft are copies of one flight that a gateway plays; 4 workers renew every prediction ten times a second, and
fly ahead, identify and fly ensembles every 5 s. Gaps lie between predictions that a reader accepts.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fleet.cli import make_parser, run_command
from fleet.contract import Claim
from twin_worker.ownership.protocol_state import owners

from . import faults
from .site import PACE, Site, Worker, until

LIMITS: dict[str, dict[str, float]] = {  # by fault: what is measured, and the most that is allowed
    "kill": {"taken_s": 0.5, "gap_s": 0.5},
    "freeze": {"taken_s": 1.5, "gap_s": 1.5},
    "leave": {"gap_s": 0.3},
    "join": {"gap_s": 0.3},
    "restart_router": {"owners_changed": 0},
    "delay": {"owners_changed": 0},
    "blink": {"owners_changed": 0},
    "busy": {"owners_changed": 0},
    "starve": {"owners_changed": 0, "gap_s": 3.0},
    "starve_all": {"owners_changed": 0, "gap_s": 3.0},
}
_WARM = 0.95  # share of the aircraft that must have a model before the first fault [-]
_USUAL_S = 15.0  # between predictions of an aircraft, at most, before the first fault [s]
ANNOUNCED_S = 1.2  # after which everyone has said what it holds now [s]
_BEFORE_S = 4.0  # looked at before a fault [s]
_BLOCKING = ("freeze", "cut", "stall")  # whoever is away loses its aircraft, and has them back afterwards
RANDOM = ("kill", "freeze", "leave", "join", "cut", "stall", "delay", "blink", "restart_router")


def one_by_one(site: Site, names: list[str], repeat: int, rng: np.random.Generator) -> Iterator[dict[str, Any]]:
    """Do each fault some times; the fleet is made whole in between."""
    for name in names:
        for _ in range(repeat):
            yield happen(site, name, rng)


def at_random(site: Site, count: int, rng: np.random.Generator) -> Iterator[dict[str, Any]]:
    """Do faults at random."""
    for _ in range(count):
        yield happen(site, str(rng.choice(RANDOM)), rng)


def happen(site: Site, name: str, rng: np.random.Generator) -> dict[str, Any]:
    """Do one fault to a worker drawn by lot, then bring the fleet back to its size."""
    most = site.wanted
    if name == "join" and len(site.workers) > most:
        faults.leave(site, _oldest(site))
    site.reader.forget()
    usual_since = time.monotonic()
    everyone, before = set(range(site.uavs)), site.reader.holders()
    faults.wait(_BEFORE_S)
    calm_s = {uav: site.reader.gap({uav}, usual_since) for uav in everyone}
    begun, names = time.monotonic(), {one.name for one in site.workers}
    fault = faults.ALL[name]
    able = [one for one in site.workers if one.way is not None or fault not in faults.ON_THE_WAY]
    able = [one for one in able if one is not site.spared or fault not in faults.ENDS]
    worker = able[int(rng.integers(len(able)))]
    try:
        found = fault(site, worker)
    except TimeoutError as error:
        claims = {claim.worker[-4:]: (sorted(uav for uav, _ in claim.owned), claim.without_history, claim.leaving)
                  for claim, _ in site.reader.bus.get(Claim)}  # fmt: skip
        found = {"failed": str(error), "claims": claims}
    limits = LIMITS.get(name, {})
    found["over"] = [key for key, most_of in limits.items() if not (found.get(key, np.inf) <= most_of)]
    after = site.reader.holders()
    moved = {uav for uav in everyone if after.get(uav) != before.get(uav)}
    stay = everyone - moved
    if name not in _BLOCKING:
        joined = {one.name for one in site.workers} - names
        left = names - {one.name for one in site.workers}
        found["moved_without_cause"] = sum(
            before.get(uav) not in left and after.get(uav) not in joined for uav in moved
        )
    found["not_moved"] = {
        "aircraft": len(stay),
        "gap_s": site.reader.gap(stay, begun),
        "added_s": max((site.reader.gap({uav}, begun) - calm_s[uav] for uav in stay), default=0.0),
        "before_s": max((calm_s[uav] for uav in stay), default=0.0),
    }
    found |= {
        "epoch_regressions": site.reader.regressions,
        "fault": name,
        "usual_s": site.reader.usual(everyone, usual_since),
        "load": os.getloadavg()[0],
    }
    print(json.dumps(found), flush=True)
    while len(site.workers) < most:
        site.add()
    while len(site.workers) > most:
        faults.leave(site, _oldest(site))
    settle(site)
    return found


def _oldest(site: Site) -> Worker:
    """Give who goes to make room: the oldest, but nobody who is spared, and whose way can be cut last."""
    able = [worker for worker in site.workers if worker is not site.spared]
    return next((worker for worker in able if worker.way is None), able[0])


def settle(site: Site) -> None:
    """Wait until every aircraft is held by its owner."""
    wanted = owners(range(site.uavs), {worker.name: range(site.uavs) for worker in site.workers})
    until(lambda: site.reader.holders() == wanted, 120.0, "a holder of every aircraft")
    faults.wait(ANNOUNCED_S)


def _run(args: argparse.Namespace) -> int:
    rng = np.random.default_rng(args.seed)
    with Site(args.uavs, args.router, zenohd=args.zenohd, pace=args.pace, ways=args.ways) as site:
        site.wanted = args.workers
        try:
            site.open(args.recording, args.workers)
            settle(site)
            begun = time.monotonic()
            until(lambda: len(site.reader.fits) >= _WARM * args.uavs or time.monotonic() - begun > args.warm, 1e6, "")
            until(
                lambda: not site.reader.silent(set(range(args.uavs)), _USUAL_S), args.warm, "a prediction of everyone"
            )
            print(f"{args.uavs} aircraft, {args.workers} workers: begun", file=sys.stderr, flush=True)
            steps = at_random(site, args.random, rng) if args.random else one_by_one(site, args.only, args.repeat, rng)
            rows = list(steps)
        except TimeoutError as error:
            print(site.words(), file=sys.stderr)
            raise OSError(str(error)) from None
        reader = site.reader
        summary = {
            "uavs": args.uavs, "workers": args.workers, "pace": args.pace, "router": args.zenohd or "embedded",
            "faults": len(rows), "over": sum(bool(row["over"]) or "failed" in row for row in rows),
            "epoch_regressions": reader.regressions, "data_time_regressions": reader.back, "fenced": reader.fenced,
            "worker_cpu_s": [round(worker.cpu_s, 1) for worker in site.workers],
            "worker_rss_mb": [round(worker.rss_mb) for worker in site.workers],
            "processors": os.cpu_count(),
        }  # fmt: skip
        print(json.dumps(summary, indent=1))
        if args.words:
            print(site.words(), file=sys.stderr)
    if args.json:
        args.json.write_text(json.dumps({"summary": summary, "faults": rows}, indent=1) + "\n")
    return int(bool(summary["over"] or summary["epoch_regressions"]))


def main(argv: list[str] | None = None) -> int:
    """Judge the workers."""
    parser = make_parser("python -m tests.bench.referee", "Judge workers that share a fleet.", __doc__ or "")
    parser.add_argument("--uavs", type=int, default=200)
    parser.add_argument("--workers", type=int, default=4)
    parser.add_argument("--pace", default=PACE)
    parser.add_argument("--router", default="tcp/127.0.0.1:7461")
    parser.add_argument("--zenohd", help="the real router; without it a session of ours in router mode")
    parser.add_argument("--recording", type=Path, help="a flight to play; without it one is flown first")
    parser.add_argument("--only", nargs="+", default=list(faults.ALL), choices=list(faults.ALL))
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument("--random", type=int, default=0, metavar="N", help="instead: so many faults at random")
    parser.add_argument("--warm", type=float, default=180.0, help="models are waited for no longer than so [s]")
    parser.add_argument("--ways", type=int, default=1, help="workers whose way to the router can be cut")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was measured")
    parser.add_argument("--words", action="store_true", help="show what the processes said")
    return run_command("bench.referee", _run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
