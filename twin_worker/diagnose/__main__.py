"""`python -m twin_worker.diagnose FLIGHT…`: what `fleet diagnose` starts."""

import argparse
import sys
from pathlib import Path

from fleet.cli import guarded, parser_for
from fleet.commands.diagnose import EXAMPLES, arguments, check
from twin_worker.diagnose import keep, written
from twin_worker.diagnose.baseline import Baseline
from twin_worker.diagnose.learn import card_of, learn, say
from twin_worker.diagnose.report import Outcome, Report
from twin_worker.diagnose.share import shared


def _run(args: argparse.Namespace) -> int:
    check(args)
    base = keep.load(args.model)[0] if args.model else learn(args.against, card_of(args.airframe))
    reports: list[Report] = []
    refused = 0
    for found, why in shared(args.file, base, args.jobs, say):
        for report in found:
            print(f"{report.flight}: {report.sentence}", flush=True)
        reports += found
        if why:
            refused += 1
            say(why)
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
