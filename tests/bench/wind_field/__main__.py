"""`python -m tests.bench.wind_field`: predictions of 20 aircraft with and without the shared wind field.

Each seed is one fleet of simulated aircraft, recorded once. Ten are predicted twice on the same telemetry: alone,
and with the field estimated from the wind of all twenty. Some fleets fly through one field coherent in space and
time, the others each through a drift of its own, where only the mean can be shared.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fleet.cli import make_parser, run_command
from fleet.contract import Message
from fleet.simulator.flight.drive import to_tlog
from fleet.simulator.flight.uav import SimulatedUav
from fleet.simulator.vehicle.missions import HOME
from fleet.simulator.vehicle.wind_field import CoherentWind
from fleet.telemetry.recording.options import NO_OPTIONS
from fleet.telemetry.recording.recordings import Recording
from twin_worker.estimation.wind_field import WindFieldEstimator
from twin_worker.evaluation.drive import EvaluatedUav, EvaluationPlan, RecordingDriver
from twin_worker.evaluation.scoring.log import OURS, EvaluationCase
from twin_worker.evaluation.scoring.score import score_method
from twin_worker.service.warm_up import warm_up
from twin_worker.twin.state.budget import Schedule
from twin_worker.twin.state.state import Twin

EXAMPLES = """
  python -m tests.bench.wind_field
  python -m tests.bench.wind_field --set untouched --json wind_field.json
"""
UAVS, PREDICTED, SECONDS, TURBULENCE = 20, 10, 400.0, 1
FIRST_S, EVERY_S, LOOK_AHEADS = 120.0, 10.0, (16, 30, 60)
SCHEDULE = Schedule(predict=5.0, identify=10.0)
WIND_ONLY = Schedule(predict=1e9, identify=1e9)
PERIOD_S = 5.0  # between estimates of the field [s]


class Fleet(NamedTuple):
    """One fleet."""

    seed: int
    wind: float  # [m/s]
    coherent: bool


SETS = {
    "development": (Fleet(2101, 4.0, True), Fleet(2103, 5.0, False)),
    "untouched": (
        *(Fleet(2111, 3.5, True), Fleet(2116, 6.0, False), Fleet(2113, 5.5, True), Fleet(2115, 8.0, True)),
        Fleet(2117, 4.0, False),
    ),
}


@dataclass
class Sharing:
    """Exchange of wind between the twins of a driver, as workers do it on the bus."""

    driver: RecordingDriver
    estimator: WindFieldEstimator
    t: float = -np.inf

    def feed(self, messages: Iterable[Message]) -> Iterator[Message]:
        """Yield the messages; every `PERIOD_S` estimate the field and give it to all twins."""
        for message in messages:
            if message.t - self.t >= PERIOD_S:
                self.t = message.t
                self._exchange()
            yield message

    def _exchange(self) -> None:
        twins = [one.twin for one in self.driver.uavs.values() if one is not None]
        for twin in twins:
            if (estimate := twin.wind_estimate) is not None:
                self.estimator.add(twin.config.uav, estimate)
        wind_field = self.estimator.estimate()
        for twin in twins:
            twin.environment.set_wind_field(wind_field)


def record(fleet: Fleet, path: Path) -> None:
    """Fly a fleet into a recording."""
    shared = CoherentWind.of_fleet(fleet.wind, fleet.seed, HOME) if fleet.coherent else None
    uavs = [
        SimulatedUav(uav, fleet.seed, wind=fleet.wind, turbulence=TURBULENCE, wind_field=shared) for uav in range(UAVS)
    ]
    to_tlog(path, uavs, seconds=SECONDS, loss=0.02, seed=fleet.seed, title=f"seed {fleet.seed}")


def predict(messages: list[Message], name: str, *, sharing: bool) -> list[EvaluationCase]:
    """Predict the flights of the first aircraft; return the starts that count. The others contribute wind only."""
    driver = RecordingDriver(name, EvaluationPlan(every_s=EVERY_S, methods=(), first_s=FIRST_S))
    for uav in range(UAVS):
        schedule = SCHEDULE if uav < PREDICTED else WIND_ONLY
        driver.uavs[uav + 1] = EvaluatedUav(f"{name}:uav-{uav + 1}", Twin.of(uav + 1, schedule=schedule), None)
    cases = driver.run(Sharing(driver, WindFieldEstimator()).feed(messages) if sharing else messages)
    return [case for case in cases if not case.exclusion]


def figures(cases: list[EvaluationCase]) -> dict[str, Any]:
    """Return the errors by look-ahead and start, and whether the flight stayed in its tube."""
    one = score_method(cases, OURS)
    columns = {s: one.column_at(s) for s in LOOK_AHEADS}
    return {
        "starts": len(cases),
        "methods": sorted(set(one.source.tolist())),
        "flight": one.flight.tolist(),
        "t": [round(case.start.t, 1) for case in cases],
        "error_m": {s: np.round(one.distance[:, k], 3).tolist() for s, k in columns.items()},
        "inside": {s: one.inside[:, k].tolist() for s, k in columns.items()},
        "half_axis_m": {s: np.round(one.tube[:, k, 0], 2).tolist() for s, k in columns.items()},
    }


def summary(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Return median errors, coverage and the paired change of the median at 60 s, with its interval over fleets."""
    out: dict[str, Any] = {"fleets": len(results)}
    for s in LOOK_AHEADS:
        alone, shared = ([_by_start(one[kind], s) for one in results] for kind in ("alone", "shared"))
        pairs = [
            np.array([(a[key][:2] + b[key][:2]) for key in a if key in b]) for a, b in zip(alone, shared, strict=True)
        ]
        rows = np.vstack(pairs)
        rows = rows[np.isfinite(rows).all(axis=1)]
        before, after = float(np.median(rows[:, 0])), float(np.median(rows[:, 2]))
        out[f"{s}s"] = {
            "starts": len(rows),
            "p50_alone_m": round(before, 2),
            "p50_shared_m": round(after, 2),
            "change": round(after / before - 1.0, 4),
            "change_by_fleet": [
                round(float(np.nanmedian(one[:, 2]) / np.nanmedian(one[:, 0]) - 1.0), 4) for one in pairs
            ],
            "p90_alone_m": round(float(np.quantile(rows[:, 0], 0.9)), 2),
            "p90_shared_m": round(float(np.quantile(rows[:, 2], 0.9)), 2),
            "coverage_alone": round(float(rows[:, 1].mean()), 4),
            "coverage_shared": round(float(rows[:, 3].mean()), 4),
        }
    return out


