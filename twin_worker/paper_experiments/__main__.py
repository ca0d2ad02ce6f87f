"""`python -m twin_worker.paper_experiments identify FILE…`: the paper's identification experiment on recorded flights.

In every flight mode (climb, level, turn, descent) of the unseen seconds, up to `--each` experiments spread over all
flights: the two linear models (4 longitudinal, 5 lateral states) are identified on the preceding window, by a first
step and by its prediction-error refinement, and the coupled model of the twin beside them. All then run free over the
unseen seconds, and over the end of the identification data.

Source: Huang 2021, section 4.2, figures 7 and 8.
"""

import argparse
import functools
import json
import sys
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats

from fleet.cli import make_parser, run_command
from fleet.process.logs import report_progress
from fleet.telemetry.recording.options import RecordingOptions, add_recording_arguments
from twin_worker.paper_experiments.experiment import (
    FIRST_STEPS,
    MODELS,
    SEEN_RUN_S,
    STATE_NAMES,
    Experiment,
    ExperimentPlan,
    RecordedFlight,
    choose_starts,
    read_flights,
    run_experiments,
)
from twin_worker.paper_experiments.figures import draw
from twin_worker.telemetry.flight_phase import PHASES

_PROGRESS_EVERY = 20  # experiments between two progress messages

EXAMPLES = """
  python -m twin_worker.paper_experiments identify flight.tlog
  python -m twin_worker.paper_experiments identify --first pbsid --out figures --json paper.json flight.tlog
"""


def summary(results: list[Experiment]) -> dict[str, dict[str, Any]]:
    """Summarise each mode: count, medians of the mean fit over states, quartiles per state, gain, verdicts.

    `unseen` and `seen` are of the unseen seconds and of the end of the identification data. The gain is that of the
    refined model over the first step, paired. `p` is its one-sided signed-rank p-value; it is too small, because
    adjacent experiments share data.
    """
    table = {}
    for mode in PHASES:
        if group := [result for result in results if result.mode == mode]:
            table[mode] = _row(group, [result for result in results if result.mode_seen == mode])
    return table


def _row(group: list[Experiment], seen_group: list[Experiment]) -> dict[str, Any]:
    fit = np.array([result.fit for result in group])
    gain = np.diff(fit.mean(axis=2), axis=1)[:, 0]
    verdicts = Counter(str(result.outcome) for result in group)
    common_verdict = verdicts.most_common(1)[0][0]
    return {
        "n": len(group),
        "flights": len({result.uav for result in group}),
        "unseen": _fits(fit),
        "seen": _fits(np.array([result.fit_seen for result in seen_group])) if seen_group else None,
        "paired_gain": round(float(np.median(gain)), 1),
        "share_better": round(float((gain > 0).mean()), 3),
        "p": float(scipy.stats.wilcoxon(gain, alternative="greater").pvalue) if gain.any() else 1.0,
        "verdicts": dict(verdicts),
        "sentence": next(result.sentence for result in group if str(result.outcome) == common_verdict),
    }


def _fits(fit: np.ndarray) -> dict[str, Any]:
    """Return count, median of the mean over states, and quartiles per state of every model: fit (N, 3, 9) [%]."""
    quartiles = np.percentile(fit, (25, 50, 75), axis=0)
    return {
        "n": len(fit),
        "mean": dict(zip(MODELS, np.round(np.median(fit.mean(axis=2), axis=0), 1).tolist(), strict=True)),
        "states": {
            name: dict(zip(MODELS, np.round(quartiles[:, :, k].T, 1).tolist(), strict=True))
            for k, name in enumerate(STATE_NAMES)
        },
    }


def format_summary(first: str, table: dict[str, dict[str, Any]], plan: ExperimentPlan, air: str) -> str:
    """Format the summary as text."""
    lines = [
        f"first step: {first}; {air}; identified on {plan.seen_s:.0f} s, free run over {plan.unseen_s:.0f} s unseen "
        f"and over the last {SEEN_RUN_S:.0f} s of the identification data",
        f"  fit, median [%]                 mean  {' '.join(f'{name:>5}' for name in STATE_NAMES)}",
    ]
    for mode, row in table.items():
        for part in ("unseen", "seen"):
            for model in MODELS if row[part] else ():
                states = " ".join(f"{row[part]['states'][name][model][1]:5.0f}" for name in STATE_NAMES)
                label = f"{mode:8}n {row[part]['n']:4} {part:6} {model:8}"
                lines.append(f"  {label} {row[part]['mean'][model]:5.0f}  {states}")
        verdict_text = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in sorted(row["verdicts"].items()))
        lines.append(
            f"    {row['flights']} flights; refined better than first in {row['share_better']:.0%}, "
            f"paired {row['paired_gain']:+.0f} (p {row['p']:.1g})"
        )
        lines.append(f"    {verdict_text}; e.g. {row['sentence']}")
    return "\n".join(lines)


