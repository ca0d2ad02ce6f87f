"""`python -m twin_worker.diagnosis.learn NOMINAL…`: the process behind `fleet calibrate`."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from fleet.cli import guarded, parser_for
from fleet.commands.offline.calibrate import EXAMPLES, arguments
from fleet.process.logs import tell
from twin_worker.diagnosis.baseline.calibrate import calibrate
from twin_worker.diagnosis.baseline.past import before, calibrate_past
from twin_worker.diagnosis.data.card import UNKNOWN, Card, read
from twin_worker.diagnosis.data.flight import Flight, read_flights
from twin_worker.diagnosis.inference.diagnose import uncovered
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.diagnosis.output.keep import save


def say(word: str) -> None:
    """Log a progress message."""
    tell("diagnose", word)


def card_of(path: Path | None) -> Card:
    """Read the aircraft card, or return `UNKNOWN` with a log message."""
    if path is not None:
        return read(path)
    say("no airframe card: assuming unit mass and geometry; masses and coefficients are relative, not in kg")
    return UNKNOWN


def flights_of(files: Sequence[Path], card: Card) -> list[Flight]:
    """Read the flights of all recordings.

    Raises:
        ValueError: if a recording has no usable flight.
        OSError: if a file cannot be read.
    """
    found = []
    for path in files:
        say(f"reading {path.name}")
        found += read_flights(path, card)
    return found


def learn(files: Sequence[Path], card: Card, until: float | None = None) -> Baseline:
    """Calibrate on recordings, or on the part of each before `until` [s, on its own clock]."""
    flights = flights_of(files, card)
    if until is None:
        base = calibrate(flights, card, say)
    elif len(flights) == 1:
        base = calibrate_past(flights[0], until, card, say)
    else:
        base = calibrate([before(flight, until) for flight in flights], card, say)
    for sentence in uncovered(base):
        say(sentence)
    return base


def _run(args: argparse.Namespace) -> int:
    if not args.out.absolute().parent.is_dir():
        raise ValueError(f"--out: found no folder {str(args.out.parent)!r}, expected one; make it first")
    base = learn(args.file, card_of(args.airframe), args.until)
    save(args.out, base)
    explained = ", ".join(f"{name} {x:.0%}" for name, x in base.r2.items())
    print(f"{args.out.name}: calibrated on {len(base.flights)} flights; variance explained: {explained}")
    if args.json:
        args.json.write_text(json.dumps({"flights": base.flights, "r2": base.r2, "chance": base.chance}, indent=1))
    return 0


def main(argv: list[str] | None = None) -> int:
    """Calibrate on the recordings named on the command line."""
    parser = parser_for("python -m twin_worker.diagnosis.learn", "Calibrate a simulation on nominal flights.", EXAMPLES)
    arguments(parser)
    return guarded("calibrate", _run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
