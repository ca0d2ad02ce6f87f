"""`python -m twin_worker.diagnosis FLIGHT…`: the process behind `fleet diagnose`."""

import argparse
import sys
from pathlib import Path

from fleet.cli import make_parser, run_command
from fleet.commands.offline.diagnose import EXAMPLES, arguments, check_arguments
from twin_worker.diagnosis.baseline.own_past import OwnPast, check
from twin_worker.diagnosis.inference.report import Report, ReportOutcome
from twin_worker.diagnosis.learn import calibrate_recordings, card_or_unknown, log_progress
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.diagnosis.output import keep
from twin_worker.diagnosis.share import Reference, diagnose_all


def _run(args: argparse.Namespace) -> int:
    check_arguments(args)
    args.conceal = tuple(filter(None, args.conceal.split(",")))
    check(args.conceal)
    if args.model:
        reference: Reference = keep.load(args.model)[0]
    else:  # a calibration, or the past of each flight
        card = card_or_unknown(args.airframe)
        reference = calibrate_recordings(args.against, card) if args.against else OwnPast(args.against_own_past, card)
    reports: list[Report] = []
    n_refused = 0
    for file_reports, refusal in diagnose_all(args.file, reference, args.jobs, log_progress, args.conceal):
        for report in file_reports:
            print(f"{report.flight}: {report.sentence}", flush=True)
        reports += file_reports
        if refusal:
            n_refused += 1
            log_progress(refusal)
    if args.json:
        keep.write(reports, args.json)
    if args.report:
        _page(reports, reference, args.report)
    return 2 if n_refused and not reports else 1 if n_refused else 0


def _page(reports: list[Report], reference: Reference, folder: Path) -> None:
    """Write figures and pages; with a common simulation, also a model file corrected by the named effects."""
    from twin_worker.diagnosis.output.figures import stems
    from twin_worker.diagnosis.output.page import write

    folder.mkdir(exist_ok=True)
    for report, stem in zip(reports, stems([report.flight for report in reports]), strict=True):
        if report.outcome is ReportOutcome.NAMED and isinstance(reference, Baseline):
            keep.save(folder / f"{stem}.model.json", reference, report.findings)
    log_progress(f"wrote {write(reports, folder)}")


def main(argv: list[str] | None = None) -> int:
    """Diagnose the recordings named on the command line."""
    parser = make_parser("python -m twin_worker.diagnosis", "Diagnose flights against a simulation.", EXAMPLES)
    arguments(parser)
    return run_command("diagnose", _run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
