"""`python -m twin_worker.evaluation FILE…`: the process that `fleet assess` starts."""

import argparse
import json
import sys
from pathlib import Path

from rich.console import Console

from fleet.cli import make_parser, run_command
from fleet.commands.offline.assess import EXAMPLES, arguments, baseline_methods, check_arguments
from fleet.process.logs import report_progress
from fleet.telemetry.recording.options import RecordingOptions
from twin_worker.evaluation.drive import EvaluationPlan
from twin_worker.evaluation.scoring.log import EvaluationCase
from twin_worker.evaluation.scoring.summary import short_flights, summarise
from twin_worker.evaluation.share import assess_recordings
from twin_worker.evaluation.table import table

_PLAIN_WIDTH = 150  # columns of the table where the output is not a terminal


def _report(line: str) -> None:
    report_progress("assess", line)


def _run(args: argparse.Namespace) -> int:
    check_arguments(args)
    _report("compiling the twin's physics, once")
    from twin_worker.service.warm_up import warm_up  # numba is slow to import: report first

    warm_up()
    options = RecordingOptions.of(args)
    plan = EvaluationPlan(args.every, args.method, baseline_methods(args.methods), args.without_params, options)
    try:
        evaluation = assess_recordings(args.file, plan, jobs=args.jobs, offset=args.offset, report=_report)
    except ValueError as error:
        if args.json:
            args.json.write_text(json.dumps({"run": {"refused": [str(error)], "counted": 0}}, indent=1) + "\n")
        raise
    run = {
        "files": [str(path) for path in args.file],
        "every_s": plan.every_s,
        "method": args.method,
        "methods": list(plan.methods),
        "without_params": plan.without_params,
        "counted": sum(not case.exclusion for case in evaluation.cases),
        "apart": sum(bool(case.exclusion) for case in evaluation.cases),
        "silent": evaluation.missed,
        "short": short_flights(evaluation.cases),
        "sentences": evaluation.sentences,
        "refused": evaluation.refused,
    }
    results = summarise(evaluation.cases) | {"run": run}
    console = Console()
    console.width = console.width if console.is_terminal else _PLAIN_WIDTH
    console.print(table(results))
    for sentence in (*evaluation.sentences, *evaluation.refused):
        _report(sentence)
    if args.json:
        args.json.write_text(json.dumps(results, indent=1) + "\n")
    if args.out:
        _write_outputs(args.out, evaluation.cases)
    return 0 if any(not case.exclusion for case in evaluation.cases) else 1


def _write_outputs(folder: Path, cases: list[EvaluationCase]) -> None:
    from twin_worker.evaluation.figures import draw
    from twin_worker.evaluation.table import write_predictions

    folder.mkdir(parents=True, exist_ok=True)
    counted, excluded = ([case for case in cases if bool(case.exclusion) is apart] for apart in (False, True))
    written = draw(folder, counted)
    for name, selected in (("predictions", counted), ("predictions_apart", excluded)):
        if selected:
            write_predictions(folder / f"{name}.npz", selected)
            written.append(folder / f"{name}.npz")
    _report(f"wrote {', '.join(path.name for path in written) or 'nothing: every start is excluded'} in {folder}")


def main(argv: list[str] | None = None) -> int:
    """Assess the recordings named on the command line."""
    parser = make_parser("python -m twin_worker.evaluation", "Score the twins' predictions on recordings.", EXAMPLES)
    arguments(parser)
    return run_command("assess", _run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
