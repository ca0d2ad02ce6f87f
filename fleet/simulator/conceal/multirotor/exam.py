"""All flights of a blind test of multirotors: draw missions, weather and effects, simulate, return the labels."""

from collections.abc import Callable
from math import inf
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fleet.frames import Origin
from fleet.simulator.conceal.exam import EffectNames, Label, Labels, counts, fly_all
from fleet.simulator.conceal.multirotor.faults import (
    AIRFRAMES,
    HIDDEN,
    OVERLAPPING,
    UNKNOWN,
    FaultyMultirotor,
    reported_values,
)
from fleet.simulator.conceal.record import first_attitude
from fleet.simulator.faults.physics import Fault
from fleet.simulator.flight.drive import write

_HOME = Origin(536_500_000, 80_500_000, 5_000)  # [1e-7 deg, 1e-7 deg, mm]
_SETTLE_S, _SECONDS = 20.0, 120.0  # flown before the recording starts, recorded
_ONSET_S = (40.0, 80.0)  # since the start of the recording
_NOMINAL_FLIGHTS = 3
_WIND, _TURBULENCE = (0.5, 5.0), (1, 2)  # mean at 100 m [m/s]; severity, MIL-F-8785C
_ATTEMPTS = 25
_MIN_OVER_NOISE = 2.0  # rms over the noise
_MIN_HEIGHT_M, _MAX_LEAN = 4.0, 0.9  # of a flight that stays in the envelope; lean [rad]
_LOG_S = 0.1


class RotorJob(NamedTuple):
    """Requirements for one flight."""

    name: str  # file name without suffix
    airframe: str
    role: str
    effects: EffectNames
    number: int  # index in the blind test


def simulate_rotor_exam(
    seed: int, flights: int, out: Path, progress: Callable[[str, int, int], None], processes: int
) -> Labels:
    """Simulate the flights of a blind test into a folder and return the labels.

    Args:
        seed: seed of all random draws
        flights: number of test recordings, without the nominal ones
        out: folder; one subfolder per airframe
        progress: called for every flight with its name, the number done and the total
        processes: number of processes
    Raises:
        ValueError: when there are too few flights for all roles.
        RuntimeError: when an effect stays too weak in all attempts.
    """
    jobs = draw_rotor_jobs(seed, flights)
    for airframe in AIRFRAMES:
        (out / airframe).mkdir(parents=True, exist_ok=True)
    labels: Labels = {}
    for name, label in fly_all(_fly_job, [(job, seed, out) for job in jobs], processes):
        labels[name] = label
        progress(name, len(labels), len(jobs))
    return dict(sorted(labels.items()))


