"""A site that is hurt every few seconds, for long: does memory grow, is anyone left without a writer, or with two?

    python -m tests.bench.referee.soak --minutes 30 --json soak.json

One worker is never killed nor sent away, though frozen and cut off like the others, so that its memory can be followed
all the way; so can the gateway's. `orphans`: aircraft of which a reader accepts nothing for 3 s, counted whenever the
fleet has settled after a fault. `epoch_regressions`: accepted results of a writer that had been replaced.
"""

import argparse
import json
import os
import platform
import sys
import tempfile
import time
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from fleet.cli import guarded, parser_for

from .__main__ import RANDOM, happen, settle
from .faults import wait
from .site import Site, fly, rss_mb, until

PACE = "predict=5,identify=5,ensemble=10,renew=0.5"
_SILENT_S = 3.0  # without an accepted prediction, an orphan [s]
_SETTLED = 0.3  # share of the time after which memory should grow no more: windows and records are full [-]


class Memory:
    """Resident memory of those that live from the beginning to the end."""

    def __init__(self, pids: dict[str, int]) -> None:
        self._pids, self._begun = pids, time.monotonic()
        self.at: list[float] = []
        self.mb: dict[str, list[float]] = defaultdict(list)

    def note(self) -> None:
        """Take one sample of each."""
        self.at.append((time.monotonic() - self._begun) / 60.0)
        for name, pid in self._pids.items():
            self.mb[name].append(rss_mb(pid))

    def growth(self) -> dict[str, dict[str, float]]:
        """Give first and last value [MB], and the slope over the settled part [MB a minute]."""
        at = np.array(self.at)
        late = at >= _SETTLED * at[-1]
        return {
            name: {
                "first_mb": round(mb[0], 1),
                "last_mb": round(mb[-1], 1),
                "mb_a_minute": round(float(np.polyfit(at[late], np.array(mb)[late], 1)[0]), 3) if late.sum() > 2 else 0,
            }
            for name, mb in self.mb.items()
        }


def soak(site: Site, minutes: float, every_s: float, seed: int) -> dict[str, Any]:
    """Hurt a site that flies, until the time is over."""
    rng, everyone = np.random.default_rng(seed), set(range(site.uavs))
    assert site.spared is not None
    memory = Memory({"worker": site.spared.process.pid, "gateway": site.gateway.pid, "reader": os.getpid()})
    faults: Counter[str] = Counter()
    over: Counter[str] = Counter()
    failed, orphans, begun = [], 0, time.monotonic()
    gaps: list[float] = []
    while (now := time.monotonic() - begun) < 60.0 * minutes:
        name = str(rng.choice(RANDOM))
        row = happen(site, name, rng)
        faults[name] += 1
        over[name] += bool(row["over"])
        gaps.append(row.get("gap_s", 0.0))
        failed += [row["failed"]] if "failed" in row else []
        orphans += len(site.reader.silent(everyone, _SILENT_S))
        memory.note()
        wait(max(now + every_s - (time.monotonic() - begun), 0.0))
    return {
        "minutes": round((time.monotonic() - begun) / 60.0, 1), "faults": dict(faults), "over_limits": dict(+over),
        "failed": failed, "orphans": orphans, "epoch_regressions": site.reader.regressions,
        "fenced": site.reader.fenced, "longest_gap_s": round(max(gaps, default=0.0), 2),
        "median_of_longest_gaps_s": round(float(np.median(gaps)), 2), "memory": memory.growth(),
    }  # fmt: skip


def _run(args: argparse.Namespace) -> int:
    with (
        tempfile.TemporaryDirectory() as folder,
        Site(args.uavs, args.router, zenohd=args.zenohd, pace=args.pace, ways=1) as site,
    ):
        recording = args.recording or fly(Path(folder) / "flight.tlog", 60.0 * args.minutes + 600.0)
        site.wanted = args.workers
        site.open(recording, args.workers)
        site.spared = site.workers[0]
        settle(site)
        until(lambda: not site.reader.silent(set(range(site.uavs)), _SILENT_S), 300.0, "a prediction of everyone")
        found = soak(site, args.minutes, args.every, args.seed)
    summary = {
        "machine": platform.processor() or platform.machine(), "processors": os.cpu_count(), "uavs": args.uavs,
        "workers": args.workers, "pace": args.pace, "router": args.zenohd or "embedded", **found,
        "load": os.getloadavg()[0],
    }  # fmt: skip
    print(json.dumps(summary, indent=1))
    if args.json:
        args.json.write_text(json.dumps(summary, indent=1) + "\n")
    return int(bool(found["orphans"] or found["epoch_regressions"] or found["failed"]))


def main(argv: list[str] | None = None) -> int:
    """Soak."""
    parser = parser_for("python -m tests.bench.referee.soak", "Hurt a site for long.", __doc__ or "")
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--every", type=float, default=10.0, help="between faults, at least [s]")
    parser.add_argument("--uavs", type=int, default=30)
    parser.add_argument("--workers", type=int, default=3)
    parser.add_argument("--pace", default=PACE)
    parser.add_argument("--router", default="tcp/127.0.0.1:7467")
    parser.add_argument("--zenohd", help="the real router; without it a session of ours in router mode")
    parser.add_argument("--recording", type=Path, help="a flight to play, long enough; without it one is flown first")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, metavar="FILE")
    return guarded("bench.referee.soak", _run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
