"""How soon is a fault concealed in a flying aircraft found, and what is that worth to its predictions?

    python -m tests.bench.mismatch --seeds 1-5 --json mismatch.json
    python -m tests.bench.mismatch --seeds 1-10 --healthy --own-past

Ordinary flights of pretend aircraft (JSBSim), a fault from 120 s on, heard by the offline twins. When the first effect
is put into the models the twin is copied: the copy does not adapt, and hears the same telemetry from then on. Errors
are of predictions made in the minute after that, against the position reported 10, 30 and 60 s later. A diagnosis
answers 3 s after it began, and the next begins 12 s after it at the earliest, as a fifth of a core allows.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from fleet.cli import id_range
from fleet.contract import Found, Mismatch

from .flown import Errors, Flown, hear
from .world import FAULTS, ONSET_S, baseline, messages

SECONDS, HEALTHY_S = 280, 300


def judged(fault: str, flown: Flown) -> dict[str, Any]:
    """Judge one flight: when it was flagged and named, as what, and the errors with and without what was named."""
    told = [m for m in flown.adapting if isinstance(m, Mismatch)]
    since = flown.begin + ONSET_S
    flagged = next((m.t - since for m in told if m.outcome is not Found.NONE), None)
    named = next((m for m in told if m.outcome is Found.NAMED), None)
    adapted = next((m for m in told if m.adapted), None)
    name, _, of = fault.split(",")[0].partition(":")
    row: dict[str, Any] = {"fault": fault, "flagged_s": flagged, "named_s": named and named.t - since}
    if named is not None:
        first = named.causes[0]
        right = (first.name, first.surface) == (name, of)
        row["verdict"] = "right" if right else "in class" if name in first.rivals else "wrong"
        row["named"] = [(one.name, one.surface, one.rivals, one.parameters) for one in named.causes]
        row["onset_error_s"] = first.segments[0][0] - since
    if adapted is not None:
        row["adapted_s"] = adapted.t - since
        both = {"with": flown.adapting, "without": flown.plain}
        row |= {which: Errors.of(said, flown.truth, adapted.t) for which, said in both.items()}
    return row


def alarms(flown: Flown) -> dict[str, Any]:
    """List what was said of a healthy flight."""
    told = [m for m in flown.adapting if isinstance(m, Mismatch)]
    said = [(round(m.t - flown.begin), m.outcome.value, [one.name for one in m.causes]) for m in told]
    return {"looks": len(told), "said": [one for one in said if one[1] != "none"]}


def main() -> int:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=id_range, default=range(1, 6))
    parser.add_argument("--faults", nargs="+", default=FAULTS)
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
                heard = messages(fault, seed, HEALTHY_S if args.healthy else SECONDS, Path(folder))
                flown = hear(heard, base)
                row = {"seed": seed} | (judged(fault, flown) if fault else alarms(flown))
                rows.append(row | {"diagnosis_s": flown.cpu_s, "wall_s": time.monotonic() - begun})
                print(json.dumps(rows[-1], default=lambda x: np.asarray(x).tolist()), flush=True)
                if args.json:
                    args.json.write_text(json.dumps(rows, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
