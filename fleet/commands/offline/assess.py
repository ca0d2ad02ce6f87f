"""Replay recordings through the twins as if live, and score every prediction against the recorded flight."""

import argparse

from fleet.cli import run_module
from fleet.process.file_options import input_file, output_file, output_folder
from fleet.telemetry.recording.options import RecordingOptions, add_recording_arguments

EXAMPLES = """
  fleet assess flight.tlog
  fleet assess monday/*.tlog.xz --out monday --json monday.json --jobs 2
  fleet assess flight.tlog --methods route_wind --without-params     without autopilot parameters
"""
OWN_METHODS = ("auto", "dynamics", "hybrid", "paper")
BASELINE_METHODS = ("cv", "ct", "imm", "route", "route_wind", "paper", "dynamics")


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options; `python -m twin_worker.evaluation` takes the same."""
    parser.add_argument(
        "file", nargs="+", type=input_file(), metavar="FILE", help="recordings of any kind, also compressed"
    )
    parser.add_argument("--every", type=float, default=5.0, metavar="S", help="interval between starts (5)")
    parser.add_argument(
        "--method", default=OWN_METHODS[0], choices=OWN_METHODS, help="method of the twin (auto: the best available)"
    )
    parser.add_argument(
        "--methods",
        default=",".join(BASELINE_METHODS),
        metavar="A,B",
        help=f"compare with these ({','.join(BASELINE_METHODS)})",
    )
    parser.add_argument(
        "--without-params", action="store_true", help="withhold the autopilot's parameters from the twins"
    )
    parser.add_argument(
        "--out", type=output_folder, metavar="DIR", help="draw figures and write predictions.npz into DIR"
    )
    parser.add_argument("--json", type=output_file, metavar="FILE", help="write the figures to FILE")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes that share the aircraft (1)")
    parser.add_argument("--offset", type=int, default=0, help="UAV id = MAVLink system id + this (0)")
    add_recording_arguments(parser)


def check_arguments(args: argparse.Namespace) -> None:
    """Validate the options before anything is read.

    Raises:
        ValueError: when an option is invalid; the text names it.
    """
    if not 1.0 <= args.every <= 600.0:
        raise ValueError(f"--every: found {args.every:g} s, expected 1..600; a twin predicts once a second")
    unknown = [name for name in baseline_methods(args.methods) if name not in BASELINE_METHODS]
    if unknown:
        raise ValueError(
            f"--methods: found {', '.join(unknown)}, expected some of {', '.join(BASELINE_METHODS)}; correct it"
        )
    if not 1 <= args.jobs <= 64:
        raise ValueError(f"--jobs: found {args.jobs}, expected 1..64; change it")
    if args.json and any(args.json.exists() and path.samefile(args.json) for path in args.file):
        raise ValueError(f"--json: found the recording {str(args.json)!r} itself, expected another file; rename it")


def baseline_methods(methods: str) -> tuple[str, ...]:
    """Parse the names of methods, without `ours`."""
    return tuple(name for name in dict.fromkeys(methods.split(",")) if name and name != "ours")


def run(args: argparse.Namespace) -> int:
    """Start the assessment and return its exit code."""
    check_arguments(args)
    options = [f"--{name}={getattr(args, name)}" for name in ("every", "method", "methods", "jobs", "offset")]
    options += [f"--{name}={value}" for name, value in (("out", args.out), ("json", args.json)) if value]
    options += ["--without-params"] if args.without_params else []
    options += RecordingOptions.of(args).arguments()
    lost = "unfinished results are not written"
    return run_module("assess", lost, "twin_worker.evaluation", *options, "--", *map(str, args.file))
