"""Test the diagnosis blindly: conceal effects, seal the labels, commit the reports, open the labels, score."""

import argparse
import json
from pathlib import Path
from tempfile import TemporaryDirectory

from fleet.cli import stop_on_signal
from fleet.process.logs import tell

EXAMPLES = """
  fleet prove --flights 12                                  a demonstration of some minutes
  fleet prove --seed 7 --flights 12 --report proof          store recordings, reports and a page for every flight
  fleet prove --seed 9001 --flights 140 --json proof.json   the complete test
"""
_FEWEST, _MOST = 6, 2000


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--seed", type=int, default=1, help="random seed of aircraft, missions, weather, effects (1)")
    parser.add_argument("--flights", type=int, default=12, metavar="N", help="flights, on two airframes (12)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write scores, marks and hashes")
    parser.add_argument("--report", type=Path, metavar="DIR", help="store recordings, reports and pages in DIR")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (2)")


def run(args: argparse.Namespace) -> int:
    """Run the blind test; return exit code 0 when it is complete, independent of the scores.

    Raises:
        ValueError: when an option is invalid; the text names it.
    """
    _check(args)
    with TemporaryDirectory(prefix="parauav-proof-") as brief:
        folder = args.report or Path(brief)
        folder.mkdir(exist_ok=True)
        return _examined(args, folder)


def _examined(args: argparse.Namespace, folder: Path) -> int:
    from rich.console import Console

    from fleet.blind_test import page, shown
    from fleet.blind_test.course import Ended, Paper, examine
    from fleet.blind_test.score import score

    paper = Paper(args.seed, args.flights, folder, args.jobs, pages=args.report is not None)
    try:
        marked = examine(paper, stop_on_signal(), _say)
    except Ended as ended:
        return ended.code
    scores = score(marked.marks)
    Console().print(shown.table(marked.marks, scores))
    if args.json:
        args.json.write_text(json.dumps(shown.written(paper, marked, scores), indent=1) + "\n")
    if args.report:
        _say(f"wrote {page.write(paper, marked, scores)}")
    return 0


def _say(words: str) -> None:
    tell("prove", words)


def _check(args: argparse.Namespace) -> None:
    if not _FEWEST <= args.flights <= _MOST:
        raise ValueError(f"--flights: found {args.flights}, expected {_FEWEST}..{_MOST}; change it")
    if not 0 <= args.seed < 2**31:
        raise ValueError(f"--seed: found {args.seed}, expected an integer from 0; change it")
    if not 1 <= args.jobs <= 64:
        raise ValueError(f"--jobs: found {args.jobs}, expected 1..64; change it")
    for option, path in (("--json", args.json), ("--report", args.report)):
        if path and not path.absolute().parent.is_dir():
            raise ValueError(f"{option}: found no folder {str(path.parent)!r}, expected one; create it first")
    if args.report and args.report.exists() and any(args.report.iterdir()):
        raise ValueError(f"--report: found files in {str(args.report)!r}, expected an empty folder; name another")
