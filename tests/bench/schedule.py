"""CPU time and accuracy of the schedule of a worker, beside a rollout and an identification every second.

    python -m tests.bench.schedule s01_nominal_calm.tlog.xz s10_multi3_nominal.tlog.xz --json schedule.json
    python -m tests.bench.schedule --pace departure=0.3,information=0.05 flight.tlog

Each recording is replayed through a twin of either schedule. At every whole second the newest published prediction of
both is compared with the positions recorded later: the distance at 5, 16, 30, 60 and 120 s, and whether the region
holds the aircraft. Seconds count where both have a prediction. CPU is that of the thread, compiled kernels warm.
"""

import argparse
import json
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fleet.contract import Message, Prediction, Sample
from fleet.frames import to_ned
from fleet.telemetry.recording.recordings import replay_messages
from twin_worker.numerics.prediction_errors import along_cross_down, track_frame
from twin_worker.twin.state.budget import LIVE_SCHEDULE, Schedule, parse_schedule
from twin_worker.twin.step import Twin, advance

AHEAD_S = (5.0, 16.0, 30.0, 60.0, 120.0)
SCHEDULES = {"every second": Schedule()}
_MAX_AGE_S = 3.0  # an older prediction is none
_MAX_GAP_S = 2.0  # between two recorded positions


@dataclass
class Driven:
    """One twin of one schedule: newest prediction at each whole second, counts and CPU time."""

    twin: Twin
    cpu_s: float = 0.0
    rollouts: int = 0
    identified: int = 0
    newest: Prediction | None = None
    by_second: dict[int, Prediction] = field(default_factory=dict)

    def take(self, message: Message) -> None:
        """Advance the twin by one message."""
        before, identify_t = self.twin.prediction.last_rollout, self.twin.identification.timer.last
        started = time.thread_time()
        results = advance(self.twin, (message,))
        self.cpu_s += time.thread_time() - started
        self.rollouts += self.twin.prediction.last_rollout is not before
        self.identified += self.twin.identification.timer.last != identify_t
        self.newest = next((one for one in reversed(results) if isinstance(one, Prediction)), self.newest)
        second, newest = int(message.t), self.newest
        if newest is not None and 0.0 <= second - newest.t < _MAX_AGE_S:
            self.by_second.setdefault(second, newest)


def drive(messages: Iterable[Message], schedules: dict[str, Schedule]) -> dict[int, dict[str, Driven]]:
    """Replay messages through a twin of each schedule, by UAV id."""
    driven: dict[int, dict[str, Driven]] = {}
    for message in messages:
        if message.uav not in driven:
            driven[message.uav] = {
                name: Driven(Twin.of(message.uav, schedule=schedule)) for name, schedule in schedules.items()
            }
        for one in driven[message.uav].values():
            one.take(message)
    return driven


def positions_of(messages: Iterable[Message]) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Return the recorded positions by UAV id: times (n,) [s], and (n, 3) [1e-7 deg, mm]."""
    rows: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    for message in messages:
        if isinstance(message, Sample) and message.position is not None:
            pair = message.position.t.numpy(), message.position.x.numpy().astype(float)
            rows.setdefault(message.uav, []).append(pair)
    out = {}
    for uav, pairs in rows.items():
        t, x = (np.concatenate(part) for part in zip(*pairs, strict=True))
        t, unique = np.unique(t, return_index=True)
        out[uav] = t, x[unique]
    return out


def errors(prediction: Prediction, second: int, t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return distance [m] and whether the region holds the aircraft, `AHEAD_S` after `second`, nan unknown, (k, 2)."""
    out = np.full((len(AHEAD_S), 2), np.nan)
    ahead = prediction.ahead.numpy().astype(float)
    path, half_axes = (
        array.numpy().astype(float) for array in (prediction.path, prediction.prediction_region_half_axes)
    )
    tangents = track_frame(path, ahead)
    for row, ahead_s in zip(out, AHEAD_S, strict=True):
        at = second + ahead_s
        tau, k = at - prediction.t, int(t.searchsorted(at))
        if not 0 < k < len(t) or t[k] - t[k - 1] > _MAX_GAP_S or not tau <= ahead[-1]:
            continue
        fraction = (at - t[k - 1]) / (t[k] - t[k - 1])
        actual = to_ned(prediction.ned_origin(), *(x[k - 1] + fraction * (x[k] - x[k - 1])))
        predicted, limits = (np.array([np.interp(tau, ahead, c) for c in rows.T]) for rows in (path, half_axes))
        error = actual - predicted
        row[0] = np.linalg.norm(error)
        in_track = along_cross_down(tangents[int(np.abs(ahead - tau).argmin())], error)
        row[1] = float((np.abs(in_track) <= limits).all())
    return out


