"""A site that is hurt every few seconds, for long: does memory grow, is anyone left without a writer, or with two?

    python -m tests.bench.referee.soak --minutes 30 --json soak.json
    python -m tests.bench.referee.soak --minutes 30 --uavs 24 --workers 3 --recording flight.tlog

One worker is never killed nor sent away, though frozen and cut off like the others, so that its memory can be followed
all the way; so can the gateway's and the reader's. Whenever the fleet has settled after a fault there are counted
`orphans`      aircraft of which a reader accepted nothing for 3 s
`doubles`      aircraft that two workers say they hold
and all the time
`epoch_regressions`  accepted results of a writer that had been replaced
`longest_gap_s`      between accepted predictions of any aircraft, by fault; without a router nobody is heard
What was found so far is written after every fault: an end before the time loses nothing.
"""

import argparse
import json
import os
import platform
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from fleet.cli import make_parser, run_command
from fleet.contract import Claim, FleetState

from .__main__ import RANDOM, happen, settle
from .faults import wait
from .memory import Memory
from .site import Site, fly, until

PACE = "predict=5,identify=5,ensemble=10,renew=0.5"
_SILENT_S = 3.0  # without an accepted prediction, an orphan [s]
_PARTITIONS = ("cut", "stall")


class Soak:
    """One run, and what it has found so far."""

    def __init__(self, site: Site, seed: int) -> None:
        assert site.spared is not None
        self.site, self.rng = site, np.random.default_rng(seed)
        self.spared = site.spared.name
        self.memory = Memory(site, {"gateway": site.gateway.pid, "reader": os.getpid()})
        self.rows: list[dict[str, Any]] = []
        self.orphans: list[dict[str, Any]] = []
        self.doubles: list[int] = []
        self.begun = time.monotonic()

    def hurt(self) -> None:
        """Do one fault drawn by lot, and look at the fleet once it has settled."""
        name, since = str(self.rng.choice(RANDOM)), time.monotonic()
        try:
            row = happen(self.site, name, self.rng)
        except TimeoutError as error:  # it has not settled
            row = {"fault": name, "failed": str(error)}
        for worker in [one for one in self.site.workers if one.process.poll() is not None]:
            self.site.lose(worker)  # of a fault that failed
        row["longest_gap_s"] = self.site.reader.gap(set(range(self.site.uavs)), since)
        self.rows.append(row)
        self._look(name)
        self.memory.note()

    def _look(self, after: str) -> None:
        reader = self.site.reader
        for uav in sorted(reader.silent(set(range(self.site.uavs)), _SILENT_S)):
            states = [row for state, _ in reader.bus.get(FleetState) for row in state.rows if row.uav == uav]
            said = [f"{row.worker} {row.state} {row.prediction_age_s} {row.verdict}" for row in states]
            self.orphans.append({"uav": uav, "after": after, "fault": len(self.rows), "held": said})
        held = Counter(uav for claim, _ in reader.bus.get(Claim) for uav, _ in claim.owned)
        self.doubles += [uav for uav, count in held.items() if count > 1]

    def summary(self) -> dict[str, Any]:
        """Give what has been found."""
        by_fault = defaultdict(list)
        for row in self.rows:
            by_fault[row["fault"]].append(row)
        reader = self.site.reader
        count = {name: len(rows) for name, rows in by_fault.items()}
        return {
            "minutes": round((time.monotonic() - self.begun) / 60.0, 1), "faults": len(self.rows),
            "by_fault": {name: _told(rows) for name, rows in sorted(by_fault.items())},
            "router_kills": count.get("restart_router", 0),
            "owners_changed_by_router_kills": sum(row.get("owners_changed", 0) for row in by_fault["restart_router"]),
            "partitions_healed": sum("back" in row for name in _PARTITIONS for row in by_fault[name]),
            "delays": count.get("delay", 0), "failed": [row["failed"] for row in self.rows if "failed" in row],
            "orphans": len(self.orphans), "doubles": len(self.doubles), "epoch_regressions": reader.regressions,
            "data_time_regressions": reader.back, "fenced": reader.fenced, "takeovers": reader.changes,
            "memory": self.memory.found(self.spared), "orphans_were": self.orphans,
        }  # fmt: skip

    def progress(self) -> str:
        """Give one line on the run."""
        reader, last = self.site.reader, self.rows[-1]
        row = next(row for row in reversed(self.memory.rows) if row.who == self.spared)
        return (
            f"{(time.monotonic() - self.begun) / 60:.1f} min, {len(self.rows)} faults, last {last['fault']}, "
            f"gap {last['longest_gap_s']:.1f} s; so far {len(self.orphans)} orphans, {len(self.doubles)} doubles, "
            f"{reader.regressions} regressions, {sum('failed' in row for row in self.rows)} failed; "
            f"worker {row.mb:.0f} MB with {row.aircraft} aircraft; load {os.getloadavg()[0]:.1f}"
        )


