"""`python -m twin_worker.diagnosis FLIGHT…`: the process behind `fleet diagnose`."""

import argparse
import sys
from pathlib import Path

from fleet.cli import guarded, parser_for
from fleet.commands.offline.diagnose import EXAMPLES, arguments, check
from twin_worker.diagnosis.baseline import hidden
from twin_worker.diagnosis.baseline.own_past import OwnPast
from twin_worker.diagnosis.inference.report import Outcome, Report
from twin_worker.diagnosis.learn import card_of, learn, say
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.diagnosis.output import keep, written
from twin_worker.diagnosis.share import Against, shared


def _run(args: argparse.Namespace) -> int:
    check(args)
    args.conceal = tuple(filter(None, args.conceal.split(",")))
    hidden.check(args.conceal)
    against = _against(args)
    reports: list[Report] = []
    refused = 0
    for found, why in shared(args.file, against, args.jobs, say, args.conceal):
        for report in found:
            print(f"{report.flight}: {report.sentence}", flush=True)
        reports += found
        if why:
            refused += 1
            say(why)
    if args.json:
        written.write(reports, args.json)
    if args.report:
        _page(reports, against, args.report)
    return 2 if refused and not reports else 1 if refused else 0


def _against(args: argparse.Namespace) -> Against:
    """Return the reference of the diagnosis: a model, a calibration, or the past of each flight."""
    if args.model:
        return keep.load(args.model)[0]
    card = card_of(args.airframe)
    return learn(args.against, card) if args.against else OwnPast(args.against_own_past, card)


def _page(reports: list[Report], against: Against, folder: Path) -> None:
    """Write figures and pages; with a common simulation, also a model file corrected by the named effects."""
    from twin_worker.diagnosis.output.figures import stems
    from twin_worker.diagnosis.output.page import write

    folder.mkdir(exist_ok=True)
    for report, stem in zip(reports, stems([report.flight for report in reports]), strict=True):
        if report.outcome is Outcome.NAMED and isinstance(against, Baseline):
            keep.save(folder / f"{stem}.model.json", against, report.findings)
    say(f"wrote {write(reports, folder)}")


def main(argv: list[str] | None = None) -> int:
    """Diagnose the recordings named on the command line."""
    parser = parser_for("python -m twin_worker.diagnosis", "Diagnose flights against a simulation.", EXAMPLES)
    arguments(parser)
    return guarded("diagnose", _run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
