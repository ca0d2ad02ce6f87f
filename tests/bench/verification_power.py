"""Does verification reject the errors that it says it would have detected, and accept models that are right?

    python -m tests.bench.verification_power --seed 2000 --flights 16 --json power.json
    python -m tests.bench.verification_power --flights 0 flight.tlog.xz other.tlog
    python -m tests.bench.verification_power --seed 2200 --flights 16 --later

Simulated aircraft (JSBSim, no equation in common with the model) fly in winds of 0, 2, 4 and 6 m/s with turbulence 0
to 3, each with a seed of its own; recordings may be added. The twin replays each flight; the newest accepted model and
its held-out data are stored every 20 s; with `--later` an active model that is older, and all data since its
identification. In these models each group of derivatives with a stated power is made wrong by 0, half, one and one and
a half times its detectable error, too large and too small; the trim of the identification window is unchanged. Shares
of rejections, by size and group, and their range over flights, because flights are independent.
Seeds 1000 to 1023 were used for tuning.
"""

import argparse
import json
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fleet.contract import Message, Outcome, Verdict
from fleet.physics.simulate import TAU, lagged
from fleet.physics.wrench import N_AERO, NAMES, OFFSETS, ROW, terms
from fleet.simulator.flight.drive import to_tlog
from fleet.simulator.flight.uav import SimulatedUav
from fleet.telemetry.recording.recordings import replay_messages
from fleet.window import Window
from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel
from twin_worker.service.warm_up import warm_up
from twin_worker.twin.state.budget import Schedule
from twin_worker.twin.state.state import Twin
from twin_worker.twin.step import advance
from twin_worker.twin.steps import identify_step
from twin_worker.validation.consistency import GROUPS, estimate_errors
from twin_worker.validation.verify import with_consistency

AIR = ((0.0, 0), (2.0, 1), (4.0, 2), (6.0, 3))  # mean wind [m/s] and turbulence, in turn
EVERY_S = 20.0  # between two models of one flight [s]
SIZES = (0.5, 1.0, 1.5)  # errors, of the detectable error
OFFSET_OF_ROW = dict(zip((0, 2, 4, 1, 3, 5), OFFSETS, strict=True))  # offset that drives each state


@dataclass(frozen=True)
class Case:
    """One accepted model, the window whose rows from `start` on were held out, and its verdict."""

    flight: str
    model: DerivativesModel
    window: Window
    start: int
    verdict: Verdict


def replayed(flight: str, messages: Iterable[Message], *, later: bool) -> list[Case]:
    """Replay a flight; keep the newest accepted model every 20 s, or the active one (`later`)."""
    cases: list[Case] = []
    twins: dict[int, Twin] = {}
    verify, verify_later = identify_step.verify, identify_step.verify_since_identification

    def keep(plant: Any, window: Window, start: int, verdict: Verdict) -> None:
        due = not cases or window.t[-1] - cases[-1].window.t[-1] >= EVERY_S
        if verdict.outcome is Outcome.PLAUSIBLE and due:
            cases.append(Case(flight, plant, window, start, verdict))

    def recorded(plant: Any, window: Window, start: int, threshold: float, active: Any) -> Verdict:
        verdict = verify(plant, window, start, threshold, active)
        keep(plant, window, start, verdict)
        return verdict

    def recorded_later(verdict: Verdict, plant: Any, window: Window, name: str) -> Verdict:
        if isinstance(plant, DerivativesModel):
            start = int(np.searchsorted(window.t, plant.t1, side="right"))
            keep(plant, window, start, msgspec.structs.replace(verdict, outcome=Outcome.PLAUSIBLE))
        return verify_later(verdict, plant, window, name)

    if later:
        identify_step.verify_since_identification = recorded_later
    else:
        identify_step.verify = recorded  # type: ignore[assignment]
    try:
        for message in messages:
            if message.uav not in twins:
                twins[message.uav] = Twin.of(message.uav, schedule=Schedule(predict=20.0, ensemble=3600.0))
            advance(twins[message.uav], (message,))
    finally:
        identify_step.verify, identify_step.verify_since_identification = verify, verify_later
    return cases


