"""Predictions after a change of flight mode or a lost link, beside those of undisturbed flight.

    python -m tests.bench.mode_changes s03_nominal_modes.tlog.xz
    python -m tests.bench.mode_changes --seeds 1-3 --autopilot px4 --only losses

Recordings: for each change to a mode that the autopilot flies by itself, the delay until the first prediction along the
route of the new mode, and its error 10 s later over the median error of predictions in undisturbed flight (no change
within 40 s).

Seeds: JSBSim flights in a wind of 4 m/s, with mode changes commanded by MAVLink, and with a lost link for every
failsafe. The error is that of the newest prediction 2 s after the change, beside that of undisturbed predictions of the
same flight: of all, and of those whose flight turns by a similar angle; and beside that with the state and route of the
aircraft's own controller, which no better knowledge of the change can improve.
"""

import argparse
import json
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

from fleet.cli import id_range
from tests.bench.mode_changes import changes, losses, recorded

PARTS = {"changes": changes, "losses": losses}


def main() -> None:
    """Print the tables."""
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m tests.bench.mode_changes", description=__doc__, formatter_class=form)
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE", help="recordings")
    parser.add_argument("--seeds", type=id_range, default=(), metavar="A-B", help="simulated flights")
    parser.add_argument("--autopilot", nargs="+", choices=tuple(changes.SCHEDULES), default=tuple(changes.SCHEDULES))
    parser.add_argument("--only", choices=tuple(PARTS), help="one part of the simulated flights")
    parser.add_argument("--json", type=Path, help="write the changes and losses to FILE")
    args = parser.parse_args()
    results: dict[str, list[Any]] = {"recorded": [], "changes": [], "losses": []}
    if args.files:
        for line, change in recorded.report(args.files):
            print(line, flush=True)
            results["recorded"] += [] if change is None else [change]
        print(f"{sum(c.is_met for c in results['recorded'])} of {len(results['recorded'])} met", flush=True)
    for name, part in PARTS.items():
        if args.seeds and args.only in (None, name):
            for seed in args.seeds:
                for autopilot in args.autopilot:
                    with tempfile.TemporaryDirectory() as folder:
                        results[name] += part.measure(seed, autopilot, Path(folder))
            print(*part.report(results[name]), sep="\n", flush=True)
    if args.json:
        plain = {name: [asdict(result) for result in part] for name, part in results.items()}
        args.json.write_text(json.dumps(plain, indent=1) + "\n")


if __name__ == "__main__":
    main()
