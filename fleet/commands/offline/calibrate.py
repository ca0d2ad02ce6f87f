"""Calibrate an aircraft's simulation on nominal flights, for `fleet diagnose`."""

import argparse

from fleet.cli import run_module
from fleet.process.file_options import airframe_card, input_file, output_file
from fleet.telemetry.recording.options import RecordingOptions, add_recording_arguments

EXAMPLES = """
  fleet calibrate monday/*.tlog --airframe skywalker --out skywalker.json
  fleet calibrate calm.tlog windy.tlog --out plane.json         without a card: unit mass, dimensional derivatives
  fleet calibrate today.tlog --until 120 --out today.json       on the first two minutes of a flight itself
  fleet calibrate cal_*.tlog --airframe card.json --out c172.json --json figures.json
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options; `python -m twin_worker.diagnosis.learn` takes the same."""
    parser.add_argument(
        "file",
        nargs="+",
        type=input_file(),
        metavar="NOMINAL",
        help="recordings without a fault, with much manoeuvring",
    )
    parser.add_argument(
        "--airframe", type=airframe_card, metavar="CARD", help="airframe TOML, its name, or a JSON card (none)"
    )
    parser.add_argument(
        "--until", type=float, metavar="SECONDS", help="use only the data before SECONDS on each flight's clock"
    )
    parser.add_argument("--out", type=output_file, required=True, metavar="MODEL", help="write the simulation to MODEL")
    parser.add_argument("--json", type=output_file, metavar="FILE", help="write the fit achieved to FILE")
    add_recording_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Start the calibration and return its exit code."""
    values = {name: getattr(args, name) for name in ("airframe", "until", "out", "json")}
    options = [f"--{name}={value}" for name, value in values.items() if value]
    options += RecordingOptions.of(args).arguments()
    lost = "no model was written"
    return run_module("calibrate", lost, "twin_worker.diagnosis.learn", *options, "--", *map(str, args.file))
