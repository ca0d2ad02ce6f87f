"""Predictions over bad links: 30 % of frames lost, 10 s of silence a minute, a second late, and all three at once.

    python -m tests.bench.bad_links --flights 4 --seconds 300 --json bad_links.json

Each pretend flight is recorded once and worsened as each radio would; every prediction, those flown without the
aircraft included, is scored against the undisturbed recording. `coverage`: share of look-aheads at which the position
lay within all three half-axes of the tube, mean over predictions; `on the route` leaves the turn rates out.
"""

import argparse
import json
import tempfile
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fleet.contract import Message, Prediction, Sample
from fleet.frames import to_ned
from fleet.simulator.flight.drive import to_tlog
from fleet.simulator.flight.uav import SimulatedUav
from fleet.telemetry.recording.recordings import replay_messages
from tests.support.bad_radio import RADIOS, Radio, worsen
from twin_worker.confidence.tube_and_horizon import axes_error, first_passage, path_length
from twin_worker.evaluation.replay import run_offline
from twin_worker.twin.step import Twin

FROM_S = 60.0  # predictions count from here on: before, there is little to learn from [s]
LEAST_S = 20.0  # of flight that must follow a prediction [s]
AT_S = (10.0, 30.0, 60.0)  # look-aheads told apart [s]


@dataclass
class Tally:
    """What predictions over one radio came to."""

    inside: list[float] = field(default_factory=list)  # share of look-aheads within the tube, by prediction
    route: list[float] = field(default_factory=list)  # the same, of those on the route
    coasting: list[float] = field(default_factory=list)  # the same, of those flown without the aircraft
    at: dict[float, list[bool]] = field(default_factory=lambda: {at: [] for at in AT_S})
    horizon: list[bool] = field(default_factory=list)  # whether 10 % was passed after the horizon
    methods: Counter[str] = field(default_factory=Counter)
    events: Counter[str] = field(default_factory=Counter)
    gap_s: float = 0.0  # longest time between predictions
    flown_s: float = 0.0

    def row(self) -> dict[str, Any]:
        """Give it as numbers for people."""
        return {
            "predictions": len(self.inside),
            "a_minute": round(60 * len(self.inside) / max(self.flown_s, 1.0), 1),
            "longest_gap_s": round(self.gap_s, 1),
            "coverage": _mean(self.inside),
            "coverage_on_the_route": _mean(self.route),
            "coverage_coasting": _mean(self.coasting),
            "coasting": len(self.coasting),
            "coverage_at": {f"{at:g}": _mean(found) for at, found in self.at.items()},
            "horizon_hit_rate": _mean(self.horizon),
            "methods": dict(self.methods),
            "events": dict(self.events),
        }


def _mean(values: list) -> float | None:
    return round(float(np.mean(values)), 3) if values else None


def positions(messages: list[Message]) -> tuple[np.ndarray, np.ndarray]:
    """Give times (n,) [s since 1970] and places (n, 3) of everything that was heard, rising in time."""
    rows = [m.position for m in messages if isinstance(m, Sample) and m.position is not None]
    t, x = np.concatenate([r.t.numpy() for r in rows]), np.concatenate([r.x.numpy() for r in rows]).astype(float)
    order = np.argsort(t)
    return t[order], x[order]


def behind(heard: tuple[np.ndarray, np.ndarray], truth: tuple[np.ndarray, np.ndarray]) -> float:
    """Give by how much the fleet clock runs behind the one of the undisturbed recording, from rows in both [s]."""
    when = dict(zip(map(tuple, truth[1].tolist()), truth[0].tolist(), strict=True))
    found = [t - when[row] for t, row in zip(heard[0], map(tuple, heard[1].tolist()), strict=True) if row in when]
    return float(np.median(found))


def fly(messages: list[Message], truth: tuple[np.ndarray, np.ndarray], tally: Tally, since: float = FROM_S) -> None:
    """Let a twin hear one flight, and score what it predicts from `since` on [s]."""
    shift = behind(positions(messages), truth)
    twins: dict[int, Twin] = {}
    made = [r for r in run_offline(messages, twins) if isinstance(r, Prediction)]
    begin, end = truth[0][0] + since, truth[0][-1]
    told = [p for p in made if p.t - shift >= begin]
    tally.gap_s = max(tally.gap_s, *np.diff([p.t for p in told]), 0.0)
    tally.flown_s += end - begin
    tally.events.update(event for event, _ in {(p.event.value, p.event_t) for p in told if p.event})
    for p in told:
        if p.t - shift <= end - LEAST_S:
            _score(p, p.t - shift, truth, tally)


def _score(p: Prediction, t: float, truth: tuple[np.ndarray, np.ndarray], tally: Tally) -> None:
    ahead, path, tube = (a.numpy().astype(float) for a in (p.ahead, p.path, p.prediction_region_half_axes))
    known = (ahead > 0) & (t + ahead <= truth[0][-1])
    flown = to_ned(p.ned_origin(), *(np.interp(t + ahead, truth[0], column) for column in truth[1].T))
    error = axes_error(path, flown)
    held = (error[:, :3] <= tube).all(axis=1)
    tally.inside.append(float(held[known].mean()))
    tally.methods[p.method] += 1
    if p.method != "imm":
        tally.route.append(tally.inside[-1])
    if p.coast_s:
        tally.coasting.append(tally.inside[-1])
    for at in AT_S:
        if known[ahead == at].any():
            tally.at[at].append(bool(held[ahead == at][0]))
    whole = ahead <= truth[0][-1] - t
    speed = float(np.linalg.norm(np.diff(flown[:2], axis=0)) / max(ahead[1], 1e-3))
    passage, never = first_passage(error[whole, 3] / path_length(flown[whole], speed), ahead[whole])
    if not p.coast_s and (not never or passage >= p.horizon_s):
        tally.horizon.append(passage >= p.horizon_s)


def flight(folder: Path, seed: int, seconds: float) -> Path:
    """Record one pretend flight without any loss."""
    path = folder / f"{seed}.tlog"
    to_tlog(path, [SimulatedUav(0, seed, wind=4.0, turbulence=2)], seconds=seconds, loss=0.0, seed=seed)
    return path


def over(radio: Radio, source: Path, truth: tuple[np.ndarray, np.ndarray], seed: int, tally: Tally) -> None:
    """Fly one recording over one radio."""
    worse = source.with_suffix(".worse.tlog")
    worsen(source, worse, radio, seed)
    fly(list(replay_messages(worse)), truth, tally)


def main() -> None:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m tests.bench.bad_links", description=__doc__, formatter_class=form)
    parser.add_argument("--flights", type=int, default=4, help="pretend flights (4)")
    parser.add_argument("--seconds", type=float, default=300.0, help="length of each [s] (300)")
    parser.add_argument("--seed", type=int, default=9000, help="of the first flight; the next counts on (9000)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was measured")
    args = parser.parse_args()
    tallies = {name: Tally() for name in RADIOS}
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(args.seed, args.seed + args.flights):
            source = flight(Path(folder), seed, args.seconds)
            truth = positions(list(replay_messages(source)))
            for name, radio in RADIOS.items():
                over(radio, source, truth, seed, tallies[name])
                found = tallies[name].row()
                print(f"{seed} {name:22s} " + " ".join(f"{k} {found[k]}" for k in list(found)[:8]), flush=True)
    rows = {"seconds": args.seconds, "flights": args.flights, "seed": args.seed}
    rows["radios"] = {name: tally.row() for name, tally in tallies.items()}
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
