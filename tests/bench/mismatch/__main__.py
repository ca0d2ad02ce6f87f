"""How soon is a fault concealed in a flying aircraft found, and what is that worth to its predictions?

    python -m tests.bench.mismatch --seeds 1-5 --json mismatch.json
    python -m tests.bench.mismatch --faults thrust_loss,fraction=0.35 wind_steady,speed_mps=6,from_deg=200
    python -m tests.bench.mismatch --seeds 1-6 --healthy --own-past

Ordinary flights of pretend aircraft (JSBSim), a fault from 120 s on, heard by the offline twins. When it is first named
the twin is copied: the copy does not adapt, and hears the same telemetry from then on. Errors are distances of
predictions from the position reported 10, 30 and 60 s later: `before` of those made between the fault and its name,
`after` of those made in the minute that follows, `beside` of those the copy made in that minute. A diagnosis answers
3 s after it began, and the next begins 12 s after it at the earliest, as a fifth of a core allows.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

from fleet.cli import id_range
from fleet.contract import DiagnosisOutcome, Mismatch

from .flown import Flown, errors, hear
from .shown import line, summary
from .world import FAULT, ONSET_S, baseline, messages

SECONDS = 300
MINUTE_S = 60.0


def judged(fault: str, flown: Flown) -> dict[str, Any]:
    """Judge one flight: when it was flagged and named, as what, and the errors with and without what was named."""
    since = flown.begin + ONSET_S
    told = [m for m in flown.adapting if isinstance(m, Mismatch)]
    row = found(fault, told, since)
    row["before_the_fault"] = [one for one in alarms(flown)["said"] if one[0] <= ONSET_S]
    if row["named_s"] is None:
        return row
    named_t = since + row["named_s"]
    row["adapted"] = any(m.adapted for m in told if since < m.t <= named_t + MINUTE_S)
    spans = {"before": (flown.adapting, since, named_t), "after": (flown.adapting, named_t, named_t + MINUTE_S)}
    spans["beside"] = flown.plain, named_t, named_t + MINUTE_S
    row["error_m"] = {which: errors(said, flown.truth, *span) for which, (said, *span) in spans.items()}
    return row


def found(fault: str, told: list[Mismatch], since: float) -> dict[str, Any]:
    """Judge what was said of one aircraft: when its fault, from `since` on [s since 1970], was flagged and named."""
    told = [m for m in told if m.t > since]
    flagged = next((m.t - since for m in told if m.outcome is not DiagnosisOutcome.NONE), None)
    named = next((m for m in told if m.outcome is DiagnosisOutcome.NAMED), None)
    name, _, of = fault.split(",")[0].partition(":")
    row: dict[str, Any] = {"fault": fault, "flagged_s": flagged, "named_s": named and named.t - since}
    if named is None:
        return row
    first = named.causes[0]
    right = (first.name, first.surface) == (name, of)
    row["verdict"] = "right" if right else "in class" if name in first.confusable_with else "wrong"
    row["named"] = [(one.name, one.surface, one.confusable_with, one.parameters) for one in named.causes]
    row["onset_error_s"] = first.segments[0][0] - since
    return row


def alarms(flown: Flown) -> dict[str, Any]:
    """List what was said of a healthy flight."""
    told = [m for m in flown.adapting if isinstance(m, Mismatch)]
    said = [
        (round(m.t - flown.begin), m.outcome.value, m.sentence) for m in told if m.outcome is not DiagnosisOutcome.NONE
    ]
    return {"looks": len(told), "said": said}


def main() -> int:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=id_range, default=range(1, 6))
    parser.add_argument("--faults", nargs="+", default=[FAULT])
    parser.add_argument("--healthy", action="store_true", help="no faults: false alarms")
    parser.add_argument("--own-past", action="store_true", help="against each flight's own first 105 s")
    parser.add_argument("--models", type=Path, help="folder of models (made anew)")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for seed in args.seeds:
            base = None if args.own_past else baseline(seed, args.models or Path(folder))
            for fault in ("",) if args.healthy else args.faults:
                begun = time.monotonic()
                flown = hear(messages(fault, seed, SECONDS, Path(folder)), base)
                row = {"seed": seed} | (judged(fault, flown) if fault else alarms(flown))
                rows.append(row | {"diagnosis_s": flown.cpu_s, "wall_s": time.monotonic() - begun})
                print(line(row) if fault else row, flush=True)
    if not args.healthy:
        print(*summary(rows), sep="\n")
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
