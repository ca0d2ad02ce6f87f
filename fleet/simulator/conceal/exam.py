"""All flights of a blind test: draw airframes, roles and hidden effects, simulate in processes, return the labels."""

import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from math import ceil, degrees
from pathlib import Path
from typing import Any

import numpy as np

from fleet.simulator.conceal.acts import MIN_OVER_NOISE, effect_strength
from fleet.simulator.conceal.effects import HIDDEN, UNKNOWN, reported_values
from fleet.simulator.conceal.paths import (
    EXAM_HOME,
    NOMINAL_EXCITATION,
    FlightJob,
    PlannedFlight,
    baseline_type,
    draw_flight,
)
from fleet.simulator.conceal.record import ExamFlightLog, fly, rejection_reason
from fleet.simulator.faults.carried import FaultSet
from fleet.simulator.faults.physics import Fault
from fleet.simulator.vehicle.altered import instrumented_type
from fleet.simulator.vehicle.jsbsim import DT, KG_TO_LB, Aircraft
from fleet.simulator.vehicle.sensors import pressure_at
from fleet.simulator.vehicle.weather import FT

Label = dict[str, Any]
_R = 287.05  # of dry air [J/(kg K)]
_SEA_LEVEL_K, _LAPSE_K = 288.15, 0.0065  # standard atmosphere [K, K/m]
_SPEEDS, _THROTTLES = (44.0, 48.0, 52.0), (0.6, 0.75, 0.9)  # operating range of the Cessna [m/s, -]
_SPOOL_S = 6.0  # time for the propeller to reach steady speed


def describe_effect(planned: PlannedFlight, fault: Fault, log: ExamFlightLog, first_attitude_s: float) -> Label:
    """Describe one hidden effect.

    Args:
        planned: the flight
        fault: one of its hidden faults
        log: the flight with all hidden faults
        first_attitude_s: time of the first recorded ATTITUDE since simulation start [s]
    Returns:
        name, of, surface, params in the units of a report, times since that ATTITUDE [s]
    """
    airframe = planned.job.airframe
    params = reported_values(fault.name, airframe, fault.values)
    if fault.name == "air_density":
        params["density_ratio"] = density_ratio(log)
    if fault.name == "thrust_loss" and airframe == "c172p":
        params["loss"] = thrust_lost(planned, fault)
    label: Label = {"name": fault.name, "params": {key: round(x, 6) for key, x in params.items()}}
    if fault.part:
        label["surface" if fault.name.startswith(("actuator", "control")) else "of"] = fault.part
    if fault.t0 > 0:
        label["t0"] = round(fault.t0 - first_attitude_s, 3)
    if np.isfinite(fault.t1):
        label["t1"] = round(fault.t1 - first_attitude_s, 3)
    elif fault.ramp_s > 0:
        label["ramp_s"] = round(fault.ramp_s, 3)
    return label


def density_ratio(log: ExamFlightLog) -> float:
    """Return the ratio of air density to the standard atmosphere, mean over a flight."""
    height = log.height + EXAM_HOME.alt_mm * 1e-3
    standard = [pressure_at(h) / (_R * (_SEA_LEVEL_K - _LAPSE_K * h)) for h in height]
    return float(np.mean(log.rho / np.array(standard)))


def thrust_lost(planned: PlannedFlight, fault: Fault) -> float:
    """Return the fraction of thrust lost at equal throttle and speed, mean over several of each."""
    aircraft = Aircraft(EXAM_HOME, planned.seed, kind=baseline_type(planned.job.airframe))
    losses = [1 - _thrust(aircraft, v, u, fault) / _thrust(aircraft, v, u, None) for v in _SPEEDS for u in _THROTTLES]
    return float(np.mean(losses))


def _thrust(aircraft: Aircraft, Va: float, delta_t: float, fault: Fault | None) -> float:
    """Run the engine at constant throttle and speed to steady state; return its thrust [lbf]."""
    thrust_property = aircraft.kind.thrust_property
    nominal = aircraft[thrust_property]
    aircraft.start(np.array([0.0, 0.0, -200.0]), 0.0, Va, (0.0, 0.0))
    if fault is not None:
        FaultSet([fault._replace(t0=0.0)], aircraft).apply_to_physics(0.0)
    for _ in range(round(_SPOOL_S / DT)):
        aircraft.set_controls(0.0, 0.0, 0.0, delta_t)
        aircraft.step()
    thrust = aircraft["propulsion/engine/thrust-lbs"]
    aircraft[thrust_property] = nominal
    return thrust


_SLUG_FT2 = 1.3558179483  # [kg m2]
_THROW_DEG = {  # for command -1 and +1; + rolls right, pitches up, yaws right
    "c172p": {"aileron": [-20.0, 15.0], "elevator": [-23.0, 28.0], "rudder": [-16.0, 16.0]},
    "small": {name: [-degrees(0.4363), degrees(0.4363)] for name in ("aileron", "elevator", "rudder")},
}
_START_NED = np.array([0.0, 0.0, -150.0])  # NED from home [m]
_PROPELLER_M = {"c172p": 1.905, "small": 0.508}


