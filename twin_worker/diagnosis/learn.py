"""`python -m twin_worker.diagnosis.learn NOMINAL…`: the process behind `fleet calibrate`."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fleet.cli import make_parser, run_command
from fleet.commands.offline.calibrate import EXAMPLES, arguments
from fleet.process.logs import report_progress
from fleet.telemetry.recording.options import NO_OPTIONS, RecordingOptions
from twin_worker.diagnosis.baseline.calibrate import calibrate
from twin_worker.diagnosis.baseline.past import calibrate_past, part_before
from twin_worker.diagnosis.data.card import UNKNOWN, AircraftCard, read_card
from twin_worker.diagnosis.data.flight import FlightData, read_flights
from twin_worker.diagnosis.inference.diagnose import uncovered_axes
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.diagnosis.multirotor.baseline import save_rotors
from twin_worker.diagnosis.multirotor.recordings import calibrate_multirotor, holds_rotorcraft
from twin_worker.diagnosis.output.keep import save


def log_progress(message: str) -> None:
    """Log a progress message."""
    report_progress("diagnose", message)


def card_or_unknown(path: Path | None) -> AircraftCard:
    """Read the aircraft card, or return `UNKNOWN` with a log message."""
    if path is not None:
        return read_card(path)
    log_progress("no airframe card: assuming unit mass and geometry; masses and coefficients are relative, not in kg")
    return UNKNOWN


def calibrate_recordings(
    files: Sequence[Path],
    card: AircraftCard,
    until: float | None = None,
    options: RecordingOptions = NO_OPTIONS,
) -> Baseline:
    """Calibrate on recordings, or on the part of each before `until` [s, on its own clock].

    Raises:
        ValueError: if a recording has no usable flight.
        OSError: if a file cannot be read.
    """
    flights: list[FlightData] = []
    for path in files:
        log_progress(f"reading {path.name}")
        flights += read_flights(path, card, options)
    if until is None:
        base = calibrate(flights, card, log_progress)
    elif len(flights) == 1:
        base = calibrate_past(part_before(flights[0], until), card, log_progress).baseline(flights[0])
    else:
        base = calibrate([part_before(flight, until) for flight in flights], card, log_progress)
    for limitation in uncovered_axes(base):
        log_progress(limitation)
    return base


def _run(args: argparse.Namespace) -> int:
    options = RecordingOptions.of(args)
    if holds_rotorcraft(args.file[0], options):
        rotors = calibrate_multirotor(args.file, log_progress, np.inf if args.until is None else args.until, options)
        save_rotors(args.out, rotors)
        _summarise(args, rotors.flights, rotors.explained, rotors.chance)
        return 0
    base = calibrate_recordings(args.file, card_or_unknown(args.airframe), args.until, options)
    save(args.out, base)
    _summarise(args, base.flights, base.r2, base.chance)
    return 0


def _summarise(args: argparse.Namespace, flights: Sequence[str], r2: dict[str, float], chance: object) -> None:
    explained = ", ".join(f"{name} {x:.0%}" for name, x in r2.items())
    print(f"{args.out.name}: calibrated on {len(flights)} flights; variance explained: {explained}")
    if args.json:
        args.json.write_text(json.dumps({"flights": flights, "r2": r2, "chance": chance}, indent=1))


def main(argv: list[str] | None = None) -> int:
    """Calibrate on the recordings named on the command line."""
    parser = make_parser(
        "python -m twin_worker.diagnosis.learn", "Calibrate a simulation on nominal flights.", EXAMPLES
    )
    arguments(parser)
    return run_command("calibrate", _run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
