"""Rotor models identified from one part of a simulated flight, against RotorPy's parameters and the rest of the flight.

    python -m tests.bench.identification.rotors --flights 12 --seed 5101 --json rotors.json

Each aircraft is drawn anew. The first half of its flight identifies the model, with the wind of that half; the second
half is predicted from measured motor outputs alone over 1 and 10 s. Thrust is compared at hover, drag at airspeeds of
3 to 9 m/s with the rotors at hover.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from fleet.frames import G
from fleet.simulator.conceal.multirotor.exam import RotorJob, fly_rotor_flight
from fleet.simulator.conceal.multirotor.faults import AIRFRAMES, FaultyMultirotor
from fleet.simulator.multirotor.tuning import motor_pulses
from twin_worker.diagnosis.multirotor.baseline import RotorBaseline, calibrate_rotors
from twin_worker.diagnosis.multirotor.flight import DT, RotorFlight
from twin_worker.diagnosis.multirotor.linearise import LinearFlight, solve
from twin_worker.diagnosis.multirotor.model import CHANNELS, PARAMETERS, rotation, rotor_speeds
from twin_worker.diagnosis.multirotor.recordings import before, read_rotorcraft
from twin_worker.telemetry.motors import motor_inputs

SPEEDS = np.array([3.0, 6.0, 9.0])  # airspeeds of the comparison [m/s]
SHORT_S, LONG_S = 1.0, 10.0
ROWS = ("v_n", "v_e", "v_d", "phi", "theta", "psi")


def identified(flight: RotorFlight, split_s: float) -> tuple[RotorBaseline, np.ndarray]:
    """Return the model of the part before `split_s`, and its mean wind, north and east [m/s]."""
    part = before(flight, split_s)
    no_gains = ({}, {}, np.ones((2, len(CHANNELS))))  # effects are not searched
    model = calibrate_rotors([part], lambda _: None, lambda *_: no_gains)
    linear = LinearFlight(part, model.noise)
    found = solve(linear, model.parameters, None, linear.start(model.parameters), iterations=8)
    return model, found.fit.wind.mean(axis=0)


def coefficients(model: RotorBaseline, uav: FaultyMultirotor) -> dict[str, float]:
    """Return the relative errors of thrust at the motor outputs of hover, and of drag at each airspeed."""
    kind, motors = uav.healthy
    p = dict(zip(PARAMETERS, model.parameters.tolist(), strict=True))
    top = kind.k_eta * kind.top_speed**2 * float((motors**2).sum()) / kind.mass
    hover = np.sqrt(G / top)  # relative rotor speed
    pulse = motor_pulses(np.full(4, _input(hover, kind.expo)), True, uav.params)[0]
    command = float(motor_inputs(np.array(pulse, float), uav.params))
    own = p["k"] * 4 * ((1 - p["expo"]) * command + p["expo"] * command**2)
    total = hover * float(motors.sum())
    true = kind.k_d * kind.top_speed * total / kind.mass + kind.drag[0] * SPEEDS / kind.mass
    modelled = p["d"] * 4 * np.sqrt(own / (4 * p["k"])) + p["c"] * SPEEDS
    drag = modelled / true - 1
    return {"thrust": own / G - 1, **{f"drag_{v:.0f}": float(x) for v, x in zip(SPEEDS, drag, strict=True)}}


def _input(relative_speed: float, expo: float) -> float:
    """Return the motor input of a relative rotor speed."""
    return float((-(1 - expo) + np.sqrt((1 - expo) ** 2 + 4 * expo * relative_speed**2)) / (2 * expo))


def free_run(
    flight: RotorFlight, p: dict[str, float], wind: np.ndarray, starts: np.ndarray, seconds: float
) -> np.ndarray:
    """Predict velocities and attitude from measured states and motor outputs.

    Args:
        p: parameters as in `model.PARAMETERS`
        wind: north and east [m/s]
        starts: rows of the grid where runs begin, (s,)
    Returns:
        velocity NED [m/s] and phi theta psi [rad] at every row, (s, n, 6)
    """
    w = rotor_speeds(flight.inputs, p["tau"], p["expo"])
    mixer = flight.frame.mixer
    healthy = 1 + mixer @ np.array([p["m_p"], p["m_q"], p["m_r"]])
    T, w = w**2 * healthy, w * np.sqrt(np.clip(healthy, 0.0, None))
    spin = np.gradient(w @ mixer[:, 2], DT)
    V, attitude, rates = (x[starts] for x in (flight.velocity, flight.attitude, flight.rates))
    air_wind, out = np.array([*wind, 0.0]), []
    for k in range(round(seconds / DT)):
        row = starts + k
        R = rotation(attitude)
        out.append(np.concatenate([V, attitude], axis=1))
        u = np.einsum("nji,nj->ni", R, V - air_wind)
        total, thrust, moments, speed = w[row].sum(1), T[row].sum(1), T[row] @ mixer, np.linalg.norm(u, axis=1)
        f = -(p["d"] * total + p["c"] * speed)[:, None] * u
        f[:, 2] = -p["k"] * thrust - (p["k_c"] * total + p["c"] * speed) * u[:, 2] - p["k_h"] * (u[:, :2] ** 2).sum(1)
        r_p, r_q, r_r = rates.T
        turn = np.stack(
            [
                p["a_p"] * (moments[:, 0] + p["y_c"] * thrust) - p["j_p"] * r_q * r_r - p["d_p"] * r_p,
                p["a_q"] * (moments[:, 1] - p["x_c"] * thrust) + p["j_q"] * r_p * r_r - p["d_q"] * r_q,
                p["a_r"] * (moments[:, 2] + p["n_c"] * thrust) - p["d_r"] * r_r + p["spin"] * spin[row],
            ],
            axis=1,
        )
        V = V + DT * (np.einsum("nij,nj->ni", R, f) + np.array([0.0, 0.0, G]))
        rates = rates + DT * turn
        phi, theta, _ = attitude.T
        yawing = np.sin(phi) * rates[:, 1] + np.cos(phi) * rates[:, 2]
        euler = (rates[:, 0] + np.tan(theta) * yawing, np.cos(phi) * rates[:, 1] - np.sin(phi) * rates[:, 2])
        attitude = attitude + DT * np.stack([*euler, yawing / np.cos(theta)], axis=1)
    return np.stack(out, axis=1)


def fits(flight: RotorFlight, runs: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Return the fit of each state over all runs, 100 (1 - |y - y_run| / |y - mean y|), (6,) [%]."""
    rows = starts[:, None] + np.arange(runs.shape[1])
    true = np.concatenate([flight.velocity, flight.attitude], axis=1)[rows]
    error = np.sqrt(((runs - true) ** 2).sum(axis=(0, 1)))
    return np.asarray(100 * (1 - error / np.sqrt(((true - true.mean(axis=(0, 1))) ** 2).sum(axis=(0, 1)))))


