"""Do proposals against an empty battery come in time, and is it not empty in flight when the simulator flies them?

    python -m tests.bench.proposals.energy --cases 20 --controls 20 --seed 28301 --json FILE

Multirotors are simulated by RotorPy with a battery. Each mission is flown once to learn what it uses. In a case the
battery holds 60 to 95 % of that (drawn), in a control 25 % of its capacity more. The twin has no other source than
telemetry with lost packets. The first option is approved 2 to 16 s after it was offered (drawn), as it is then, and is
on board 2 s later; up to three are approved in a flight. `empty`: the battery, in flight.
"""

import argparse
import json
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fleet.contract import Alert, AlertKind, Change, Mission
from fleet.simulator.flight.drive import RadioLink
from fleet.simulator.multirotor.uav import SimulatedMultirotor
from fleet.telemetry.mavlink.intake import MavlinkReceiver
from tests.bench.proposals.flights import APPROVED_S, LOSS, MAX_APPROVED, READ_BACK_S, T_0, UPLOAD_S, Twins
from twin_worker.proposals.candidates import MODES
from twin_worker.service.warm_up import warm_up

HELD = (0.6, 0.95)  # of what the mission uses, in a case [-]
SPARE = 0.25  # beyond it, in a control [-]
MAX_S = 1_500.0
_STEP_S = 0.5


@dataclass
class Energy:
    """What came of one flight."""

    seed: int
    is_case: bool
    used: float  # by the mission, of the capacity [-]
    alert_s: float | None = None  # the first, since the start
    offered_s: float | None = None
    took_s: float = 0.0  # to compute the first options, CPU of this thread
    sentences: list[str] = field(default_factory=list)  # of the options offered first
    flown: list[str] = field(default_factory=list)
    empty: bool = False
    left: float = 0.0  # at the end of the flight [-]
    ended_s: float = 0.0
    created: list[str] = field(default_factory=list)  # other alerts after the first change

    @property
    def in_time(self) -> bool:
        """Tell whether options were offered 2 s after the alert, computing included."""
        return self.alert_s is not None and self.offered_s is not None and self.waited_s <= 2.0

    @property
    def waited_s(self) -> float:
        """Return the time from the alert to the options [s]."""
        return (self.offered_s or 0.0) - (self.alert_s or 0.0) + self.took_s


def make(seed: int) -> SimulatedMultirotor:
    rng = np.random.default_rng((seed, 91))
    autopilot = str(rng.choice(["ardupilot", "px4"]))
    aircraft = str(rng.choice(["quad", "quad_large"]))
    return SimulatedMultirotor(0, seed, wind=float(rng.uniform(1.0, 6.0)), autopilot=autopilot, aircraft=aircraft)


def mission_use(seed: int) -> float:
    """Fly the mission once; return the share of the battery that it uses."""
    uav = make(seed)
    t, flown = 0.0, False
    while t < MAX_S and not (flown and not uav.armed):
        t += _STEP_S
        uav.step(t)
        flown |= uav.armed
    return 1.0 - uav._charge


def apply(uav: SimulatedMultirotor, change: Change) -> None:
    """Change the plan on board."""
    if change.mode:
        uav._enter_mode(MODES[change.mode])
    if change.items is not None:
        uav.items = change.items
        uav._sequence.set_items(uav.items)
    if change.speed is not None:
        uav._sequence.set_speed(change.speed)
    if change.seq is not None:
        uav._begin_item(change.seq)


