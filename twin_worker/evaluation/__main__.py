"""`python -m twin_worker.evaluation FILE…`: the process that `fleet assess` starts."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from rich.console import Console

from fleet.cli import guarded, parser_for
from fleet.commands.offline.assess import EXAMPLES, arguments, check, chosen
from fleet.process.logs import tell
from twin_worker.evaluation.drive import Plan
from twin_worker.evaluation.scoring.case import Case
from twin_worker.evaluation.scoring.summary import summary
from twin_worker.evaluation.share import Found, assess
from twin_worker.evaluation.table import table

_WIDE = 150  # columns of the table where the output is not a terminal


def _say(line: str) -> None:
    tell("assess", line)


def _run(args: argparse.Namespace) -> int:
    check(args)
    _say("compiling the twin's physics, once")
    from twin_worker.service.warm_up import warm_up  # numba is slow to import: report first

    warm_up()
    plan = Plan(args.every, args.method, chosen(args.methods), args.without_params)
    found = assess(args.file, plan, jobs=args.jobs, offset=args.offset, say=_say)
    told = summary(found.cases) | {"run": _about(args, plan, found)}
    console = Console()
    console.width = console.width if console.is_terminal else _WIDE
    console.print(table(told))
    for sentence in found.sentences:
        _say(sentence)
    if args.json:
        args.json.write_text(json.dumps(told, indent=1) + "\n")
    if args.out:
        _draw(args.out, found.cases)
    return 0 if any(not case.apart for case in found.cases) else 1


def _about(args: argparse.Namespace, plan: Plan, found: Found) -> dict[str, Any]:
    return {
        "files": [str(path) for path in args.file],
        "every_s": plan.every_s,
        "method": args.method,
        "methods": list(plan.methods),
        "without_params": plan.without_params,
        "counted": sum(not case.apart for case in found.cases),
        "apart": sum(bool(case.apart) for case in found.cases),
        "silent": found.silent,
    }


def _draw(folder: Path, cases: list[Case]) -> None:
    from twin_worker.evaluation.figures import draw
    from twin_worker.evaluation.keep import keep

    folder.mkdir(parents=True, exist_ok=True)
    counted = [case for case in cases if not case.apart]
    made = draw(folder, counted)
    for name, its in (("predictions", counted), ("predictions_apart", [case for case in cases if case.apart])):
        if its:
            keep(folder / f"{name}.npz", its)
            made.append(folder / f"{name}.npz")
    _say(f"wrote {', '.join(path.name for path in made) or 'nothing: every start is excluded'} in {folder}")


def main(argv: list[str] | None = None) -> int:
    """Assess the recordings named on the command line."""
    parser = parser_for("python -m twin_worker.evaluation", "Score the twins' predictions on recordings.", EXAMPLES)
    arguments(parser)
    return guarded("assess", _run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
