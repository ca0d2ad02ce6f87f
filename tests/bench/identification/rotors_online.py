"""Rotor models that the twin identifies in flight, against RotorPy's parameters and against persistence.

    python -m tests.bench.identification.rotors_online --flights 12 --seed 43001 --json rotors_online.json
    python -m tests.bench.identification.rotors_online --recordings flight.tlog

Each simulated aircraft, two airframes in winds of 0.5 to 6 m/s, sends telemetry at the usual rates, without a frame
lost. The twin identifies every 20 s, as in the worker. Thrust and drag of the last active model are compared at its
mean motor input and airspeed; free runs of 10 s over held-out flight predict velocity and attitude from motor outputs
and commanded attitude.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fleet.contract import Message, Model, Outcome
from fleet.process.logs import report_progress
from fleet.simulator.flight.drive import to_tlog
from fleet.simulator.multirotor.tuning import motor_inputs as simulated_inputs
from fleet.simulator.multirotor.uav import SimulatedMultirotor
from fleet.telemetry.recording.recordings import replay_messages
from twin_worker.identification.multirotor.rotor_model import RotorModel
from twin_worker.twin.state.state import Twin, ingest
from twin_worker.twin.steps.rotor_step import PERIOD_S, identify_rotors

SECONDS = 360.0
LONG_S = 10.0
AIRCRAFT = (("quad", "ardupilot"), ("quad_large", "ardupilot"), ("quad", "px4"), ("quad_large", "px4"))
WINDS = (0.5, 1.5, 3.0, 4.5, 6.0)


def verdicts(messages: Iterable[Message]) -> Iterator[tuple[Twin, float, Model]]:
    """Identify with the telemetry of each aircraft as it arrives; yield twin, time in flight [s] and model."""
    twins: dict[int, Twin] = {}
    begin: dict[int, float] = {}
    for message in messages:
        twin = twins.setdefault(message.uav, Twin.of(message.uav))
        ingest(twin, message)
        newest = twin.telemetry.history.newest
        if not np.isfinite(newest) or not twin.vehicle_class.is_rotorcraft:
            continue
        begin.setdefault(message.uav, newest)
        if twin.models.rotors.timer.due(newest, PERIOD_S):
            for model in identify_rotors(twin):
                assert isinstance(model, Model)
                yield twin, newest - begin[message.uav], model


def errors(model: RotorModel, uav: SimulatedMultirotor) -> dict[str, float]:
    """Return the relative errors of thrust and drag at the motor input and airspeed of the model."""
    kind, motors = uav.vehicle.kind, uav.vehicle.motors
    low, high = uav.params.get("MOT_SPIN_MIN", 0.0), uav.params.get("MOT_SPIN_MAX", 1.0)
    pulse = 1000.0 + 1000.0 * (low + (high - low) * model.hover)
    u = float(simulated_inputs((pulse,) * 4, uav.params)[0])  # type: ignore[arg-type]
    w = kind.top_speed * np.sqrt((1 - kind.expo) * u + kind.expo * u**2)
    thrust = kind.k_eta * w**2 * (motors**2).sum() / kind.mass
    drag = (kind.k_d * w * motors.sum() + kind.drag[0] * model.speed) / kind.mass
    return {"thrust": model.thrust / float(thrust) - 1, "drag": model.drag / float(drag) - 1}


def summary(name: str, found: list[tuple[Twin, float, Model]]) -> dict[str, Any]:
    """Return when models were accepted and verified, and the fits over `LONG_S` of all verdicts."""
    row: dict[str, Any] = {"flight": name, "verdicts": len(found)}
    of = [(t, m) for _, t, m in found]
    row["accepted_s"] = next((t for t, m in of if m.active_verdict is not None), None)
    row["verified_s"] = next(
        (t for t, m in of if m.active_verdict and m.active_verdict.outcome is Outcome.VERIFIED), None
    )
    later = [m for t, m in of if row["verified_s"] is not None and t >= row["verified_s"]]
    held = [m for m in later if m.active_verdict is not None and m.active_verdict.outcome is Outcome.VERIFIED]
    row["verified_share"] = len(held) / len(later) if later else 0.0
    fits: dict[str, list[float]] = {}
    for _, model in of:
        for part, value in model.verdict.fit_by_length.items():
            if part.endswith(f"{LONG_S:.0f}"):
                fits.setdefault(part, []).append(value)
        if model.verdict.horizon_s == LONG_S:
            for part, value in model.verdict.fit_persistence.items():
                fits.setdefault(f"persistence_{part}", []).append(value)
    row["fits"] = {part: [round(x, 1) for x in values] for part, values in fits.items()}
    return row


def measure(number: int, seed: int, folder: Path) -> dict[str, Any]:
    """Fly one simulated aircraft and identify it."""
    aircraft, autopilot = AIRCRAFT[number % len(AIRCRAFT)]
    uav = SimulatedMultirotor(0, seed + number, wind=WINDS[number % len(WINDS)], autopilot=autopilot, aircraft=aircraft)
    path = folder / f"{aircraft}_{number}.tlog"
    to_tlog(path, [uav], seconds=SECONDS, loss=0.0, seed=seed)
    found = list(verdicts(replay_messages(path)))
    row = summary(path.stem, found) | {"autopilot": autopilot}
    active = found[-1][0].models.rotors.active if found else None
    return row | (errors(active, uav) if active is not None else {"thrust": float("nan"), "drag": float("nan")})


def show(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Print the rows and return their medians."""
    for row in rows:
        fits = {part: float(np.median(x)) for part, x in row["fits"].items()}
        print(
            f"{row['flight']}: accepted {row['accepted_s'] and round(row['accepted_s'])} s, verified "
            f"{row['verified_s'] and round(row['verified_s'])} s, then {row['verified_share']:.0%} of verdicts; "
            + " ".join(f"{name} {100 * row[name]:+.1f} %" for name in ("thrust", "drag") if name in row)
            + f"; {' '.join(f'{part} {x:.0f}' for part, x in fits.items())} %"
        )
    total: dict[str, Any] = {"flights": len(rows)}
    for name in ("thrust", "drag"):
        values = np.abs([row[name] for row in rows if name in row])
        if len(values):
            total[name] = {"median": float(np.median(values)), "within_5_percent": int((values < 0.05).sum())}
    for part in sorted({part for row in rows for part in row["fits"]}):
        each = [float(np.median(row["fits"][part])) for row in rows if part in row["fits"]]
        total[part] = {"median": float(np.median(each)), "least": min(each), "at_least_70": sum(x >= 70 for x in each)}
    total["verified"] = sum(row["verified_s"] is not None for row in rows)
    print(json.dumps(total, indent=1))
    return total


def main() -> int:
    """Measure and print."""
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m tests.bench.identification.rotors_online", description=__doc__)
    parser.formatter_class = form
    parser.add_argument("--flights", type=int, default=12, help="simulated flights (12)")
    parser.add_argument("--seed", type=int, default=1, help="of the first flight (1)")
    parser.add_argument("--recordings", nargs="+", type=Path, metavar="FILE", help="recordings instead of simulations")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE")
    args = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for k in range(args.flights if args.recordings is None else 0):
            rows.append(measure(k, args.seed, Path(folder)))
            report_progress("bench.rotors_online", f"flight {k + 1} of {args.flights}")
        rows += [summary(path.name, list(verdicts(replay_messages(path)))) for path in args.recordings or ()]
    total = show(rows)
    if args.json:
        args.json.write_text(json.dumps({"rows": rows, "total": total}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
