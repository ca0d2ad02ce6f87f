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

from fleet.cli import guarded, parser_for
from fleet.process.logs import tell
from twin_worker.paper_experiments.experiment import FIRST, NAMES, Experiment, Plan, experiments
from twin_worker.paper_experiments.figures import draw
from twin_worker.paper_experiments.recorded_flights import Flown, flown
from twin_worker.telemetry.flight_phase import MODES

_SAY_EVERY = 20  # experiments between two progress messages

EXAMPLES = """
  python -m twin_worker.paper_experiments identify flight.tlog
  python -m twin_worker.paper_experiments identify --first pbsid --out figures --json paper.json flight.tlog
"""


def summary(done: list[Experiment]) -> dict[str, dict[str, Any]]:
    """Summarise each mode: count, median of the mean fit over states, paired gain, quartiles per state, verdicts.

    `p` is the one-sided signed-rank p-value of the gain; it is too small, because adjacent experiments share data.
    """
    rows = {}
    for mode in MODES:
        its = [one for one in done if one.mode == mode]
        if its:
            rows[mode] = _row(its, [one.fit_seen for one in done if one.mode_seen == mode])
    return rows


def _row(its: list[Experiment], seen: list[np.ndarray]) -> dict[str, Any]:
    fit = np.array([one.fit for one in its])
    gain = np.diff(fit.mean(axis=2), axis=1)[:, 0]
    verdicts = Counter(str(one.outcome) for one in its)
    usual = verdicts.most_common(1)[0][0]
    return {
        "n": len(its),
        "fit": _steps(np.median(fit.mean(axis=2), axis=0)),
        "fit_seen": _steps(np.median(np.mean(seen, axis=2), axis=0)) if seen else None,
        "paired_gain": round(float(np.median(gain)), 1),
        "share_better": round(float((gain > 0).mean()), 3),
        "p": float(scipy.stats.wilcoxon(gain, alternative="greater").pvalue) if gain.any() else 1.0,
        "states": {name: _steps(np.percentile(fit[:, :, k], (25, 50, 75), axis=0).T) for k, name in enumerate(NAMES)},
        "verdicts": dict(verdicts),
        "sentence": next(one.sentence for one in its if str(one.outcome) == usual),
    }


def _steps(pair: np.ndarray) -> dict[str, Any]:
    """Return the values of both steps by name."""
    return dict(zip(("first", "refined"), np.round(pair, 1).tolist(), strict=True))


def text(first: str, rows: dict[str, dict[str, Any]]) -> str:
    """Format the summary as text."""
    lines = [f"first step: {first}; fit over unseen seconds, median [%]"]
    for mode, row in rows.items():
        step = row["fit"]
        lines.append(
            f"  {mode:8} n {row['n']:4}   first {step['first']:6.1f}   refined {step['refined']:6.1f}   "
            f"paired {row['paired_gain']:+5.1f}, better in {row['share_better']:.0%} (p {row['p']:.1g})"
        )
        if seen := row["fit_seen"]:
            lines.append(
                f"           over identification data: first {seen['first']:.1f}, refined {seen['refined']:.1f}"
            )
        told = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in sorted(row["verdicts"].items()))
        lines.append(f"           {told}; e.g. {row['sentence']}")
    return "\n".join(lines)


def _run(args: argparse.Namespace) -> int:
    flights: list[Flown] = []
    for path in args.files:
        tell("paper", f"reading {path.name}")
        flights += flown(path)
    if not flights:
        raise ValueError("paper: found no flight with attitude, velocity, position and servo rows; use another FILE")
    plan = Plan(args.seen, args.unseen, args.every)
    total = sum(len(list(flight.starts(plan.seen_s, plan.unseen_s, plan.every_s))) for flight in flights)
    if not total:
        raise ValueError(f"paper: found no {plan.seen_s + plan.unseen_s:.0f} s of data without gaps; record longer")
    result: dict[str, Any] = {"plan": asdict(plan), "first_step": {}}
    for first in FIRST if args.first == "both" else (args.first,):
        done = _carried_out(experiments(flights, first, plan), total, first)
        result["first_step"][first] = rows = summary(done)
        print(text(first, rows), flush=True)
        if args.out:
            print(f"  figures: {', '.join(path.name for path in draw(args.out, first, done, NAMES))} in {args.out}")
    if args.json:
        args.json.write_text(json.dumps(result, indent=1) + "\n")
    return 0


def _carried_out(tried: Iterable[Experiment | str], total: int, first: str) -> list[Experiment]:
    """Collect experiments and log progress; log each reason for failed experiments once, with its count."""
    done: list[Experiment] = []
    refused: Counter[str] = Counter()
    for k, one in enumerate(tried):
        if isinstance(one, str):
            refused[one] += 1
        else:
            done.append(one)
        if (k + 1) % _SAY_EVERY == 0:
            tell("paper", f"{first}, {k + 1} of {total} experiments")
    for sentence, count in refused.items():
        tell("paper", f"{count} experiments failed, {sentence}")
    return done


def main(argv: list[str] | None = None) -> int:
    """Run the experiment on the recordings named on the command line."""
    about = "Run the identification experiment of the paper on recorded flights."
    parser = parser_for("python -m twin_worker.paper_experiments", about, EXAMPLES)
    parser.add_argument("experiment", choices=("identify",), help="identify: figures 7 and 8 of the paper")
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="recording, e.g. flight.tlog.xz")
    parser.add_argument(
        "--first", choices=(*FIRST, "both"), default="both", help="first step: projection (paper), PBSID, or both"
    )
    for name, text_ in (
        ("seen", "identification window"),
        ("unseen", "free run"),
        ("every", "interval of experiments"),
    ):
        default = getattr(Plan(), f"{name}_s")
        parser.add_argument(f"--{name}", type=_seconds, default=default, metavar="S", help=f"{text_} ({default:.0f} s)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="draw the figures into DIR")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers to FILE")
    return guarded("twin_worker.paper_experiments", _run, parser.parse_args(argv))


def _seconds(words: str) -> float:
    """Parse a duration of 5 s or more; shorter free runs are never verified.

    Raises:
        ArgumentTypeError: if the value is out of range.
        ValueError: if it is no number.
    """
    value = float(words)
    if not 5 <= value <= 600:
        raise argparse.ArgumentTypeError(f"found {words}, expected 5..600 s; write e.g. 40")
    return value


if __name__ == "__main__":
    sys.exit(main())
