"""The best possible fit in the paper's identification experiment: the true states under the same sensor errors.

    python -m tests.bench.paper_limit --uavs 16 --seconds 300 --json limit.json

Flies the aircraft of `fleet paper identify` and keeps their true states. In calm air these are what the true airframe
flies from its true state under the recorded inputs (in wind, with the true gusts as well). Like the free runs of the
models they start at an estimate: the mean error of the second before, which is the sensors' drift, is added. What is
missing to 100 % is sensor noise and its drift within the seconds scored. Windows as in the command.
"""

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np

from fleet.simulator.flight.drive import DELAY_S, EPOCH_US, to_tlog
from fleet.simulator.flight.uav import SimulatedUav
from fleet.simulator.vehicle.jsbsim import Truth
from fleet.simulator.vehicle.missions import paper_mission
from fleet.window import STATES
from twin_worker.paper_experiments.experiment import START_S, STATE_NAMES, ExperimentPlan, choose_starts, read_flights
from twin_worker.telemetry.flight_phase import PHASES, phase_of
from twin_worker.validation.verify import fit_percent

ORDER = [STATES.index(name) for name in STATE_NAMES]
JITTER_S = 0.01  # of the mean transport delay beyond the least, found by correlation of the pitch rate [s]


def observed(uav: SimulatedUav) -> list[tuple[float, ...]]:
    """Record time [s] and true states, air-relative, whenever the aircraft measures."""
    rows: list[tuple[float, ...]] = []
    measure = uav._sensors.measure

    def record(truth: Truth):
        air = truth.Va * np.array(
            [np.cos(truth.alpha) * np.cos(truth.beta), np.sin(truth.beta), np.sin(truth.alpha) * np.cos(truth.beta)]
        )
        rows.append((uav.tick * 0.01, *air, *truth.rates, *truth.euler))
        return measure(truth)

    uav._sensors.measure = record  # type: ignore[method-assign]
    return rows


def limits(path: Path, truths: dict[int, np.ndarray], plan: ExperimentPlan) -> dict[str, list[np.ndarray]]:
    """Return the fits of the true states with the mean error of the second before, by mode, (9,) each [%]."""
    fits: dict[str, list[np.ndarray]] = {mode: [] for mode in PHASES}
    flights = list(read_flights(path))
    for flight, start in choose_starts(flights, plan):
        window = flight.window(start, plan.seen_s, plan.unseen_s)
        true = truths[flight.uav]
        t = window.t - EPOCH_US * 1e-6 - DELAY_S - JITTER_S
        states = np.column_stack([np.interp(t, true[:, 0], column) for column in true[:, 1:].T])
        states[:, 8] += 2 * np.pi * np.round(np.median(window.x[:, 8] - states[:, 8]) / (2 * np.pi))
        n, before = round(plan.seen_s / window.dt), round(START_S / window.dt)
        offset = (window.x - states)[n - before : n].mean(axis=0)
        mode = phase_of(window.part(n, len(window)))
        fits[mode].append(fit_percent(window.x[n:], states[n:] + offset)[ORDER])
    return fits


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--uavs", type=int, default=16)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--wind", type=float, default=0.0)
    parser.add_argument("--turbulence", type=int, default=0)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    seeds = [int(np.random.SeedSequence((args.seed, i)).generate_state(1)[0]) for i in range(args.uavs)]
    uavs = [
        SimulatedUav(i, args.seed, wind=args.wind, turbulence=args.turbulence, plan=paper_mission(seed))
        for i, seed in enumerate(seeds)
    ]
    rows = {uav.uav_id + 1: observed(uav) for uav in uavs}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flight.tlog"
        to_tlog(path, uavs, seconds=args.seconds, loss=0.01, seed=args.seed)
        truths = {uav: np.array(part) for uav, part in rows.items()}
        for part in truths.values():
            part[:, 9] = np.unwrap(part[:, 9])
        fits = limits(path, truths, ExperimentPlan())
    table = {}
    for mode, group in fits.items():
        if group:
            fit = np.array(group)
            states = dict(zip(STATE_NAMES, np.median(fit, axis=0).round(1).tolist(), strict=True))
            table[mode] = {"n": len(fit), "mean": round(float(np.median(fit.mean(axis=1))), 1), "states": states}
            print(f"{mode:8} n {len(fit):4} mean {table[mode]['mean']:5.0f}  {states}")
    if args.json:
        args.json.write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
