"""`python -m twin_worker.evaluation.replay FILE…`: replay recordings through the twins, offline.

Per UAV: vehicle, predictions by method, time of the first plausible or verified model, share of predictions within 10 %
(relative error M1) up to 10, 30, 60 and 120 s (predictions that an event ends are censored), and the last sentences.
"""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fleet.cli import make_parser, run_command
from fleet.contract import Message, Model, Prediction
from fleet.process.logs import report_progress
from fleet.telemetry.recording.options import RecordingOptions, add_recording_arguments
from fleet.telemetry.recording.recordings import replay_messages
from twin_worker.alerts.traffic import TrafficMonitor
from twin_worker.confidence.weighted_quantile import survival
from twin_worker.twin.step import Twin, advance


def run_offline(
    messages: Iterable[Message], twins: dict[int, Twin], traffic: TrafficMonitor | None = None
) -> Iterator[Message]:
    """Drive twins with recorded messages; every new UAV gets a twin.

    Args:
        messages: Sample, Status, Mission, Params in the order they were received
        twins: twins by UAV id, filled and changed in place
        traffic: conflict assessment of all pairs, changed in place; None: a new one
    Yields:
        Model, Prediction and Alert messages
    """
    traffic = traffic or TrafficMonitor()
    for message in messages:
        twin = twins.get(message.uav)
        if twin is None:
            twin = twins[message.uav] = Twin.of(message.uav)
        results = advance(twin, (message,))
        yield from traffic.process_results(twin.config.uav, twin.telemetry.last_step_t, results)


WITHIN_S = (10, 30, 60, 120)
_REPORT_EVERY_S = 60.0  # recorded time between two lines of progress [s]

EXAMPLES = """
  python -m twin_worker.evaluation.replay flight.tlog
  python -m twin_worker.evaluation.replay --json result.json --offset -1 a.tlog.xz b.tlog
"""


@dataclass
class ReplaySummary:
    """Summary of one UAV over a recording."""

    first_t: float  # of its messages [s since 1970]
    methods: Counter[str] = field(default_factory=Counter)
    verified_s: float | None = None  # since its first message
    verdict: str = ""
    sentence: str = ""
    passages: dict[str, list[tuple[float, bool]]] = field(default_factory=dict)  # by method: time to 10 % [s], censored
    scored: dict[str, int] = field(default_factory=dict)  # predictions scored so far, by method


def replay(messages: Iterable[Message], progress: str = "") -> dict[str, dict[str, Any]]:
    """Run messages through the twins; return each UAV's row by its id.

    Args:
        messages: Sample, Status, Mission, Params in the order they were received
        progress: name under which progress is reported on stderr; empty: no progress
    """
    twins: dict[int, Twin] = {}
    traffic = TrafficMonitor()
    summaries: dict[int, ReplaySummary] = {}
    reported_s = 0.0
    for message in messages:
        uav_summary = summaries.setdefault(message.uav, ReplaySummary(message.t))
        start = uav_summary.first_t
        if progress and message.t - start >= reported_s + _REPORT_EVERY_S:
            reported_s = message.t - start
            report_progress(progress, f"{reported_s:.0f} s of flight, {len(summaries)} UAVs")
        for result in run_offline((message,), twins, traffic):
            if isinstance(result, Prediction):
                uav_summary.methods[result.method] += 1
                uav_summary.sentence = result.sentence
            elif isinstance(result, Model):
                uav_summary.verdict = result.verdict.sentence
                if result.verdict.outcome.is_accepted and uav_summary.verified_s is None:
                    uav_summary.verified_s = result.t - start
        _collect_passages(uav_summary, twins[message.uav])
    for uav, twin in twins.items():
        twin.confidence.tracker.censor_open()  # the recording is over: open predictions are censored
        _collect_passages(summaries[uav], twin)
    return {str(uav): _row(twins[uav], summaries[uav]) for uav in sorted(twins)}


def _collect_passages(summary: ReplaySummary, twin: Twin) -> None:
    """Collect every scored passage: the tracker stores only the latest."""
    for method, n in twin.confidence.tracker.scored.items():
        new_count = n - summary.scored.get(method, 0)
        if new_count:
            latest = list(twin.confidence.tracker.passages[method])[-new_count:]
            summary.passages.setdefault(method, []).extend(latest)
            summary.scored[method] = n


def _row(twin: Twin, summary: ReplaySummary) -> dict[str, Any]:
    return {
        "vehicle": twin.vehicle,
        "seconds": round(float(max(twin.telemetry.history.newest - summary.first_t, 0.0)), 1),
        "methods": dict(summary.methods),
        "first_verified_s": None if summary.verified_s is None else round(summary.verified_s, 1),
        "scored": {method: len(passages) for method, passages in summary.passages.items()},
        "within_10_percent": {
            method: {str(s): round(survival(passages, s), 3) for s in WITHIN_S}
            for method, passages in summary.passages.items()
        },
        "verdict": twin.identification.verdict.sentence or summary.verdict,
        "prediction": summary.sentence,
    }


def format_row(uav: str, row: dict[str, Any]) -> str:
    """Format one UAV's row as lines of text."""
    methods = ", ".join(f"{n} {method}" for method, n in row["methods"].items()) or "none"
    verified = "never" if row["first_verified_s"] is None else f"after {row['first_verified_s']:.0f} s"
    lines = [f"uav-{uav}: {row['vehicle']}, {row['seconds']:.0f} s; predictions: {methods}; verified {verified}"]
    for method, shares in row["within_10_percent"].items():
        shares_text = ", ".join(f"{share:.0%} at {s} s" for s, share in shares.items())
        lines.append(f"  {method}: within 10 %: {shares_text} (of {row['scored'][method]} scored)")
    lines += [f"  {name}: {row[name]}" for name in ("verdict", "prediction") if row[name]]
    return "\n".join(lines)


def _run(args: argparse.Namespace) -> int:
    rows_by_file = {}
    options = RecordingOptions.of(args)
    for path in args.files:
        rows = replay(replay_messages(path, args.offset, options=options), path.name)
        rows_by_file[str(path)] = rows
        print(f"{path.name}: {len(rows)} UAVs")
        for uav, row in rows.items():
            print(format_row(uav, row), flush=True)
    if args.json:
        args.json.write_text(json.dumps(rows_by_file, indent=2) + "\n")
    return 0


def main(argv: list[str] | None = None) -> int:
    """Run the command line: replay recordings through the twins."""
    parser = make_parser(
        "python -m twin_worker.evaluation.replay", "Run recordings through the twins offline.", EXAMPLES
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="recording, e.g. flight.tlog.xz")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the same rows to FILE")
    parser.add_argument("--offset", type=int, default=0, help="UAV id = MAVLink system id + offset (0)")
    add_recording_arguments(parser)
    return run_command("twin_worker.evaluation.replay", _run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
