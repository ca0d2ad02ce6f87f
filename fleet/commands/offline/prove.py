"""Test the diagnosis blindly: conceal effects, seal the labels, commit the reports, open the labels, score."""

import argparse
import json
from pathlib import Path
from tempfile import TemporaryDirectory

from fleet.cli import check_parent, stop_on_signal
from fleet.process.logs import report_progress

EXAMPLES = """
  fleet prove --flights 12                                  a demonstration of some minutes
  fleet prove --seed 7 --flights 12 --report proof          store recordings, reports and a page for every flight
  fleet prove --seed 9001 --flights 140 --json proof.json   the complete test
"""
_MIN_FLIGHTS, _MAX_FLIGHTS = 6, 2000


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
    with TemporaryDirectory(prefix="parauav-proof-") as temporary:
        folder = args.report or Path(temporary)
        folder.mkdir(exist_ok=True)
        return _run_test(args, folder)


def _run_test(args: argparse.Namespace, folder: Path) -> int:
    from rich.console import Console

    from fleet.blind_test import page, shown
    from fleet.blind_test.course import BlindTestConfig, RunAborted, run_blind_test
    from fleet.blind_test.mark import score

    setup = BlindTestConfig(args.seed, args.flights, folder, args.jobs, write_pages=args.report is not None)
    try:
        result = run_blind_test(setup, stop_on_signal(), _report)
    except RunAborted as ended:
        return ended.code
    scores = score(result.results)
    Console().print(shown.table(result.results, scores))
    if args.json:
        args.json.write_text(json.dumps(shown.as_json_values(setup, result, scores), indent=1) + "\n")
    if args.report:
        _report(f"wrote {page.write(setup, result, scores)}")
    return 0


def _report(text: str) -> None:
    report_progress("prove", text)


def _check(args: argparse.Namespace) -> None:
    if not _MIN_FLIGHTS <= args.flights <= _MAX_FLIGHTS:
        raise ValueError(f"--flights: found {args.flights}, expected {_MIN_FLIGHTS}..{_MAX_FLIGHTS}; change it")
    if not 0 <= args.seed < 2**31:
        raise ValueError(f"--seed: found {args.seed}, expected an integer from 0; change it")
    if not 1 <= args.jobs <= 64:
        raise ValueError(f"--jobs: found {args.jobs}, expected 1..64; change it")
    check_parent("--json", args.json)
    check_parent("--report", args.report)
    if args.report and args.report.exists() and any(args.report.iterdir()):
        raise ValueError(f"--report: found files in {str(args.report)!r}, expected an empty folder; name another")
