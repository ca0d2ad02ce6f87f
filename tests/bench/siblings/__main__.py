"""Is an aircraft verified sooner with what its siblings have learnt, and is one that differs from them found?

    python -m tests.bench.siblings --normal 20 --dragged 10 --seed 900 --json FILE

Aircraft of one type (PX4's law and parameters) are simulated by JSBSim, each with coefficients, thrust, payload and
asymmetries of its own (`--spread` times the usual deviations of the simulator). Ten fly, and their distribution is
estimated. Each `normal` aircraft flies afterwards; its telemetry goes to a twin without and by one with that
distribution, and the times of their first accepted and first verified models are compared. `dragged` aircraft have
15 % more drag at trim than by their own draw. Each is then compared with the ten.
"""

import argparse
import json
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fleet.airframes import GENERIC, load
from fleet.contract import Message, Model, Outcome, SiblingData, SiblingType
from fleet.simulator.flight.drive import EPOCH_US, RadioLink
from fleet.simulator.flight.uav import SimulatedUav
from fleet.simulator.vehicle.altered import instrumented_type
from fleet.simulator.vehicle.missions import HOME, draw_mission
from fleet.simulator.vehicle.types import AircraftType, FlightSetup, Weather
from fleet.telemetry.mavlink.intake import MavlinkReceiver
from twin_worker.identification.fixed_wing.siblings import estimate_type
from twin_worker.service.warm_up import warm_up
from twin_worker.twin.state.budget import Schedule
from twin_worker.twin.state.state import Twin
from twin_worker.twin.step import advance

AIRFRAME = load(GENERIC)
AUTOSTART = {"SYS_AUTOSTART": 2100.0}  # names the type of aircraft
SCHEDULE = Schedule(identify=2.0, predict=30.0, ensemble=300.0)
SIBLINGS, SECONDS, LOSS = 10, 180.0, 0.02
T_0, _STEP_S = EPOCH_US * 1e-6, 0.25
ACCEPTED = (Outcome.VERIFIED, Outcome.PLAUSIBLE)


class FirstModels(NamedTuple):
    """What a twin learnt from one flight."""

    accepted_s: float  # first accepted model, since the start; inf: none
    verified_s: float  # first verified model
    model: Model | None  # the last accepted one
    siblings: int  # behind the prior of its first accepted model


def kind_of(spread: float) -> AircraftType:
    """Return the type of aircraft with a share of the usual deviations between individuals."""
    one = instrumented_type("small")
    low, high = one.payload_kg
    middle, half = 0.5 * (low + high), 0.5 * spread * (high - low)
    smaller = {name: spread * value for name, value in one.spread.items()}
    offsets = {name: spread * value for name, value in one.offsets.items()}
    return one._replace(payload_kg=(middle - half, middle + half), spread=smaller, offsets=offsets)


def recorded(uav: int, seed: int, kind: AircraftType, drag: float) -> list[Message]:
    """Fly one aircraft, and return what the gateway receives of it; `drag`: added, of its own at trim [-]."""
    own = int(np.random.SeedSequence((seed, uav)).generate_state(1)[0])
    rng = np.random.default_rng((seed, uav, 5))
    weather = Weather(float(rng.uniform(2.0, 6.0)), float(rng.uniform(-np.pi, np.pi)), int(rng.integers(1, 3)))
    setup = FlightSetup(own, kind, draw_mission(own, kind.cruise, HOME, kind.geometry, "px4"), weather)
    one = SimulatedUav(uav, seed, setup=setup, autopilot="px4", extra_params=AUTOSTART)
    fdm = one.aircraft
    if drag:
        present = fdm["forces/fwx-aero-lbs"] / (fdm["aero/qbar-psf"] * fdm["metrics/Sw-sqft"])  # positive backwards
        assert present > 0.0, f"found a drag coefficient of {present:.3f}"
        fdm["conceal/C_D"] = drag * present
    link, receiver = RadioLink(np.random.default_rng((seed, 6, uav)), LOSS), MavlinkReceiver(-1)
    for frame in one.initial_frames():
        receiver.receive(T_0, frame, uav)
    out: list[Message] = []
    for k in range(1, int(SECONDS / _STEP_S) + 1):
        t = k * _STEP_S
        link.send(t, one.step(t))
        for arrival, frame in link.receive(t):
            receiver.receive(T_0 + arrival, frame, uav)
        out += receiver.flush(T_0 + t)
    return out