def fly(seed: int, *, is_case: bool) -> Energy:
    """Fly one mission with what is proposed."""
    rng = np.random.default_rng((seed, 92))
    result = Energy(seed, is_case, mission_use(seed))
    uav, twins, receiver = make(seed), Twins(), MavlinkReceiver(-1)
    uav._charge = result.used * float(rng.uniform(*HELD)) if is_case else min(result.used + SPARE, 1.0)
    link = RadioLink(np.random.default_rng((seed, 93)), LOSS)
    for frame in uav.initial_frames():
        receiver.receive(T_0, frame, 0)
    pending: list[tuple[float, Any]] = []  # when it is approved, changed or read back, and the change
    changed: Mission | None = None
    approve_s, t, flown = np.inf, 0.0, False
    while t < MAX_S and not (flown and not uav.armed) and not result.empty:
        t += _STEP_S
        for at, change in [one for one in pending if one[0] <= t]:
            pending.remove((at, change))
            apply(uav, change)
            if change.items is not None:
                changed = Mission(
                    uav=0, t=T_0 + t + READ_BACK_S, items=change.items, seq=change.seq or 0, complete=True
                )
        link.send(t, uav.step(t))
        for arrival, frame in link.receive(t):
            receiver.receive(T_0 + arrival, frame, 0)
        flown |= uav.armed
        result.empty = uav.armed and not uav.vehicle.on_ground and uav._charge <= 0.0
        for message in receiver.flush(T_0 + t):
            if isinstance(message, Mission) and changed is not None:
                message = msgspec.structs.replace(message, items=changed.items)
            for alert in twins.hear(message):
                _note(result, alert, t)
        if changed is not None and changed.t <= T_0 + t < changed.t + _STEP_S:
            twins.hear(changed)
        active = [one for one in twins.active.values() if one.kind is AlertKind.BATTERY]
        if active and twins.proposer.due(active[0], twins.twins[0].telemetry.last_step_t):
            began = time.thread_time()
            proposal = twins.proposer.update(active[0], twins.twins[0].telemetry.last_step_t)
            if proposal is not None and proposal.options and approve_s == np.inf and len(result.flown) < MAX_APPROVED:
                if result.offered_s is None:
                    result.offered_s, result.took_s = t, time.thread_time() - began
                    result.sentences = [option.sentence for option in proposal.options]
                approve_s = t + float(rng.uniform(*APPROVED_S))
        if t >= approve_s:
            approve_s = np.inf
            newest = next((one for one in twins.proposer.current(0) if one.options), None)
            if newest is not None:
                result.flown.append(newest.options[0].sentence)
                pending += [(t + UPLOAD_S, change) for change in newest.options[0].changes]
    result.left, result.ended_s = round(uav._charge, 3), t
    return result


def _note(result: Energy, alert: Alert, t: float) -> None:
    if alert.active and alert.kind is AlertKind.BATTERY and result.alert_s is None:
        result.alert_s = t
    elif alert.active and alert.kind is not AlertKind.BATTERY and result.flown:
        result.created.append(f"{t:.0f} s: {alert.sentence}")


def summary(rows: list[Energy]) -> dict[str, Any]:
    """Count the outcomes."""
    return {
        "flights": len(rows),
        "alerts": sum(one.alert_s is not None for one in rows),
        "offered": sum(one.offered_s is not None for one in rows),
        "offered_in_2_s": sum(one.in_time for one in rows),
        "empty": sum(one.empty for one in rows),
        "created": sum(bool(one.created) for one in rows),
    }


def main() -> None:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        "python -m tests.bench.proposals.energy", description=__doc__, formatter_class=form
    )
    parser.add_argument("--cases", type=int, default=0, metavar="N", help="flights with too little energy (0)")
    parser.add_argument("--controls", type=int, default=0, metavar="N", help="flights with enough (0)")
    parser.add_argument("--seed", type=int, default=900, help="seed of the first flight of each (900)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every flight with its outcome")
    args = parser.parse_args()
    warm_up()
    results = []
    for is_case, number in ((True, args.cases), (False, args.controls)):
        for k in range(number):
            one = fly(args.seed + k, is_case=is_case)
            results.append(one)
            print(
                f"{'case' if is_case else 'control'} {one.seed}: mission uses {one.used:.0%}; alert {one.alert_s} s, "
                f"offered {one.offered_s} s, flown {one.flown}; {'EMPTY' if one.empty else 'ended'} at "
                f"{one.ended_s:.0f} s with {one.left:.1%}; created {one.created}",
                flush=True,
            )
    found = {
        name: summary([one for one in results if one.is_case is is_case])
        for name, is_case in (("cases", True), ("controls", False))
    }
    print(json.dumps(found, indent=1))
    if args.json:
        args.json.write_text(json.dumps({"summary": found, "flights": [asdict(one) for one in results]}, indent=1))


if __name__ == "__main__":
    main()