def card(airframe: str) -> dict[str, object]:
    """Return the data of an airframe in SI; throws in degrees."""
    kind = instrumented_type(airframe)
    aircraft = Aircraft(EXAM_HOME, 0, kind=kind)
    aircraft[f"inertia/pointmass-weight-lbs{kind.payload_index}"] = sum(kind.payload_kg) / 2 * KG_TO_LB
    aircraft.start(_START_NED, 0.0, kind.cruise, (0.0, 0.0))
    inertia = {f"I{axes}": aircraft[f"inertia/i{axes}-slugs_ft2"] * _SLUG_FT2 for axes in ("xx", "yy", "zz")}
    return {
        "airframe": airframe,
        "m": aircraft["inertia/weight-lbs"] / KG_TO_LB,
        "S": aircraft["metrics/Sw-sqft"] * FT**2,
        "b": aircraft["metrics/bw-ft"] * FT,
        "c": aircraft["metrics/cbarw-ft"] * FT,
        **inertia,
        "Ixz": -aircraft["inertia/ixz-slugs_ft2"] * _SLUG_FT2,  # product of inertia; JSBSim returns the matrix element
        "Dprop": _PROPELLER_M[airframe],
        "surface_full_deg": _THROW_DEG[airframe],
    }


AIRFRAMES = ("c172p", "small")
_ATTEMPTS = 25
Labels = dict[str, Label]
EffectNames = tuple[str, ...]
"""Names of the hidden effects of one flight."""


def simulate_exam(
    seed: int,
    flights: int,
    out: Path,
    progress: Callable[[str, int, int], None] = lambda *_: None,
    processes: int = 2,
    *,
    smallest: float = 1.0,
) -> Labels:
    """Simulate the flights of a blind test into a folder and return the labels.

    Args:
        seed: seed of all random draws
        flights: number of test recordings, without the nominal ones
        out: folder; one subfolder per airframe with recordings and `<airframe>.card.json`
        progress: called for every flight with its name, the number done and the total
        processes: number of processes
        smallest: magnitudes as a share of the usual ones, from this to 1
    Returns:
        {flight: {role, airframe, seed, effects, flown_s, acts, redrawn}}, times since its first ATTITUDE [s]
    Raises:
        ValueError: when there are too few flights for all roles.
        RuntimeError: when an effect stays too weak in all attempts.
    """
    flight_jobs = [job._replace(smallest=smallest) for job in draw_jobs(seed, flights)]
    for airframe in AIRFRAMES:
        (out / airframe).mkdir(parents=True, exist_ok=True)
        (out / airframe / f"{airframe}.card.json").write_text(json.dumps(card(airframe), indent=1) + "\n")
    labels: Labels = {}
    for name, label in fly_all(_fly_job, [(job, seed, out) for job in flight_jobs], processes):
        labels[name] = label
        progress(name, len(labels), len(flight_jobs))
    return dict(sorted(labels.items()))


def draw_jobs(seed: int, flights: int) -> list[FlightJob]:
    """Draw the effects of all flights; order and names are independent of them."""
    rng = np.random.default_rng((seed, 22))
    requests: list[tuple[str, str, EffectNames]] = []
    for k, (role, count) in enumerate(counts(flights).items()):
        for i, airframe in enumerate(AIRFRAMES):
            n_flights = (count + (i + k) % 2) // 2
            requests += [(airframe, role, names) for names in _names(rng, role, airframe, n_flights)]
    names = sorted(f"rec_{int(x):08x}" for x in rng.choice(2**32, len(requests), replace=False))
    shuffled = [requests[i] for i in rng.permutation(len(requests))]
    jobs = [
        FlightJob(name, airframe, role, hidden, number)
        for number, (name, (airframe, role, hidden)) in enumerate(zip(names, shuffled, strict=True))
    ]
    nominal = [
        FlightJob(f"cal_{airframe}_{k}", airframe, "nominal", (), 1_000 + 10 * i + k, strength)
        for i, airframe in enumerate(AIRFRAMES)
        for k, strength in enumerate(NOMINAL_EXCITATION)
    ]
    return nominal + jobs


def _names(rng: np.random.Generator, role: str, airframe: str, count: int) -> list[EffectNames]:
    """Draw the effects of `count` flights of one role; a single effect is repeated only when all were drawn."""
    if role == "compound":
        return compounds(rng, airframe, count)
    if role not in ("single", "unknown"):
        return [()] * count
    names = [x for x, h in (HIDDEN if role == "single" else UNKNOWN).items() if airframe in h.airframes]
    drawn: list[EffectNames] = []
    while len(drawn) < count:
        drawn += [(names[i],) for i in rng.permutation(len(names))]
    return drawn[:count]