def measure(number: int, seed: int, folder: Path) -> dict[str, Any] | None:
    """Fly one aircraft and compare; None if it left the envelope."""
    airframe = tuple(AIRFRAMES)[number % len(AIRFRAMES)]
    job = RotorJob(f"flight_{number}", airframe, "control", (), number)
    path = folder / f"{job.name}.tlog"
    flight_seed = int(np.random.SeedSequence((seed, number)).generate_state(1)[0])
    if fly_rotor_flight(job, seed + number, flight_seed, path, []) is None:
        return None
    uav = FaultyMultirotor(0, seed + number, aircraft=airframe, autopilot=AIRFRAMES[airframe], flight_seed=flight_seed)
    uav.attach(())
    flight = read_rotorcraft(path)[0].flight()
    split = float(flight.t[flight.ok].mean())
    model, wind = identified(flight, split)
    p = dict(zip(PARAMETERS, model.parameters.tolist(), strict=True))
    row: dict[str, Any] = {"airframe": airframe, **coefficients(model, uav)}
    for seconds in (SHORT_S, LONG_S):
        n = round(seconds / DT)
        later = np.arange(int(np.searchsorted(flight.t, split)), len(flight.t) - n, n)
        starts = later[[flight.ok[k : k + n].all() for k in later]]
        runs = free_run(flight, p, wind, starts, seconds)
        row[f"fit_{seconds:.0f}s"] = dict(zip(ROWS, fits(flight, runs, starts).tolist(), strict=True))
    return row


def show(title: str, row: dict[str, Any]) -> None:
    """Print errors and fits of one row."""
    errors = [f"{name} {100 * x:+.1f} %" for name, x in row.items() if isinstance(x, float)]
    runs = [
        f"{name} {' '.join(f'{k} {x:.0f}' for k, x in fit.items())} %"
        for name, fit in row.items()
        if isinstance(fit, dict)
    ]
    print(f"{title}: {'  '.join(errors + runs)}", flush=True)


def main(argv: list[str] | None = None) -> int:
    """Print a row for each flight and the medians."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=12)
    parser.add_argument("--seed", type=int, default=5101)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args(argv)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(args.flights):
            if (row := measure(number, args.seed, Path(folder))) is None:
                print(f"flight {number}: left the envelope", flush=True)
                continue
            rows.append(row)
            show(f"{number} {row['airframe']}", row)
    errors = {name: np.abs([row[name] for row in rows]) for name in ("thrust", *(f"drag_{v:.0f}" for v in SPEEDS))}
    for name, x in errors.items():
        print(f"{name}: within 5 % {np.mean(x <= 0.05):.0%} of {len(rows)}, median error {np.median(x):.1%}")
    keys = (f"fit_{SHORT_S:.0f}s", f"fit_{LONG_S:.0f}s")
    show("medians", {key: {k: float(np.median([row[key][k] for row in rows])) for k in ROWS} for key in keys})
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
