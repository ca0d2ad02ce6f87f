"""`python -m twin_worker.paper_experiments identify FILE…`: the paper's identification experiment on recorded flights.

Every few seconds of flight, the two linear models (4 longitudinal, 5 lateral states) are identified on the preceding
window, by a first step and by its prediction-error refinement without prior. Both then run free over the following
unseen seconds. The flight mode of those seconds (climb, level, turn, descent) groups the results.

Source: Huang 2021, section 4.2, figures 7 and 8.
"""

import argparse
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
    STATE_NAMES,
    Experiment,
    ExperimentPlan,
    RecordedFlight,
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
    """Summarise each mode: count, median of the mean fit over states, paired gain, quartiles per state, verdicts.

    `p` is the one-sided signed-rank p-value of the gain; it is too small, because adjacent experiments share data.
    """
    table = {}
    for mode in PHASES:
        if mode_results := [result for result in results if result.mode == mode]:
            table[mode] = _row(mode_results, [result.fit_seen for result in results if result.mode_seen == mode])
    return table


def _row(mode_results: list[Experiment], seen_fits: list[np.ndarray]) -> dict[str, Any]:
    fit = np.array([result.fit for result in mode_results])
    gain = np.diff(fit.mean(axis=2), axis=1)[:, 0]
    verdicts = Counter(str(result.outcome) for result in mode_results)
    common_verdict = verdicts.most_common(1)[0][0]
    return {
        "n": len(mode_results),
        "fit": _steps(np.median(fit.mean(axis=2), axis=0)),
        "fit_seen": _steps(np.median(np.mean(seen_fits, axis=2), axis=0)) if seen_fits else None,
        "paired_gain": round(float(np.median(gain)), 1),
        "share_better": round(float((gain > 0).mean()), 3),
        "p": float(scipy.stats.wilcoxon(gain, alternative="greater").pvalue) if gain.any() else 1.0,
        "states": {
            name: _steps(np.percentile(fit[:, :, k], (25, 50, 75), axis=0).T) for k, name in enumerate(STATE_NAMES)
        },
        "verdicts": dict(verdicts),
        "sentence": next(result.sentence for result in mode_results if str(result.outcome) == common_verdict),
    }


def _steps(pair: np.ndarray) -> dict[str, Any]:
    """Return the values of both steps by name."""
    return dict(zip(("first", "refined"), np.round(pair, 1).tolist(), strict=True))


def format_summary(first: str, table: dict[str, dict[str, Any]]) -> str:
    """Format the summary as text."""
    lines = [f"first step: {first}; fit over unseen seconds, median [%]"]
    for mode, row in table.items():
        step = row["fit"]
        lines.append(
            f"  {mode:8} n {row['n']:4}   first {step['first']:6.1f}   refined {step['refined']:6.1f}   "
            f"paired {row['paired_gain']:+5.1f}, better in {row['share_better']:.0%} (p {row['p']:.1g})"
        )
        if seen := row["fit_seen"]:
            values = f"first {seen['first']:.1f}, refined {seen['refined']:.1f}"
            lines.append(f"           over identification data: {values}")
        verdict_text = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in sorted(row["verdicts"].items()))
        lines.append(f"           {verdict_text}; e.g. {row['sentence']}")
    return "\n".join(lines)


def _run(args: argparse.Namespace) -> int:
    flights: list[RecordedFlight] = []
    for path in args.files:
        report_progress("paper", f"reading {path.name}")
        flights += read_flights(path, options=RecordingOptions.of(args))
    if not flights:
        raise ValueError("paper: found no flight with attitude, velocity, position and servo rows; use another FILE")
    plan = ExperimentPlan(args.seen, args.unseen, args.every)
    total = sum(len(list(flight.starts(plan.seen_s, plan.unseen_s, plan.every_s))) for flight in flights)
    if not total:
        raise ValueError(f"paper: found no {plan.seen_s + plan.unseen_s:.0f} s of data without gaps; record longer")
    result: dict[str, Any] = {"plan": asdict(plan), "first_step": {}}
    for first in FIRST_STEPS if args.first == "both" else (args.first,):
        results = _collect(run_experiments(flights, first, plan), total, first)
        result["first_step"][first] = table = summary(results)
        print(format_summary(first, table), flush=True)
        if args.out:
            print(f"  figures: {', '.join(path.name for path in draw(args.out, first, results))} in {args.out}")
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
    durations = {"seen": "identification window", "unseen": "free run", "every": "interval of experiments"}
    for name, text in durations.items():
        default = getattr(ExperimentPlan(), f"{name}_s")
        parser.add_argument(f"--{name}", type=_seconds, default=default, metavar="S", help=f"{text} ({default:.0f} s)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="draw the figures into DIR")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers to FILE")
    add_recording_arguments(parser)
    return run_command("twin_worker.paper_experiments", _run, parser.parse_args(argv))


def _seconds(argument: str) -> float:
    """Parse a duration of 5 s or more; shorter free runs are never verified.

    Raises:
        ArgumentTypeError: if the value is out of range.
        ValueError: if it is no number.
    """
    value = float(argument)
    if not 5 <= value <= 600:
        raise argparse.ArgumentTypeError(f"found {argument}, expected 5..600 s; write e.g. 40")
    return value


if __name__ == "__main__":
    sys.exit(main())