def compare(path: Path, schedules: dict[str, Schedule]) -> list[dict[str, Any]]:
    """Return one row per aircraft and schedule: CPU, counts, and errors where all schedules have a prediction."""
    messages = list(replay_messages(path))
    recorded, rows = positions_of(messages), []
    for uav, by_name in drive(messages, schedules).items():
        if uav not in recorded:
            continue
        common = sorted(set.intersection(*(set(one.by_second) for one in by_name.values())))
        if not common:
            continue
        for name, one in by_name.items():
            scores = np.array([errors(one.by_second[second], second, *recorded[uav]) for second in common])
            seconds = one.twin.telemetry.data_t - recorded[uav][0][0]
            rows.append({
                "flight": f"{path.name.partition('.')[0]} {uav}", "schedule": name, "seconds": len(common),
                "cpu_ms": 1e3 * one.cpu_s / seconds, "rollouts": one.rollouts, "identified": one.identified,
                "distance_m": scores[..., 0].tolist(), "inside": scores[..., 1].tolist(),
            })  # fmt: skip
    return rows


def summary(rows: list[dict[str, Any]]) -> list[str]:
    """Describe each schedule over all flights: mean of the distance, median, share inside the region."""
    lines = []
    for name in dict.fromkeys(row["schedule"] for row in rows):
        own = [row for row in rows if row["schedule"] == name]
        distance, inside = (np.vstack([np.array(row[key]) for row in own]) for key in ("distance_m", "inside"))
        cpu = float(np.mean([row["cpu_ms"] for row in own]))
        lines.append(
            f"{name}: {len(own)} flights, {len(distance)} s, {cpu:.1f} ms CPU per second, "
            f"{sum(row['rollouts'] for row in own)} rollouts, {sum(row['identified'] for row in own)} identifications"
        )
        for k, ahead_s in enumerate(AHEAD_S):
            known = np.isfinite(distance[:, k])
            if known.any():
                column = distance[known, k]
                lines.append(
                    f"  {ahead_s:4.0f} s  mean {column.mean():7.2f} m  median {np.median(column):6.2f} m  "
                    f"90 % {np.quantile(column, 0.9):7.2f} m  inside {inside[known, k].mean():.1%}  n {known.sum()}"
                )
    return lines


def run(args: argparse.Namespace) -> None:
    """Print the table."""
    schedules = SCHEDULES | {"live": args.pace}
    rows: list[dict[str, Any]] = []
    compare(args.files[0], schedules)  # compiles
    for path in args.files:
        rows += compare(path, schedules)
        print(*summary(rows[-2:]), sep="\n", flush=True)
    print("all flights", *summary(rows), sep="\n", flush=True)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")


def main() -> None:
    """Run from the command line."""
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m tests.bench.schedule", description=__doc__, formatter_class=form)
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="recordings")
    parser.add_argument("--pace", type=parse_schedule, default=LIVE_SCHEDULE, metavar="WORK=S,…", help="the schedule")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all errors to FILE")
    run(parser.parse_args())


if __name__ == "__main__":
    main()
