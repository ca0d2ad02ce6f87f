"""Locate deviations between a flight and its simulation, name the missing physics, and verify it on held-out data."""

import argparse
from pathlib import Path

from fleet.cli import run_module
from fleet.process.file_options import MODEL, airframe_card, check_file, input_file, output_file, output_folder
from fleet.telemetry.recording.options import RecordingOptions, add_recording_arguments

_MAX_PAST_S = 1e6

EXAMPLES = """
  fleet diagnose flight.tlog --model skywalker.json
  fleet diagnose friday/*.tlog.xz --model skywalker.json --json friday.json --report friday
  fleet diagnose flight.tlog --against-own-past 120     reference: its own first two minutes
  fleet diagnose flight.tlog --model skywalker.json --conceal airspeed       without the airspeed measurements
  fleet diagnose real.tlog --against simulated.tlog --airframe skywalker     corrections for your own simulator
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options; `python -m twin_worker.diagnosis` takes the same."""
    parser.add_argument("file", nargs="+", type=Path, metavar="FLIGHT", help="recordings of any kind, also compressed")
    parser.add_argument("--model", type=input_file(MODEL), metavar="MODEL", help="output of `fleet calibrate`")
    parser.add_argument(
        "--against",
        type=input_file(),
        nargs="+",
        metavar="SIMULATED",
        help="or recordings of a simulator on similar missions",
    )
    parser.add_argument(
        "--against-own-past",
        type=float,
        metavar="SECONDS",
        help="or each flight's own data before SECONDS on its clock; writes no corrected models",
    )
    parser.add_argument(
        "--airframe", type=airframe_card, metavar="CARD", help="without --model: the aircraft, as for calibrate"
    )
    parser.add_argument(
        "--conceal",
        default="",
        metavar="A,B",
        help="ignore these in the flights to diagnose: airspeed, wind, battery, imu, pressure, gnss, "
        "throttle, aileron, elevator, rudder",
    )
    parser.add_argument("--json", type=output_file, metavar="OUT", help="write verdicts to OUT, predictions next to it")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes that share the recordings (1)")
    parser.add_argument(
        "--report", type=output_folder, metavar="DIR", help="write figures, a page and corrected models into DIR"
    )
    add_recording_arguments(parser)


def check_arguments(args: argparse.Namespace) -> None:
    """Validate the options before anything is read.

    Raises:
        ValueError: when an option is invalid; the text names it.
    """
    if not 1 <= args.jobs <= 64:
        raise ValueError(f"--jobs: found {args.jobs}, expected 1..64; change it")
    if not any(path.is_file() for path in args.file):  # one of several is reported, and the others are diagnosed
        check_file("FLIGHT", args.file[0])
    if sum(map(bool, (args.model, args.against, args.against_own_past))) != 1:
        raise ValueError(
            "expected exactly one of --model, --against, --against-own-past; name one reference for the flights"
        )
    if args.against_own_past is not None and not 0 < args.against_own_past < _MAX_PAST_S:
        raise ValueError(f"--against-own-past: found {args.against_own_past:g} s, expected more than 0; change it")


def run(args: argparse.Namespace) -> int:
    """Start the diagnosis and return its exit code."""
    check_arguments(args)
    names = ("model", "airframe", "json", "report", "jobs", "against_own_past", "conceal")
    values = {name: getattr(args, name) for name in names}
    options = [f"--{name.replace('_', '-')}={value}" for name, value in values.items() if value]
    options += RecordingOptions.of(args).arguments()
    simulated = ["--against", *map(str, args.against)] if args.against else []
    lost = "unfinished results are not written"
    return run_module("diagnose", lost, "twin_worker.diagnosis", *options, *simulated, "--", *map(str, args.file))
