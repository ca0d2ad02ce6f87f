"""What any model can reach in gusts: the simulator's own airframe on the windows of the identification bench.

    python -m tests.bench.gust_limit --seed 11 --windows 60 --json gusts.json

Small aircraft on JSBSim in wind with turbulence. Every window: identify on 40 s, run free over the next 40 s under the
recorded inputs. Beside the identified model flies the true airframe:

- true start: from the true state, in the mean wind of the seconds to come, without gusts
- same start: from the state and in the wind that the identified model starts with, without gusts
- other gusts: as the first, in gusts of the same statistics and other seeds, mean of the runs; this is the mean of what
  the true model with the true gust statistics predicts

The autopilot answered the gusts of the flight with the surfaces; a replay repeats the answers without the gusts.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from fleet.physics.simulate import TAU, lagged
from fleet.physics.wrench import WIND

from .identification import pretended
from .identification.flight import STATE_COLUMNS, Case
from .identification.ours import Ours, Seen
from .identification.plain import WindowMean
from .identification.score import fit_percent
from .identification.windows import Span, spans

WINDOW_S = 40.0
GUST_RUNS = 4  # runs in gusts of other seeds
METHODS = ("identified", "window mean", "true start", "same start", "other gusts", "one of them")
_LEAD = 250  # rows that settle the filter


def runs(case: Case, span: Span, seen: Seen, seed: int) -> dict[str, np.ndarray]:
    """Return the free run of every method over the rows span.at .. span.stop, (n, 9)."""
    flight, n = case.flight, span.stop - span.at
    known, u = flight.part(0, span.at), flight.u[span.at : span.stop]
    past = known.part(max(span.at - _LEAD, 0), span.at)
    start = seen.eye.filter(past.x, lagged(past.u, flight.dt, TAU))[-1, :9]
    replay = case.oracle
    assert isinstance(replay, pretended.Replay)
    wind = replay.mean_wind(span.at, n)
    gusty = [replay.fly(span.at, n, wind, gusts=1 + 1000 * seed + k) for k in range(GUST_RUNS)]
    return {
        "identified": seen.forecast(known, u),
        "window mean": WindowMean().identify(known, span.start).forecast(known, u),
        "true start": replay.forecast(span.at, n),
        "same start": replay.fly(span.at - 1, n + 1, seen.eye.model.par[WIND:], start)[1:],
        "other gusts": np.mean(gusty, axis=0),
        "one of them": gusty[0],
    }


def measure(cases: list[Case], most: int | None, seed: int) -> dict[str, np.ndarray]:
    """Return the fit per state of every method in every window, (windows, 9) [%]."""
    fits: dict[str, list[np.ndarray]] = {method: [] for method in METHODS}
    for case, laid in zip(cases, spans(cases, WINDOW_S, WINDOW_S, most), strict=True):
        ours, ok = Ours(), case.flight.ok
        for span in laid:
            seen = ours.identify(case.flight.part(0, span.at), span.start)
            rows = slice(span.at, span.stop)
            for method, run in runs(case, span, seen, seed).items():
                fits[method].append(fit_percent(case.flight.x[rows], run, ok[rows]))
        print(f"{case.flight.name}: {len(laid)} windows", file=sys.stderr, flush=True)
    return {method: np.array(group) for method, group in fits.items()}


def summary(fits: dict[str, np.ndarray]) -> dict[str, dict[str, float]]:
    """Return the median fit per axis of every method, and paired differences of the identified model to it [%]."""
    axes = {
        method: {axis: fit[:, columns].mean(axis=1) for axis, columns in STATE_COLUMNS.items()}
        for method, fit in fits.items()
    }
    table = {}
    for method, by_axis in axes.items():
        row: dict[str, float] = {"n": len(fits[method])}
        for axis, fit in by_axis.items():
            row[axis] = round(float(np.median(fit)), 1)
            row[f"identified - {axis}"] = round(float(np.median(axes["identified"][axis] - fit)), 1)
        table[method] = row
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--windows", type=int, metavar="N", help="at most so many windows (all)")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    fits = measure(pretended.cases(args.seed), args.windows, args.seed)
    table = summary(fits)
    for method, row in table.items():
        print(f"{method:12} " + "  ".join(f"{name} {value:g}" for name, value in row.items()))
    if args.json:
        args.json.write_text(json.dumps({"seed": args.seed, "fit": table}, indent=1) + "\n")


if __name__ == "__main__":
    main()