def _told(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Give how often, and times: in the middle of the faults, and at most."""
    told: dict[str, Any] = {"times": len(rows)}
    for name in ("longest_gap_s", "taken_s", "ended_s"):
        if took := [row[name] for row in rows if row.get(name) is not None]:
            told[name] = [round(float(np.median(took)), 2), round(max(took), 2)]
    return told


def _bad(found: dict[str, Any]) -> bool:
    grown = [name for name, one in found["memory"].items() if one["grows"]]
    return bool(found["orphans"] or found["doubles"] or found["epoch_regressions"] or found["failed"] or grown)


def _open(site: Site, args: argparse.Namespace, folder: Path) -> None:
    recording = args.recording or fly(folder / "flight.tlog", 60.0 * args.minutes + 600.0)
    site.wanted = args.workers
    site.open(recording, args.workers)
    site.spared = site.workers[0]
    settle(site)
    until(lambda: not site.reader.silent(set(range(site.uavs)), _SILENT_S), 300.0, "a prediction of everyone")


def _run(args: argparse.Namespace) -> int:
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    ways = args.workers if args.ways is None else args.ways
    with (
        tempfile.TemporaryDirectory() as folder,
        Site(args.uavs, args.router, zenohd=args.zenohd, pace=args.pace, ways=ways) as site,
    ):
        _open(site, args, Path(folder))
        run = Soak(site, args.seed)
        head = {
            "machine": platform.processor() or platform.machine(), "processors": os.cpu_count(), "uavs": args.uavs,
            "workers": args.workers, "pace": args.pace, "router": args.zenohd or "embedded",
        }  # fmt: skip
        try:
            while (now := time.monotonic() - run.begun) < 60.0 * args.minutes:
                run.hurt()
                print(run.progress(), file=sys.stderr, flush=True)
                _write(args.json, head | run.summary() | {"load": os.getloadavg()[0]})
                wait(max(now + args.every - (time.monotonic() - run.begun), 0.0))
        except KeyboardInterrupt:
            head["interrupted"] = True
        found = head | run.summary() | {"load": os.getloadavg()[0]}
    print(json.dumps(found, indent=1), flush=True)
    _write(args.json, found)
    return int(_bad(found))


def _write(path: Path | None, found: dict[str, Any]) -> None:
    if path is not None:
        path.write_text(json.dumps(found, indent=1) + "\n")


def main(argv: list[str] | None = None) -> int:
    """Soak."""
    parser = make_parser("python -m tests.bench.referee.soak", "Hurt a site for long.", __doc__ or "")
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--every", type=float, default=10.0, help="between faults, at least [s]")
    parser.add_argument("--uavs", type=int, default=30)
    parser.add_argument("--workers", type=int, default=3)
    parser.add_argument("--ways", type=int, help="workers whose way to the router can be cut (all)")
    parser.add_argument("--pace", default=PACE)
    parser.add_argument("--router", default="tcp/127.0.0.1:7467")
    parser.add_argument("--zenohd", help="the real router; without it a session of ours in router mode")
    parser.add_argument("--recording", type=Path, help="a flight to play, long enough; without it one is flown first")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was found, anew after every fault")
    return run_command("bench.referee.soak", _run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