def draw_rotor_jobs(seed: int, flights: int) -> list[RotorJob]:
    """Draw the effects of all flights; order and names are independent of them."""
    rng = np.random.default_rng((seed, 32))
    requests: list[tuple[str, str, EffectNames]] = []
    for k, (role, count) in enumerate(counts(flights).items()):
        for i, airframe in enumerate(AIRFRAMES):
            requests += [(airframe, role, names) for names in _names(rng, role, (count + (i + k) % 2) // 2)]
    names = sorted(f"rec_{int(x):08x}" for x in rng.choice(2**32, len(requests), replace=False))
    shuffled = [requests[i] for i in rng.permutation(len(requests))]
    jobs = [
        RotorJob(name, airframe, role, hidden, number)
        for number, (name, (airframe, role, hidden)) in enumerate(zip(names, shuffled, strict=True))
    ]
    nominal = [
        RotorJob(f"cal_{airframe}_{k}", airframe, "nominal", (), 1_000 + 10 * i + k)
        for i, airframe in enumerate(AIRFRAMES)
        for k in range(_NOMINAL_FLIGHTS)
    ]
    return nominal + jobs


def _names(rng: np.random.Generator, role: str, count: int) -> list[EffectNames]:
    """Draw the effects of `count` flights of one role; an effect or pair is repeated only when all were drawn."""
    if role not in ("single", "compound", "unknown"):
        return [()] * count
    names = list(UNKNOWN if role == "unknown" else HIDDEN)
    sets: list[EffectNames] = [(name,) for name in names]
    if role == "compound":
        sets = [(a, b) for i, a in enumerate(names) for b in names[i + 1 :] if _are_separable(a, b)]
    drawn: list[EffectNames] = []
    while len(drawn) < count:
        drawn += [sets[i] for i in rng.permutation(len(sets))]
    return drawn[:count]


def _are_separable(a: str, b: str) -> bool:
    channels = {HIDDEN[a].channel, HIDDEN[b].channel}
    return len(channels) == 2 and channels not in OVERLAPPING


def _fly_job(task: tuple[RotorJob, int, Path]) -> tuple[str, Label]:
    """Draw a flight until it stays in the envelope and all hidden effects are strong enough; record it."""
    job, seed, out = task
    rejections: list[str] = []
    for attempt in range(_ATTEMPTS):
        flight_seed = int(np.random.SeedSequence((seed, job.number, attempt)).generate_state(1)[0])
        label = fly_rotor_flight(job, seed, flight_seed, out / job.airframe / f"{job.name}.tlog", rejections)
        if label is not None:
            return job.name, label | {"redrawn": rejections}
    raise RuntimeError(f"{job.name}: {job.effects} rejected {_ATTEMPTS} times: {', '.join(rejections)}")


def fly_rotor_flight(job: RotorJob, seed: int, flight_seed: int, path: Path, rejections: list[str]) -> Label | None:
    """Record one flight and return its label, or append the reason for rejection and return None."""
    rng = np.random.default_rng((flight_seed, 31))
    faults = tuple(_draw_fault(rng, name) for name in job.effects)
    uav = FaultyMultirotor(
        *(0, seed),
        wind=float(rng.uniform(*_WIND)),
        turbulence=int(rng.choice(_TURBULENCE)),
        origin=_HOME,
        autopilot=AIRFRAMES[job.airframe],
        aircraft=job.airframe,
        flight_seed=flight_seed,
    )
    uav.attach(faults)
    uav.silent = True
    uav.step(_SETTLE_S)
    uav.silent = False
    frames = [(_SETTLE_S, frame) for frame in uav.initial_frames()]
    reason = ""
    for k in range(1, round(_SECONDS / _LOG_S) + 1):
        t = _SETTLE_S + k * _LOG_S
        frames += [(t, frame) for frame in uav.step(t)]
        if np.abs(uav.estimate.euler[:2]).max() > _MAX_LEAN or (t > 40.0 and -uav.estimate.p[2] < _MIN_HEIGHT_M):
            reason = "left the envelope"
            break
    for fault in faults:
        if uav.strength(fault) < _MIN_OVER_NOISE and not reason:
            reason = f"{fault.name} {fault.part} has strength {uav.strength(fault):.1f}"
    if reason:
        rejections.append(reason)
        return None
    with path.open("wb") as file:
        write(file, frames)
    first_s = first_attitude(frame for _, frame in frames) - uav.boot_s
    return {
        "role": job.role,
        "airframe": job.airframe,
        "seed": flight_seed,
        "effects": [_describe(uav, fault, first_s) for fault in faults],
        "flown_s": _SECONDS,
        "acts": [{"name": fault.name, "over_noise": round(uav.strength(fault), 1)} for fault in faults],
    }


def _draw_fault(rng: np.random.Generator, name: str) -> Fault:
    effect = (HIDDEN | UNKNOWN)[name]
    values = {key: float(x) for key, x in effect.draw(rng, False).items()}
    part, onset = str(rng.choice(effect.parts)), _SETTLE_S + float(rng.uniform(*_ONSET_S))
    is_step = str(rng.choice(effect.profiles)) == "step"
    return Fault(name, part, values, onset if is_step else 0.0, 0.0, inf)


def _describe(uav: FaultyMultirotor, fault: Fault, first_s: float) -> Label:
    """Describe one hidden effect; `first_s`: time of the first recorded ATTITUDE since the simulation start [s]."""
    params = reported_values(fault.name, uav.healthy[0], fault.values)
    label: Label = {"name": fault.name, "params": {key: round(x, 6) for key, x in params.items()}}
    if fault.part:
        label["surface" if fault.name.startswith("motor") else "of"] = fault.part
    if fault.t0 > 0:
        label["t0"] = round(fault.t0 - first_s, 3)
    return label