def simulated(seed: int, seconds: int, *, later: bool) -> list[Case]:
    """Fly one aircraft and replay its telemetry."""
    wind, turbulence = AIR[seed % len(AIR)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flight.tlog"
        uav = SimulatedUav(0, seed, wind=wind, turbulence=turbulence)
        to_tlog(path, [uav], seconds=seconds, loss=0.01, seed=seed)
        return replayed(str(seed), replay_messages(path), later=later)


def made_wrong(case: Case, group: str, error: float) -> DerivativesModel:
    """Scale one group of derivatives by 1 + error; offsets keep the mean force and moment of the window."""
    x, delta = case.window.x[: case.start], lagged(case.window.u, case.window.dt, TAU)
    factor, mean = np.empty(N_AERO), np.zeros(N_AERO)
    for k in range(0, case.start, 5):
        terms(x[k, 0], x[k, 1], x[k, 2], np.ascontiguousarray(x[k, 3:6]), delta[k], case.model.trim_velocity, factor)
        mean += factor / len(range(0, case.start, 5))
    par = case.model.par.copy()
    for i in (NAMES.index(name) for name in GROUPS[group]):
        par[i] += error * case.model.par[i]
        par[OFFSET_OF_ROW[ROW[i]]] -= error * case.model.par[i] * mean[i]
    return replace(case.model, par=par)


def is_rejected(model: DerivativesModel, case: Case) -> bool:
    """Test a model on the held-out data of a case; a free run that leaves the envelope rejects it too."""
    errors = estimate_errors(model, case.window, case.start)
    return errors is None or bool(errors.failed())


def tested(case: Case) -> dict[str, Any] | None:
    """Test a case and its wrong variants; None where too little data are held out for a test."""
    errors = estimate_errors(case.model, case.window, case.start)
    if errors is None:
        return None
    verdict = with_consistency(case.verdict, case.model, case.window, case.start)
    wrong = [
        {
            "group": group,
            "size": size,
            "sign": sign,
            "rejected": is_rejected(made_wrong(case, group, sign * size * percent / 100.0), case),
        }
        for group, percent in errors.power().items()
        for size in SIZES
        for sign in (-1, 1)
    ]
    return {
        "flight": case.flight,
        "verified": verdict.outcome is Outcome.VERIFIED,
        "failed": errors.failed(),
        "power": errors.power(),
        "wrong": wrong,
    }


def summary(cases: list[Case]) -> dict[str, Any]:
    """Test every case and count."""
    rows = [row for row in map(tested, cases) if row is not None]
    flights = sorted({row["flight"] for row in rows})
    out: dict[str, Any] = {
        "models": len(cases),
        "tested": len(rows),
        "flights": len(flights),
        "verified": _share(row["verified"] for row in rows),
        "rejected_unchanged": _share(bool(row["failed"]) for row in rows),
        "rejected_unchanged_by_group": {name: _share(name in row["failed"] for row in rows) for name in GROUPS},
        "stated_by_group": {name: _share(name in row["power"] for row in rows) for name in GROUPS},
        "detectable_median_percent": {
            name: _median(row["power"][name] for row in rows if name in row["power"]) for name in GROUPS
        },
        "rejected_by_size": {},
    }
    for size in SIZES:
        wrong = [(row["flight"], one) for row in rows for one in row["wrong"] if one["size"] == size]
        by_flight = [_share(one["rejected"] for at, one in wrong if at == flight) for flight in flights]
        measured = [share for share in by_flight if share is not None]
        out["rejected_by_size"][size] = {
            "n": len(wrong),
            "all": _share(one["rejected"] for _, one in wrong),
            "flights_lowest_to_highest": [min(measured), max(measured)] if measured else None,
            "too_small": _share(one["rejected"] for _, one in wrong if one["sign"] < 0),
            "too_large": _share(one["rejected"] for _, one in wrong if one["sign"] > 0),
            "by_group": {name: _share(one["rejected"] for _, one in wrong if one["group"] == name) for name in GROUPS},
        }
    return out


def _share(flags: Iterable[bool]) -> float | None:
    values = list(flags)
    return round(float(np.mean(values)), 3) if values else None


def _median(values: Iterable[float]) -> float | None:
    found = list(values)
    return round(float(np.median(found)), 1) if found else None


def main() -> None:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        "python -m tests.bench.verification_power", description=__doc__, formatter_class=form
    )
    parser.add_argument("files", type=Path, nargs="*", metavar="FILE", help="recorded flights of fixed wings")
    parser.add_argument("--seed", type=int, default=2000, help="of the first simulated flight (2000)")
    parser.add_argument("--flights", type=int, default=16, help="simulated flights (16)")
    parser.add_argument("--seconds", type=int, default=240, help="length of each [s] (240)")
    parser.add_argument("--later", action="store_true", help="all data since the identification")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was measured")
    args = parser.parse_args()
    warm_up()
    cases: list[Case] = []
    for seed in range(args.seed, args.seed + args.flights):
        cases += simulated(seed, args.seconds, later=args.later)
        print(f"flown {seed}: {len(cases)} models")
    found = {"simulated": summary(cases)} if cases else {}
    for path in args.files:
        found[path.name] = summary(replayed(path.name, replay_messages(path), later=args.later))
    text = json.dumps({"seed": args.seed, "seconds": args.seconds} | found, indent=1)
    print(text)
    if args.json:
        args.json.write_text(text + "\n")


if __name__ == "__main__":
    main()