def _by_start(one: dict[str, Any], s: int) -> dict[tuple[str, float], tuple[float, float]]:
    keys = zip(one["flight"], one["t"], strict=True)
    return dict(zip(keys, zip(one["error_m"][s], one["inside"][s], strict=True), strict=True))


def _run(args: argparse.Namespace) -> int:
    warm_up()
    results: dict[bool, list[dict[str, Any]]] = {True: [], False: []}
    folder = args.recordings or Path(tempfile.mkdtemp(prefix="wind-field-"))
    folder.mkdir(parents=True, exist_ok=True)
    for fleet in SETS[args.set]:
        path = folder / f"fleet{fleet.seed}.tlog"
        if not path.exists():
            record(fleet, path)
        messages = [message for _, batch in Recording(path, 0, NO_OPTIONS).steps() for message in batch]
        one = {kind: figures(predict(messages, path.stem, sharing=kind == "shared")) for kind in ("alone", "shared")}
        results[fleet.coherent].append({**fleet._asdict(), **one})
        print(fleet, json.dumps(summary([one])["60s"]), flush=True)
    report = {
        name: summary(results[coherent])
        for name, coherent in (("one field", True), ("independent drifts", False))
        if results[coherent]
    }
    print(json.dumps(report, indent=1))
    if args.json:
        args.json.write_text(
            json.dumps({"set": args.set, "fleets": SETS[args.set], "summary": report}, indent=1) + "\n"
        )
    return 0


def main(argv: list[str] | None = None) -> int:
    """Predict fleets with and without sharing."""
    parser = make_parser("python -m tests.bench.wind_field", __doc__ or "", EXAMPLES)
    parser.add_argument("--set", choices=tuple(SETS), default="development", help="seeds (development)")
    parser.add_argument("--recordings", type=Path, metavar="FOLDER", help="of the recordings, reused if there")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE")
    return run_command("bench.wind_field", _run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
