"""Do proposals come in time, and does the event not happen when the simulator flies them?

    python -m tests.bench.proposals --pairs 4 --triples 2 --ground 2 --geofence 2 --clear 2 --seed 900 --json FILE

Aircraft are simulated by JSBSim. In `pairs` and `triples` the second and third aircraft meet the first; in `ground` it
sinks below 30 m above home, in `terrain` a hill rises to 10 m below its route, in `geofence` it leaves its circle, in
`leg` a waypoint is 220 m above the one before, in `clear` two pass each other at a distance. Options are computed as by
a worker (CPU time) while an alert is active. The first option of each proposal against an event that happens without it
is approved 2 to 16 s after it was offered (drawn), as it is then, three in a flight at most, and flown 2 s later.
`happened`: the event or a loss of separation, up to 200 s; `cleared`: the alert, by the twins; `created`: alerts of
what does not happen without the changes;
`unneeded`: options against such.
"""

import argparse
import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from twin_worker.service.warm_up import warm_up

from .flights import KINDS, Result, judged

IN_TIME_S = 2.0
ARGUMENTS = {
    "pair": "--pairs",
    "triple": "--triples",
    "ground": "--ground",
    "geofence": "--geofence",
    "clear": "--clear",
    "leg": "--legs",
    "terrain": "--terrain",
    "area": "--areas",
}


def summary(rows: list[Result]) -> dict[str, Any]:
    """Count the outcomes of one kind of case."""
    answered = [one for one in rows if one.approvals]
    firsts = [one.approvals[0] for one in answered]
    approvals = [approval for one in rows for approval in one.approvals]
    took = [one.took_s for one in approvals]
    return {
        "cases": len(rows),
        "alerts": sum(one.alert_s is not None for one in rows),
        "offered": len(firsts),
        "offered_in_2_s": sum(one.waited_s <= IN_TIME_S for one in firsts),
        "with_models": sum(one.with_models for one in firsts),
        "waited_s_median": round(float(np.median([one.waited_s for one in firsts])), 2) if firsts else None,
        "waited_s_max": round(max(one.waited_s for one in firsts), 2) if firsts else None,
        "computed_s_median": round(float(np.median(took)), 2) if took else None,
        "computed_s_max": round(max(took), 2) if took else None,
        "flown": sum(bool(one.flown) for one in approvals),
        "any_offered_in_2_s": sum(one.waited_s <= IN_TIME_S for one in approvals),
        "cleared": sum(all(approval.cleared for approval in one.approvals) for one in answered),
        "without_event": sum(not one.happened for one in answered),
        "created": sum(bool(one.created) for one in answered),
        "with_unneeded": sum(bool(one.unneeded) for one in rows),
    }


def main() -> None:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m tests.bench.proposals", description=__doc__, formatter_class=form)
    for kind in KINDS:
        parser.add_argument(ARGUMENTS[kind], type=int, default=0, metavar="N", help=f"cases of {kind} (0)")
    parser.add_argument("--seed", type=int, default=900, help="seed of the first case of each kind (900)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every case with its outcome")
    args = parser.parse_args()
    warm_up()
    results: list[Result] = []
    wanted = {kind: getattr(args, ARGUMENTS[kind][2:]) for kind in KINDS}
    for kind, k in sorted(((name, k) for name in KINDS for k in range(wanted[name])), key=lambda one: one[1]):
        began = time.monotonic()
        one = judged(kind, args.seed + k)
        results.append(one)
        print(f"{kind} {args.seed + k}: alert at {one.alert_s} s, {time.monotonic() - began:.0f} s of computing")
        for approval in one.approvals:
            model = "with" if approval.with_models else "without"
            print(f"  {approval.waited_s:.1f} s after {approval.alert_s:.0f} s, {model} model: {approval.sentences}")
            print(f"    flown {approval.flown!r}, cleared {approval.cleared}, before: {approval.reasons}")
        print(f"  happened {one.happened}, created {one.created}, unneeded {one.unneeded} {one.reasons}", flush=True)
        figures = {
            "seed": args.seed,
            "summary": {name: summary([o for o in results if o.name == name]) for name in KINDS},
            "cases": [asdict(one) for one in results],
        }
        if args.json:
            args.json.write_text(json.dumps(figures, indent=1) + "\n")
    print(json.dumps({name: summary([o for o in results if o.name == name]) for name in KINDS}, indent=1))


if __name__ == "__main__":
    main()
