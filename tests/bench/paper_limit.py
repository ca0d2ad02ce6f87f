"""The best possible fit in the paper's identification experiment: the true states under the same sensor errors.

    python -m tests.bench.paper_limit --uavs 16 --seconds 300 --json limit.json

Flies the aircraft of `fleet paper identify` and keeps their true states. In calm air these are what the true airframe
flies from its true state under the recorded inputs (in wind, with the true gusts as well). Like the free runs of the
models they start at an estimate: the mean error of the second before, which is the sensors' drift, is added. What is
missing to 100 % is sensor noise and its drift within the seconds scored. Windows as in the command.

"without gusts" is the true airframe from its true state in the mean wind of these seconds, under the inputs with which
the autopilot answered the gusts: what a perfect model reaches that does not know them, and the share of it verified.
"""

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np

from fleet.contract import Outcome
from fleet.frames import ned_to_body
from fleet.simulator.flight.drive import DELAY_S, EPOCH_US, to_tlog
from fleet.simulator.flight.uav import SimulatedUav
from fleet.simulator.vehicle.jsbsim import Truth
from fleet.simulator.vehicle.missions import paper_mission
from fleet.simulator.vehicle.sensors import servo_commands
from fleet.simulator.vehicle.weather import FT
from fleet.window import STATES
from twin_worker.paper_experiments.experiment import START_S, STATE_NAMES, ExperimentPlan, choose_starts, read_flights
from twin_worker.telemetry.flight_phase import PHASES, phase_of
from twin_worker.validation.verify import fit_percent, verify_free_run

from .identification.flight import Flight
from .identification.pretended import Replay

ORDER = [STATES.index(name) for name in STATE_NAMES]
DT, MEASUREMENTS_PER_ROW = 0.04, 2  # of a replay [s], and its rows among those observed
SPAN = 2.9  # [m]
JITTER_S = 0.01  # of the mean transport delay beyond the least, found by correlation of the pitch rate [s]


def observed(uav: SimulatedUav) -> list[tuple[float, ...]]:
    """Record at each measurement: time [s], true states, air-relative, p, v, mean wind, servo commands, (22,)."""
    rows: list[tuple[float, ...]] = []
    measure = uav._sensors.measure

    def record(truth: Truth):
        air = truth.Va * np.array(
            [np.cos(truth.alpha) * np.cos(truth.beta), np.sin(truth.beta), np.sin(truth.alpha) * np.cos(truth.beta)]
        )
        wind = [uav.aircraft[f"atmosphere/wind-{way}-fps"] * FT for way in ("north", "east")]
        commands = servo_commands(uav.pulses)
        rows.append((uav.tick * 0.01, *air, *truth.rates, *truth.euler, *truth.p, *truth.v, *wind, *commands))
        return measure(truth)

    uav._sensors.measure = record  # type: ignore[method-assign]
    return rows


def replay(own: int, true: np.ndarray) -> Replay:
    """Return the true airframe of one flight: own is its seed, true its observed rows, equally spaced, (n, 22)."""
    t, states, rest = true[:, 0], true[:, 1:10], true[:, 10:]
    n, euler = len(t), states[:, 6:9]
    p, v, wind, u = np.split(rest, [3, 6, 8], axis=1)
    series = {"p": p, "v": v, "euler": euler, "rates": states[:, 3:6], "wind": wind}
    x = np.hstack([ned_to_body(*euler.T, v), states[:, 3:]])
    return Replay(own, series, Flight("paper", 0, DT, t, x, u, np.full(n, np.nan), np.ones(n, bool), SPAN))


def without_gusts(airframe: Replay, at: int, n: int) -> np.ndarray:
    """Fly rows at .. at + n in the mean wind, air-relative states, (n, 9)."""
    wind = airframe.mean_wind(at, n)
    run = airframe.fly(at, n, wind)
    run[:, :3] -= ned_to_body(*run[:, 6:9].T, np.tile([*wind, 0.0], (n, 1)))
    return run


def limits(
    path: Path, truths: dict[int, np.ndarray], airframes: dict[int, Replay], plan: ExperimentPlan
) -> dict[str, list[tuple[np.ndarray, np.ndarray, bool]]]:
    """Return by mode the fits, (9,) [%], of the true states and of the airframe without gusts, and if it is verified.

    The mean error of the second before is added to both.
    """
    fits: dict[str, list[tuple[np.ndarray, np.ndarray, bool]]] = {mode: [] for mode in PHASES}
    flights = list(read_flights(path))
    for flight, start in choose_starts(flights, plan):
        window = flight.window(start, plan.seen_s, plan.unseen_s)
        true = truths[flight.uav]
        t = window.t - EPOCH_US * 1e-6 - DELAY_S - JITTER_S
        states = np.column_stack([np.interp(t, true[:, 0], column) for column in true[:, 1:10].T])
        turns = 2 * np.pi * np.round(np.median(window.x[:, 8] - states[:, 8]) / (2 * np.pi))
        states[:, 8] += turns
        n, before = round(plan.seen_s / window.dt), round(START_S / window.dt)
        offset = (window.x - states)[n - before : n].mean(axis=0)
        at = round((t[n] - true[0, 0]) / DT)
        run = without_gusts(airframes[flight.uav], at, len(window) - n) + offset
        run[:, 8] += turns
        mode = phase_of(window.part(n, len(window)))
        fit, gustless = (fit_percent(window.x[n:], y_hat)[ORDER] for y_hat in (states[n:] + offset, run))
        verified = verify_free_run(window.x[n:], run, window.part(0, n))[0] is Outcome.VERIFIED
        fits[mode].append((fit, gustless, verified))
    return fits


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--uavs", type=int, default=16)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--wind", type=float, default=0.0)
    parser.add_argument("--turbulence", type=int, default=0)
    parser.add_argument("--each", type=int, default=150, help="most of one mode")
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
        airframes = {k: replay(seeds[k - 1], part[::MEASUREMENTS_PER_ROW]) for k, part in truths.items()}
        fits = limits(path, truths, airframes, ExperimentPlan(each=args.each))
    table: dict[str, dict[str, float]] = {}
    for mode, group in fits.items():
        for name, rows in (("true states", [row[0] for row in group]), ("without gusts", [row[1] for row in group])):
            if not rows:
                continue
            fit = np.array(rows)
            states = dict(zip(STATE_NAMES, np.median(fit, axis=0).round(1).tolist(), strict=True))
            table[f"{mode}, {name}"] = {"n": len(fit), "mean": round(float(np.median(fit.mean(axis=1))), 1)} | states
        if group:
            share = float(np.mean([verified for _, _, verified in group]))
            table[f"{mode}, without gusts"]["verified"] = round(share, 3)
    for name, row in table.items():
        print(f"{name:24}", row)
    if args.json:
        args.json.write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
