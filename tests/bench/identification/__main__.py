"""How well, and how fast, each method identifies aircraft under an autopilot.

    python -m tests.bench.identification --json identification.json
    python -m tests.bench.identification --scenario gust --scenario thor --method ours --method nfoursid --windows 20

Peers need the extra `bench` (`make bench-setup`), moen4 also Octave with its control package; what is absent is named.
Recorded flights are looked for in PARAUAV_RECORDINGS. Best run on a quiet machine: times are processor times.
"""

import argparse
import json
import os
import platform
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from . import gusty, peers, pretended, recorded
from .flight import Case, Method
from .measure import Result, foretold, over, run, summary
from .ours import Ours
from .plain import Hold, WindowMean
from .score import KEYS
from .table import show
from .windows import Span, spans

SCENARIOS = (*gusty.WEATHER, "jsbsim_c172p", "jsbsim_small", "flightstack", "thor")
PLAIN: dict[str, Callable[[], Method]] = {"ours": Ours, "window_mean": WindowMean, "hold": Hold}
METHODS = ("ours", "oracle", "window_mean", "hold", *peers.PEERS)
OVERLAPPING = ("jsbsim_c172p", "flightstack", "thor")  # too short for windows of their own


def flights(scenario: str, seed: int, folder: Path | None) -> list[Case]:
    """Fly or read one scenario.

    Raises:
        FileNotFoundError: when its recordings are not there.
    """
    if scenario in gusty.WEATHER:
        return gusty.cases(scenario, seed)
    if scenario == "jsbsim_small":
        return pretended.cases(seed)
    if folder is None or not folder.is_dir():
        raise FileNotFoundError(f"{scenario}: found no recordings, expected their folder in PARAUAV_RECORDINGS; set it")
    return {"jsbsim_c172p": recorded.c172p, "flightstack": recorded.stack, "thor": recorded.thor}[scenario](folder)


def measured(
    cases: list[Case], laid: list[list[Span]], wanted: list[str], say: Callable[[str], None]
) -> dict[str, Any]:
    """Run the wanted methods on one scenario; give its part of the file."""
    results: dict[str, Result] = {}
    for method in wanted:
        if method == "oracle":
            result = foretold(cases, laid)
        else:
            make = PLAIN.get(method) or peers.method(method)
            say(method)
            run(make, cases[:1], [laid[0][:1]])  # compiles
            result = run(make, cases, laid)
        if result is not None:
            results[method] = result
    found = {method: summary(result) for method, result in results.items()}
    for method in [m for m in results if m not in peers.PEERS and m != "window_mean"]:
        for rival, choices in (("best_peer", peers.PEERS), ("window_mean", ("window_mean",))):
            if present := [name for name in choices if name in results]:
                found[method][f"over_{rival}"] = _over(results, found, method, present)
    return found


def _over(results: dict[str, Result], found: dict[str, Any], method: str, rivals: list[str]) -> dict[str, Any]:
    """Compare with the rival whose median is best, key by key."""
    out = {}
    for key in KEYS:
        best = max(rivals, key=lambda rival: found[rival][key])
        out[key] = {"peer": best} | over(results[method], results[best], key)
    return out


def main(argv: list[str] | None = None) -> int:
    args = _parser().parse_args(argv)
    console = Console(width=220 if not sys.stdout.isatty() else None)
    folder = os.environ.get("PARAUAV_RECORDINGS")
    absent = peers.absent()
    wanted = [method for method in args.method or METHODS if method not in absent]
    for method, why in absent.items():
        if method in (args.method or METHODS):
            console.print(f"{method}: {why}", markup=False)
    file: dict[str, Any] = {}
    for scenario in args.scenario or SCENARIOS:
        try:
            cases = flights(scenario, args.seed, Path(folder) if folder else None)
        except FileNotFoundError as error:
            console.print(str(error), markup=False)
            continue
        hop = args.window / 2 if scenario in OVERLAPPING else args.window
        laid = spans(cases, args.window, hop, args.windows)
        file[scenario] = measured(cases, laid, wanted, partial(_say, scenario))
        show(scenario, file[scenario], console)
        if args.json:
            about = {"machine": platform.processor() or platform.machine(), "seed": args.seed, "window_s": args.window}
            about |= {"versions": peers.versions(wanted)}
            args.json.write_text(json.dumps(file | {"about": about}, indent=1) + "\n")
    return 0


def _say(scenario: str, method: str) -> None:
    print(f"{scenario}: {method}", file=sys.stderr, flush=True)


def _parser() -> argparse.ArgumentParser:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m tests.bench.identification", description=__doc__, formatter_class=form)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was measured")
    parser.add_argument("--scenario", action="append", choices=SCENARIOS, help="only this one; may be repeated (all)")
    parser.add_argument("--method", action="append", choices=METHODS, help="only this one; may be repeated (all)")
    parser.add_argument("--windows", type=int, metavar="N", help="at most so many windows per scenario (all)")
    parser.add_argument("--window", type=float, default=40.0, metavar="S", help="length of a window [s] (40)")
    parser.add_argument("--seed", type=int, default=0, help="of the flights that are flown for this (0)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
