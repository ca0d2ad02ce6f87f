"""Do proposals come in time, and does the event not happen when the simulator flies them?

    python -m tests.bench.proposals --pairs 4 --triples 2 --ground 2 --geofence 2 --clear 2 --seed 900 --json FILE

Aircraft are simulated by JSBSim. In `pairs` and `triples` the second and third aircraft meet the first; in `ground` it
sinks below 30 m above home, in `geofence` it leaves its circle, in `leg` a waypoint is 220 m above the one before,
in `clear` two pass each other at a distance. While the expected alert is active the options are computed as by a worker
(CPU time). Each option is flown by the simulator from 3 to 18 s after the proposal on (drawn): `without_event` is true
if neither the event nor a loss of separation happens up to 200 s. With the first option the twins follow the flight:
`cleared` is true if the alert was cleared, and new alerts are listed. Options against any other alert are unneeded.
"""

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from twin_worker.service.warm_up import warm_up

from .flights import KINDS, Outcome, judged

IN_TIME_S = 2.0
ARGUMENTS = {
    "pair": "--pairs",
    "triple": "--triples",
    "ground": "--ground",
    "geofence": "--geofence",
    "clear": "--clear",
    "leg": "--legs",
}


def summary(rows: list[Outcome]) -> dict[str, Any]:
    """Count the outcomes of one kind of case."""
    raised = [one for one in rows if one.alert_s is not None]
    offered = [one for one in raised if one.offered]
    took = [one.took_s for one in raised if one.took_s is not None]
    flown = [ok for one in offered for ok in one.without_event]
    return {
        "cases": len(rows),
        "alerts": len(raised),
        "offered": len(offered),
        "offered_in_2_s": sum(one.waited_s <= IN_TIME_S for one in offered),
        "computed_s_median": round(float(np.median(took)), 2) if took else None,
        "computed_s_max": round(max(took), 2) if took else None,
        "options": sum(one.offered for one in offered),
        "options_flown_without_event": sum(flown),
        "first_option_without_event": sum(one.without_event[0] for one in offered),
        "first_option_cleared_alert": sum(bool(one.cleared) for one in offered),
        "first_option_new_alerts": sum(bool(one.new_alerts) for one in offered),
        "offered_without_need": sum(one.unneeded for one in rows),
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
    outcomes: list[Outcome] = []
    for kind in KINDS:
        for k in range(getattr(args, ARGUMENTS[kind][2:])):
            outcomes.append(judged(kind, args.seed + k, lambda text: print(text, flush=True)))
            one = outcomes[-1]
            print(
                f"  without event {one.without_event}, cleared {one.cleared}, new {one.new_alerts}, took {one.took_s}",
                flush=True,
            )
            figures = {
                "seed": args.seed,
                "summary": {name: summary([o for o in outcomes if o.name == name]) for name in KINDS},
                "cases": [asdict(one) for one in outcomes],
            }
            if args.json:
                args.json.write_text(json.dumps(figures, indent=1) + "\n")
    print(json.dumps({name: summary([o for o in outcomes if o.name == name]) for name in KINDS}, indent=1))


if __name__ == "__main__":
    main()
