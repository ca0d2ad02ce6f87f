"""`python -m twin_worker.diagnosis FLIGHT…`: the process behind `fleet diagnose`."""

import argparse
import sys
from pathlib import Path

from fleet.cli import make_parser, run_command
from fleet.commands.offline.diagnose import EXAMPLES, arguments, check_arguments
from fleet.telemetry.recording.options import RecordingOptions
from twin_worker.diagnosis.baseline.own_past import OwnPast, check
from twin_worker.diagnosis.inference.report import Report, ReportOutcome
from twin_worker.diagnosis.learn import calibrate_recordings, card_or_unknown, log_progress
from twin_worker.diagnosis.model.baseline import CHANNELS, Baseline
from twin_worker.diagnosis.multirotor.recordings import calibrate_multirotor, holds_rotorcraft
from twin_worker.diagnosis.output import keep
from twin_worker.diagnosis.share import RecordingTask, Reference, diagnose_all


def _run(args: argparse.Namespace) -> int:
    check_arguments(args)
    args.conceal = tuple(filter(None, args.conceal.split(",")))
    check(args.conceal)
    if args.model:
        reference: Reference = keep.load(args.model)[0]
    else:  # a calibration, or the past of each flight
        card = card_or_unknown(args.airframe)
        options = RecordingOptions.of(args)
        past = args.against_own_past
        if not args.against:
            reference = OwnPast(past, card)
        elif holds_rotorcraft(args.against[0], options):
            reference = calibrate_multirotor(args.against, log_progress, options=options)
        else:
            reference = calibrate_recordings(args.against, card, options=options)
    reports: list[Report] = []
    refused: list[tuple[str, str]] = []
    tasks = [RecordingTask(path, RecordingOptions.of(args)) for path in args.file]
    results = diagnose_all(tasks, reference, args.jobs, log_progress, args.conceal)
    for task, (file_reports, refusal) in zip(tasks, results, strict=True):
        for report in file_reports:
            print(f"{report.flight}: {report.sentence}", flush=True)
            if report.outcome is ReportOutcome.NONE and report.detection_limits:
                print(f"{report.flight}: {'; '.join(report.detection_limits)}", flush=True)
        reports += file_reports
        if refusal:
            refused.append((task.path.name.split(".")[0], refusal))
            log_progress(refusal)
    if args.json:
        keep.write(reports, args.json, refused)
    if args.report:
        _page(reports, reference, args.report)
    return 2 if refused and not reports else 1 if refused else 0


def _page(reports: list[Report], reference: Reference, folder: Path) -> None:
    """Write figures and pages; with a common simulation, also a model file corrected by the named effects."""
    from twin_worker.diagnosis.output.figures import stems
    from twin_worker.diagnosis.output.page import write

    folder.mkdir(parents=True, exist_ok=True)
    rotors = [report for report in reports if not set(CHANNELS) <= report.ratio_before.keys()]
    if rotors:
        log_progress(f"found {len(rotors)} reports of multirotors, which have no figures; use --json")
    reports = [report for report in reports if report not in rotors]
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