def fly_all(
    fly_job: Callable[[Any], tuple[str, Label]], tasks: Sequence[Any], processes: int
) -> Iterator[tuple[str, Label]]:
    """Simulate flights by `fly_job(task)` in this process, or in several processes that end with this one."""
    if processes == 1:
        yield from map(fly_job, tasks)
        return
    with multiprocessing.get_context("spawn").Pool(processes, _init_process, (os.getpid(),)) as pool:
        yield from pool.imap(fly_job, tasks)
        pool.close()
        pool.join()


def _init_process(parent: int) -> None:
    """Ignore Ctrl-C, which the parent handles, and exit when the parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_with_parent, args=(parent,), daemon=True).start()


def _exit_with_parent(parent: int) -> None:
    while os.getppid() == parent:
        threading.Event().wait(1.0)
    os._exit(1)


def _fly_job(task: tuple[FlightJob, int, Path]) -> tuple[str, Label]:
    """Draw a flight until it stays in the envelope and all hidden effects are strong enough; record it."""
    job, seed, out = task
    rejections: list[str] = []
    for attempt in range(_ATTEMPTS):
        planned = draw_flight(job, seed, attempt)
        label = _try_flight(planned, out / job.airframe / f"{job.name}.tlog", rejections)
        if label is not None:
            return job.name, label | {"redrawn": rejections}
    raise RuntimeError(
        f"{job.name}: {job.effects} on {job.airframe} rejected {_ATTEMPTS} times: {', '.join(rejections)}"
    )


def _try_flight(planned: PlannedFlight, path: Path, rejections: list[str]) -> Label | None:
    """Record one flight and return its label, or append the reason for rejection and return None."""
    log, first_attitude_s = fly(planned, planned.hidden_faults, path)
    reason = rejection_reason(planned, log)
    strengths: list[Label] = []
    for fault in planned.hidden_faults if not reason else ():
        strengths.append(effect_strength(planned, fault, log))
        strength, channel = strengths[-1]["over_noise"], strengths[-1]["channel"]
        if strength < MIN_OVER_NOISE:
            reason = f"{fault.name} {fault.part} has strength {strength} in {channel}"
    if reason:
        rejections.append(reason)
        path.unlink()
        return None
    return {
        "role": planned.job.role,
        "airframe": planned.job.airframe,
        "seed": planned.flight_seed,
        "effects": [describe_effect(planned, fault, log, first_attitude_s) for fault in planned.hidden_faults],
        "flown_s": planned.seconds,
        "acts": strengths,
    }


_SINGLE, _COMPOUND, _UNKNOWN = 50 / 140, 16 / 140, 14 / 140
_OVERLAPPING = (  # pairs of channels that are not separable
    {"air", "airspeed"},
    {"air", "heading"},
    {"air", "gps"},
    {"force", "imu"},
    {"imu", "heading"},
    {"force", "pitch"},
    {"gps", "baro"},
)
_GLOBAL_EFFECTS = {"air_density", "turbulence"}  # affect all channels: never combined


def counts(flights: int) -> dict[str, int]:
    """Distribute the flights over the roles.

    Raises:
        ValueError: when there are fewer than 6 flights.
    """
    if flights < 6:
        raise ValueError(f"flights: found {flights}, expected 6 at least, so that each role has one; ask for more")
    single, compound = ceil(flights * _SINGLE), ceil(flights * _COMPOUND)
    unknown = max(round(flights * _UNKNOWN), 1)
    control = flights - single - compound - unknown
    return {"control": control, "single": single, "compound": compound, "unknown": unknown}


def compounds(rng: np.random.Generator, airframe: str, n: int) -> list[EffectNames]:
    """Draw `n` separable pairs, least used effects first."""
    names = [x for x, h in HIDDEN.items() if airframe in h.airframes]
    pairs = [(a, b) for i, a in enumerate(names) for b in names[i + 1 :] if are_separable(a, b)]
    use_count: dict[str, int] = dict.fromkeys(names, 0)
    out: list[EffectNames] = []
    for _ in range(n):
        min_count = min(use_count[a] + use_count[b] for a, b in pairs)
        rarest = [pair for pair in pairs if use_count[pair[0]] + use_count[pair[1]] == min_count]
        a, b = rarest[int(rng.integers(len(rarest)))]
        use_count[a], use_count[b] = use_count[a] + 1, use_count[b] + 1
        out.append((a, b))
    return out


def are_separable(a: str, b: str) -> bool:
    """Return whether two effects are separable in one flight."""
    if {a, b} & _GLOBAL_EFFECTS:
        return False
    channels = {HIDDEN[a].channel, HIDDEN[b].channel}
    if len(channels) == 1 or channels in _OVERLAPPING:
        return False
    return not ("servo" in channels and channels & {"roll", "pitch", "yaw"})
