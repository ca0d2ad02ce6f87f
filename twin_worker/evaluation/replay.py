"""`python -m twin_worker.evaluation.replay FILE…`: replay recordings through the twins, offline.

Per UAV: vehicle, predictions by method, time of the first verified model, the share of predictions within 10 %
(relative error M1) up to 10, 30, 60 and 120 s (predictions that an event ends are censored), and the last sentences.
"""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fleet.cli import guarded, parser_for
from fleet.contract import Message, Model, Outcome, Prediction
from fleet.process.logs import tell
from fleet.telemetry.recording.recordings import replay_messages
from twin_worker.alerts.traffic import Traffic
from twin_worker.confidence.weighted_quantile import survival
from twin_worker.evaluation.offline import run
from twin_worker.twin.step import Twin

WITHIN_S = (10, 30, 60, 120)
_SAY_EVERY_S = 60.0  # recorded time between two lines of progress [s]

EXAMPLES = """
  python -m twin_worker.evaluation.replay flight.tlog
  python -m twin_worker.evaluation.replay --json result.json --offset -1 a.tlog.xz b.tlog
"""


@dataclass
class Tally:
    """Summary of one UAV over a recording."""

    methods: Counter[str] = field(default_factory=Counter)
    verified_s: float | None = None  # since its first message
    verdict: str = ""
    sentence: str = ""
    passages: dict[str, list[tuple[float, bool]]] = field(default_factory=dict)  # by method: time to 10 % [s], censored
    seen: dict[str, int] = field(default_factory=dict)  # predictions scored so far, by method


def replay(messages: Iterable[Message], progress: str = "") -> dict[str, dict[str, Any]]:
    """Run messages through the twins; return each UAV's row by its id.

    Args:
        messages: Sample, Status, Mission, Params in the order they were received
        progress: name under which progress is reported on stderr; empty: no progress
    """
    twins: dict[int, Twin] = {}
    traffic = Traffic()
    tallies: dict[int, Tally] = {}
    begun: dict[int, float] = {}
    said = 0.0
    for message in messages:
        start = begun.setdefault(message.uav, message.t)
        if progress and message.t - start >= said + _SAY_EVERY_S:
            said = message.t - start
            tell(progress, f"{said:.0f} s of flight, {len(begun)} UAVs")
        tally = tallies.setdefault(message.uav, Tally())
        for result in run((message,), twins, traffic):
            _take(tally, result, start)
        _collect(tally, twins[message.uav])
    for uav, twin in twins.items():
        twin.record.forget()  # the recording is over: open predictions are censored
        _collect(tallies[uav], twin)
    return {str(uav): _row(twins[uav], tallies[uav], begun[uav]) for uav in sorted(twins)}


def _take(tally: Tally, result: Message, start: float) -> None:
    if isinstance(result, Prediction):
        tally.methods[result.method] += 1
        tally.sentence = result.sentence
    elif isinstance(result, Model):
        tally.verdict = result.verdict.sentence
        if result.verdict.outcome is Outcome.VERIFIED and tally.verified_s is None:
            tally.verified_s = result.t - start


def _collect(tally: Tally, twin: Twin) -> None:
    """Collect every scored passage: the tracker stores only the latest."""
    for method, n in twin.record.scored.items():
        new = n - tally.seen.get(method, 0)
        if new:
            latest = list(twin.record.passages[method])[-new:]
            tally.passages.setdefault(method, []).extend(latest)
            tally.seen[method] = n


def _row(twin: Twin, tally: Tally, start: float) -> dict[str, Any]:
    return {
        "vehicle": twin.vehicle,
        "seconds": round(float(max(twin.history.newest - start, 0.0)), 1),
        "methods": dict(tally.methods),
        "first_verified_s": None if tally.verified_s is None else round(tally.verified_s, 1),
        "scored": {method: len(found) for method, found in tally.passages.items()},
        "within_10_percent": {
            method: {str(s): round(survival(found, s), 3) for s in WITHIN_S} for method, found in tally.passages.items()
        },
        "verdict": twin.verdict.sentence or tally.verdict,
        "prediction": tally.sentence,
    }


def text(uav: str, row: dict[str, Any]) -> str:
    """Format one UAV's row as lines of text."""
    methods = ", ".join(f"{n} {method}" for method, n in row["methods"].items()) or "none"
    verified = "never" if row["first_verified_s"] is None else f"after {row['first_verified_s']:.0f} s"
    lines = [f"uav-{uav}: {row['vehicle']}, {row['seconds']:.0f} s; predictions: {methods}; verified {verified}"]
    for method, shares in row["within_10_percent"].items():
        known = ", ".join(f"{share:.0%} at {s} s" for s, share in shares.items())
        lines.append(f"  {method}: within 10 %: {known} (of {row['scored'][method]} scored)")
    lines += [f"  {name}: {row[name]}" for name in ("verdict", "prediction") if row[name]]
    return "\n".join(lines)


def _run(args: argparse.Namespace) -> int:
    found = {}
    for path in args.files:
        rows = replay(replay_messages(path, args.offset), path.name)
        found[str(path)] = rows
        print(f"{path.name}: {len(rows)} UAVs")
        for uav, row in rows.items():
            print(text(uav, row), flush=True)
    if args.json:
        args.json.write_text(json.dumps(found, indent=2) + "\n")
    return 0


def main(argv: list[str] | None = None) -> int:
    """Run the command line: replay recordings through the twins."""
    parser = parser_for(
        "python -m twin_worker.evaluation.replay", "Run recordings through the twins offline.", EXAMPLES
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="recording, e.g. flight.tlog.xz")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the same rows to FILE")
    parser.add_argument("--offset", type=int, default=0, help="UAV id = MAVLink system id + offset (0)")
    return guarded("twin_worker.evaluation.replay", _run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