def _run(args: argparse.Namespace) -> int:
    if args.each < 1:
        raise ValueError(f"--each: found {args.each}, expected 1 or more; write e.g. 100")
    flights: list[RecordedFlight] = []
    for path in args.files:
        report_progress("paper", f"reading {path.name}")
        flights += read_flights(path, options=RecordingOptions.of(args))
    if not flights:
        raise ValueError("paper: found no flight with attitude, velocity, position and servo rows; use another FILE")
    plan = ExperimentPlan(args.seen, args.unseen, args.every, args.each)
    starts = choose_starts(flights, plan)
    if not starts:
        raise ValueError(f"paper: found no {plan.seen_s + plan.unseen_s:.0f} s of data without gaps; record longer")
    result: dict[str, Any] = {"plan": asdict(plan), "air": args.air, "first_step": {}}
    for first in FIRST_STEPS if args.first == "both" else (args.first,):
        results = _collect(run_experiments(starts, first, plan), len(starts), first)
        result["first_step"][first] = table = summary(results)
        print(format_summary(first, table, plan, args.air), flush=True)
        if args.out:
            figures = draw(args.out, first, results, f"{args.air}, identified on {plan.seen_s:.0f} s")
            print(f"  figures: {', '.join(path.name for path in figures)} in {args.out}")
    if args.json:
        args.json.write_text(json.dumps(result, indent=1) + "\n")
    return 0


def _collect(outcomes: Iterable[Experiment | str], total: int, first: str) -> list[Experiment]:
    """Collect experiments and log progress; log each reason for failed experiments once, with its count."""
    results: list[Experiment] = []
    refused: Counter[str] = Counter()
    for k, outcome in enumerate(outcomes):
        if isinstance(outcome, str):
            refused[outcome] += 1
        else:
            results.append(outcome)
        if (k + 1) % _PROGRESS_EVERY == 0:
            report_progress("paper", f"{first}, {k + 1} of {total} experiments")
    for reason, count in refused.items():
        report_progress("paper", f"{count} experiments failed, {reason}")
    return results


def main(argv: list[str] | None = None) -> int:
    """Run the experiment on the recordings named on the command line."""
    description = "Run the identification experiment of the paper on recorded flights."
    parser = make_parser("python -m twin_worker.paper_experiments", description, EXAMPLES)
    parser.add_argument("experiment", choices=("identify",), help="identify: figures 7 and 8 of the paper")
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="recording, e.g. flight.tlog.xz")
    parser.add_argument(
        "--first", choices=(*FIRST_STEPS, "both"), default="both", help="first step: projection (paper), PBSID, or both"
    )
    plan = ExperimentPlan()
    for name, least, text in (
        ("seen", 20, "identification window"),
        ("unseen", 4, "free run"),
        ("every", 1, "interval of possible starts"),
    ):
        default = getattr(plan, f"{name}_s")
        kind = functools.partial(_seconds, least)
        parser.add_argument(f"--{name}", type=kind, default=default, metavar="S", help=f"{text} ({default:.0f} s)")
    parser.add_argument("--each", type=int, default=plan.each, metavar="N", help=f"most of one mode ({plan.each})")
    parser.add_argument("--air", default="as recorded", metavar="TEXT", help="description of the air, for the figures")
    parser.add_argument("--out", type=Path, metavar="DIR", help="draw the figures into DIR")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers to FILE")
    add_recording_arguments(parser)
    return run_command("twin_worker.paper_experiments", _run, parser.parse_args(argv))


def _seconds(least: float, argument: str) -> float:
    """Parse a duration.

    Raises:
        ArgumentTypeError: if the value is out of range.
        ValueError: if it is no number.
    """
    value = float(argument)
    if not least <= value <= 600:
        raise argparse.ArgumentTypeError(f"found {argument}, expected {least:.0f}..600 s; write e.g. 40")
    return value


if __name__ == "__main__":
    sys.exit(main())
