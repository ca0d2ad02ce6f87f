"""Black-box identification on DaISy: first half for estimation, second for validation, ours against the peers.

    python -m tests.bench.daisy --json daisy.json
    python -m tests.bench.daisy --sets dryer flutter --methods ours nfoursid

Score: mean over outputs of 100 (1 - ||y - y_hat|| / ||y - mean(y)||) of one free run over the second half. Data are
centred and scaled by the first half. The state at the start of the second half is estimated for every model in one way:
least squares over its first tenth (at least 30 samples), the weakest echo breaking ties. A peer's order (1..10; with
sippy also whether there is a D) is the one whose model of the first two thirds of that half runs best over the last
third of it; that order is then identified on all of it. Ours is
`tests.bench.order_selection` as it is, with orders 1..10 and feedthrough allowed: the median run
of its committee.
"""

import argparse
import functools
import json
import os
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tests.bench.black_box import estimate_x0
from tests.bench.daisy_peers import Peer, peers, quietly
from tests.bench.order_selection import select_order
from twin_worker.identification.linear.state_space import StateSpace

# name: columns to skip, inputs, outputs
SETS = {
    "CD_player_arm": (0, 2, 2),
    "dryer": (0, 1, 1),
    "flutter": (0, 1, 1),
    "winding": (0, 5, 2),
    "heating_system": (1, 1, 1),
    "glassfurnace": (1, 3, 6),
    "robot_arm": (0, 1, 1),
    "exchanger": (1, 1, 1),
}
ORDERS = range(1, 11)
_JAX_ORDERS = (1, 2, 4, 6, 8)  # it takes its time
_LEAST = 30  # samples for the state at the start


class Halves(NamedTuple):
    """Outputs and inputs, scaled by the first half: to learn from, to be judged by."""

    y: np.ndarray
    u: np.ndarray
    y_new: np.ndarray
    u_new: np.ndarray


Committee = tuple[StateSpace, ...]  # its run is the median of the runs of its members; a peer has one
Method = Callable[[np.ndarray, np.ndarray], Committee]


def halves(folder: Path, name: str) -> Halves:
    skip, m, l = SETS[name]
    data = np.loadtxt(folder / f"{name}.dat")[:, skip:]
    middle = len(data) // 2
    data = (data - data[:middle].mean(axis=0)) / data[:middle].std(axis=0)
    u, y = data[:, :m], data[:, m : m + l]
    return Halves(y[:middle], u[:middle], y[middle:], u[middle:])


def free_run_fit(models: Committee, y: np.ndarray, u: np.ndarray) -> float:
    """Run models freely over data they have not seen, (N, l) and (N, m) [%]."""
    first = max(_LEAST, len(y) // 10)
    y_hat = np.median([model.run(u, estimate_x0(model, y[:first], u[:first], len(y))) for model in models], axis=0)
    miss = np.linalg.norm(y - y_hat, axis=0) / np.linalg.norm(y - y.mean(axis=0), axis=0)
    return float(np.mean(100 * (1 - miss)))


def ours(y: np.ndarray, u: np.ndarray) -> Committee:
    return select_order(y, u, orders=ORDERS, feedthrough=True).ensemble


def peer(variants: tuple[Peer, ...], orders: Iterable[int], y: np.ndarray, u: np.ndarray) -> Committee:
    """Let a peer choose its order on a split of the data, and identify on all of them."""
    cut = 2 * len(y) // 3
    trials = [(_try(variant, order, y, u, cut), variant, order) for variant in variants for order in orders]
    for _, variant, order in sorted(trials, key=lambda trial: trial[0], reverse=True):
        try:
            with quietly():
                found = variant(y, u, order)
            return (StateSpace.of(found.A, found.B, found.C, D=found.D),)
        except (ValueError, ArithmeticError, np.linalg.LinAlgError):
            continue  # the next best
    raise ValueError("no order gave a model")


def _try(variant: Peer, order: int, y: np.ndarray, u: np.ndarray, cut: int) -> float:
    try:
        with quietly():
            found = variant(y[:cut], u[:cut], order)
            score = free_run_fit((StateSpace.of(found.A, found.B, found.C, D=found.D),), y[cut:], u[cut:])
        return score if np.isfinite(score) else -np.inf
    except (ValueError, ArithmeticError, IndexError, np.linalg.LinAlgError):
        return -np.inf


def methods() -> dict[str, Method]:
    """Name ours and every peer that is installed."""
    found: dict[str, Method] = {"ours": ours}
    for name, variants in peers().items():
        found[name] = functools.partial(peer, variants, _JAX_ORDERS if name == "jax-sysid" else ORDERS)
    return found


def daisy(chosen: dict[str, Method], sets: Iterable[str] = SETS, folder: Path | None = None) -> dict:
    """Give {set: {method: fit}}; a method that fails on a set gets none there.

    Args:
        chosen: some of `methods()`
        sets: names from `SETS`
        folder: of the .dat files; not given: `daisy` among the recordings
    """
    folder = folder or Path(os.environ.get("PARAUAV_RECORDINGS") or "../shared/recordings") / "daisy"
    rows: dict[str, dict[str, float | None]] = {}
    for name in sets:
        data = halves(folder, name)
        rows[name] = {}
        for method, identify in chosen.items():
            began = time.perf_counter()
            try:
                fit = free_run_fit(identify(data.y, data.u), data.y_new, data.u_new)
                rows[name][method] = round(fit, 2) if np.isfinite(fit) else None
            except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
                rows[name][method] = None
                print(f"{name}, {method}: {error}", file=sys.stderr)
            took = time.perf_counter() - began
            print(f"{name:15} {method:14} {rows[name][method]} ({took:.1f} s)", file=sys.stderr, flush=True)
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="+", choices=SETS, default=list(SETS))
    parser.add_argument("--methods", nargs="+", metavar="NAME", help="default: ours and every peer installed")
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    known = methods()
    chosen = {name: known[name] for name in args.methods or known}
    result = {"daisy": daisy(chosen, args.sets)}
    print(json.dumps(result, indent=1))
    if args.json:
        args.json.write_text(json.dumps(result, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