def first_models(messages: list[Message], siblings: SiblingType | None = None) -> FirstModels:
    """Let a twin hear a flight."""
    twin = Twin.of(messages[0].uav, schedule=SCHEDULE, airframe=AIRFRAME)
    twin.identification.set_siblings(siblings)
    first = dict.fromkeys(("accepted", "verified"), np.inf)
    model, count = None, 0
    for message in messages:
        for result in advance(twin, (message,)):
            if not isinstance(result, Model) or result.active_verdict is None:
                continue
            now, outcome = result.t - T_0, result.active_verdict.outcome
            if outcome in ACCEPTED and result.derivatives is not None:
                if not np.isfinite(first["accepted"]):
                    count = result.derivatives.siblings
                first["accepted"], model = min(first["accepted"], now), result
            if outcome is Outcome.VERIFIED:
                first["verified"] = min(first["verified"], now)
    return FirstModels(first["accepted"], first["verified"], model, count)


def data_of(model: Model | None) -> SiblingData | None:
    return None if model is None or model.derivatives is None else model.derivatives.data


def main() -> None:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m tests.bench.siblings", description=__doc__, formatter_class=form)
    parser.add_argument("--normal", type=int, default=4, metavar="N", help="aircraft that fly after the ten (4)")
    parser.add_argument("--dragged", type=int, default=4, metavar="N", help="aircraft with 15 %% more drag (4)")
    parser.add_argument("--spread", type=float, default=0.5, help="deviations, of the simulator's usual ones (0.5)")
    parser.add_argument("--seed", type=int, default=900, help="seed of all aircraft (900)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every aircraft with its outcome")
    args = parser.parse_args()
    warm_up()
    fly = partial(recorded, seed=args.seed, kind=kind_of(args.spread))
    known: dict[int, SiblingData] = {}
    for uav in range(SIBLINGS):
        one = first_models(fly(uav, drag=0.0))
        if (data := data_of(one.model)) is not None:
            known[uav] = data
        print(f"sibling {uav}: accepted {one.accepted_s:.0f} s, verified {one.verified_s:.0f} s", flush=True)
    siblings = estimate_type(known, AIRFRAME)
    assert siblings is not None, "too few siblings have a model"
    print([one.sentence for one in siblings.differences])
    rows: list[dict[str, Any]] = []
    for k in range(args.normal + args.dragged):
        uav, drag = SIBLINGS + k, 0.0 if k < args.normal else 0.15
        messages = fly(uav, drag=drag)
        alone = first_models(messages) if not drag else None
        sooner = first_models(messages, siblings)
        data = data_of(sooner.model)
        found = estimate_type({**known, uav: data}, AIRFRAME) if data is not None else None
        differences = [one for one in found.differences if one.uav == uav] if found is not None else []
        rows.append(
            {
                "uav": uav,
                "drag": drag,
                "alone_s": None if alone is None else (alone.accepted_s, alone.verified_s),
                "with_siblings_s": (sooner.accepted_s, sooner.verified_s),
                "siblings": sooner.siblings,
                "differs": [(one.group, one.ratio, one.p) for one in differences],
            }
        )
        print(rows[-1], flush=True)
        if args.json:
            args.json.write_text(json.dumps({"seed": args.seed, "spread": args.spread, "rows": rows}, indent=1) + "\n")
    normal = [one for one in rows if not one["drag"]]
    dragged = [one for one in rows if one["drag"]]
    for index, name in enumerate(("accepted", "verified")):
        before = np.median([one["alone_s"][index] for one in normal])
        after = np.median([one["with_siblings_s"][index] for one in normal])
        print(f"first {name} model: median {before:.0f} s alone, {after:.0f} s with siblings")
    print(f"normal aircraft reported as different: {sum(bool(one['differs']) for one in normal)} of {len(normal)}")
    by_drag = sum(any(group == "drag" and ratio > 0 for group, ratio, _ in one["differs"]) for one in dragged)
    print(f"aircraft with 15 % more drag reported with it: {by_drag} of {len(dragged)}")


if __name__ == "__main__":
    main()
