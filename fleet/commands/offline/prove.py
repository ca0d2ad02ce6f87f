"""Test the diagnosis blindly: conceal effects, seal the labels, commit the reports, open the labels, score."""

import argparse
import json
from pathlib import Path
from tempfile import TemporaryDirectory

from fleet.cli import stop_on_signal
from fleet.process.file_options import MODEL, airframe_card, input_file, output_file, output_folder
from fleet.process.logs import report_progress
from fleet.telemetry.recording.options import RecordingOptions, add_recording_arguments

EXAMPLES = """
  fleet prove --flights 12                                  a demonstration of some minutes
  fleet prove --seed 7 --flights 12 --report proof          store recordings, reports and a page for every flight
  fleet prove --aircraft quad --flights 30                  multirotors on RotorPy
  fleet prove --seed 9001 --flights 140 --json proof.json   the complete test
  fleet prove --inject monday/*.tlog --flights 40           faults in your own healthy flights, against their own past
  fleet prove --inject a.tlog b.tlog c.tlog --against a.tlog b.tlog c.tlog    each against the other two
"""
_MIN_FLIGHTS, _MAX_FLIGHTS = 6, 2000


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--seed", type=int, default=1, help="random seed of aircraft, missions, weather, effects (1)")
    parser.add_argument("--flights", type=int, default=12, metavar="N", help="flights, on two airframes (12)")
    parser.add_argument(
        "--aircraft", choices=("wing", "quad"), default="wing", help="class of the simulated aircraft (wing)"
    )
    parser.add_argument("--json", type=output_file, metavar="FILE", help="write scores, marks and hashes")
    parser.add_argument(
        "--report", type=output_folder, metavar="DIR", help="store recordings, reports and pages in DIR"
    )
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (2)")
    parser.add_argument(
        "--smallest",
        type=float,
        default=1.0,
        metavar="SHARE",
        help="simulated effects of SHARE to 1 times their usual magnitude, for limits of detection (1)",
    )
    group = parser.add_argument_group("recordings", "conceal faults in recordings instead of simulated flights")
    group.add_argument(
        "--inject", type=input_file(), nargs="+", metavar="FLIGHT", help="healthy flights of one fixed wing"
    )
    group.add_argument(
        "--model", type=input_file(MODEL), metavar="MODEL", help="reference: output of `fleet calibrate`"
    )
    group.add_argument(
        "--against",
        type=input_file(),
        nargs="+",
        metavar="NOMINAL",
        help="or other healthy flights, each flight without itself; otherwise the past of each flight",
    )
    group.add_argument(
        "--airframe", type=airframe_card, metavar="CARD", help="without --model: the aircraft, as for calibrate"
    )
    add_recording_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Run the blind test; return exit code 0 when it is complete, independent of the scores.

    Raises:
        ValueError: when an option is invalid; the text names it.
    """
    _check(args)
    with TemporaryDirectory(prefix="parauav-proof-") as temporary:
        folder = args.report or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        return _run_test(args, folder)


def _run_test(args: argparse.Namespace, folder: Path) -> int:
    from rich.console import Console

    from fleet.blind_test import page, shown
    from fleet.blind_test.course import BlindTestConfig, InjectedFlights, RunAborted, run_blind_test
    from fleet.blind_test.mark import score

    injected = None
    if args.inject:
        options = RecordingOptions.of(args)
        against = tuple(args.against or ())
        injected = InjectedFlights(tuple(args.inject), args.model, against, args.airframe, options)
    setup = BlindTestConfig(
        args.seed, args.flights, folder, args.jobs, args.report is not None, injected, args.smallest, args.aircraft
    )
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
    if not 0.01 <= args.smallest <= 1.0:
        raise ValueError(f"--smallest: found {args.smallest:g}, expected 0.01..1; change it")
    if args.aircraft == "quad" and args.smallest < 1.0:
        raise ValueError("--smallest: found it with --aircraft quad, expected wings; leave one out")
    if args.report and args.report.exists() and any(args.report.iterdir()):
        raise ValueError(f"--report: found files in {str(args.report)!r}, expected an empty folder; name another")
    _check_recordings(args)


def _check_recordings(args: argparse.Namespace) -> None:
    """Validate the options of recordings before anything is read."""
    given = [name for name in ("model", "against", "airframe", "mission", "params", "columns") if getattr(args, name)]
    if given and not args.inject:
        raise ValueError(f"--{given[0]}: found it without --inject, expected recordings; name them with --inject")
    if not args.inject:
        return
    if args.model and (args.against or args.airframe):
        raise ValueError("expected one of --model and --against, and --airframe without --model; leave one out")
    if args.aircraft == "quad":
        raise ValueError("--aircraft: found quad with --inject, expected simulated flights; leave one out")
    if args.smallest < 1.0:
        raise ValueError("--smallest: found it with --inject, expected simulated flights; leave it out")
    stems = [path.name.split(".")[0] for path in args.inject]
    if len(set(stems)) < len(stems):
        raise ValueError("--inject: found two flights of one name, expected different names; rename one")
    if args.against:
        others = min(len({p.absolute() for p in args.against} - {path.absolute()}) for path in args.inject)
        if others < 2:
            raise ValueError(
                f"--against: found {others} flights besides one of --inject, expected 2 to calibrate; name more"
            )
