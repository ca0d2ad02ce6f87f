"""`python -m twin_worker.diagnose FLIGHT…`: what `fleet diagnose` starts."""

import argparse
import sys
from pathlib import Path

from fleet.cli import guarded, parser_for
from fleet.commands.diagnose import EXAMPLES, arguments
from twin_worker.diagnose import keep, written
from twin_worker.diagnose.baseline import Baseline
from twin_worker.diagnose.diagnose import diagnose
from twin_worker.diagnose.flight import read_flights
from twin_worker.diagnose.learn import card_of, learn, say
from twin_worker.diagnose.report import Outcome, Report


def _run(args: argparse.Namespace) -> int:
    for option, path in (("--json", args.json), ("--report", args.report)):
        if path and not path.absolute().parent.is_dir():
            raise ValueError(f"{option}: found no folder {str(path.parent)!r}, expected one; make it first")
    base = keep.load(args.model)[0] if args.model else learn(args.against, card_of(args.airframe))
    reports: list[Report] = []
    refused = 0
    for path in args.file:
        try:
            flights = read_flights(path, base.card)
            for flight in flights:
                say(f"{flight.name}: {flight.seconds:.0f} s of flight")
                reports.append(diagnose(flight, base, say))
                print(f"{flight.name}: {reports[-1].sentence}", flush=True)
        except (ValueError, OSError) as error:  # one bad recording loses no other
            refused += 1
            say(str(error))
    if args.json:
        written.write(reports, args.json)
    if args.report:
        _page(reports, base, args.report)
    return 2 if refused and not reports else 1 if refused else 0


def _page(reports: list[Report], base: Baseline, folder: Path) -> None:
    """Write figures, page and the simulations corrected by what was named."""
    from twin_worker.diagnose.figures import stems
    from twin_worker.diagnose.page import write

    folder.mkdir(exist_ok=True)
    for report, stem in zip(reports, stems([report.flight for report in reports]), strict=True):
        if report.outcome is Outcome.NAMED:
            keep.save(folder / f"{stem}.model.json", base, report.findings)
    say(f"wrote {write(reports, folder)}")


def main(argv: list[str] | None = None) -> int:
    """Diagnose the recordings named on the command line."""
    parser = parser_for("python -m twin_worker.diagnose", "Diagnose flights against a simulation.", EXAMPLES)
    arguments(parser)
    return guarded("diagnose", _run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
