"""Do alerts come in time, and never where nothing happens? Pretend aircraft (JSBSim) heard by the offline twins.

    python -m tests.bench.alerts --seed 7 --json alerts.json

In a chain of flights each odd one meets the one before it (nearer than 50 m and 20 m of height) and each even one
passes it clear (at 150 to 230 m, or at 63 to 90 m of height); half sink below 30 m above home, half stay above 50 m;
half leave their geofence, the others turn 40 to 80 m inside it. All pairs are judged, also those that never come near.
Warning time: from the alert to the closest approach, or to the first instant below the height or outside the fence.
What must never raise an alert does not come to pass for two minutes after the twins' last sample either.
"""

import argparse
import json
import tempfile
import time
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from fleet.contract import Alert, AlertKind, Prediction
from fleet.simulator.flight.drive import EPOCH_US, to_tlog
from fleet.telemetry.recording.recordings import replay_messages
from twin_worker.evaluation.replay import run_offline
from twin_worker.service.warm_up import warm_up

from .world import END_S, HIGH_M, SAFE_M, STEP_S, WIDE_M, Flight, apart, chain, is_clear, lost_at, make

MUST_S = 30.0
KNOWN_S = 60.0  # what happens before so much was heard is listed apart [s]


def heard(flights: list[Flight], seed: int, loss: float) -> tuple[list[Alert], dict[str, Any]]:
    """Fly all into one recording, and let the twins hear it: their alerts, and what that cost."""
    uavs = [make(one.told, one.plan, one.radius) for one in flights]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "fleet.tlog"
        to_tlog(path, uavs, seconds=END_S, loss=loss, seed=seed)
        began, alerts, methods = time.process_time(), [], dict[str, int]()
        for message in run_offline(replay_messages(path, -1), {}):
            if isinstance(message, Alert):
                alerts.append(message)
            elif isinstance(message, Prediction):
                methods[message.method] = methods.get(message.method, 0) + 1
    return alerts, {"twins_s": round(time.process_time() - began, 1), "predictions": methods}


def raised(alerts: list[Alert], kind: AlertKind, uav: int, other: int = -1) -> list[float]:
    """Give when alerts of one thing were raised [s since the start]."""
    mine = [a for a in alerts if (a.uav, a.other) == (uav, other) and a.kind is kind and a.active]
    return [a.t - EPOCH_US * 1e-6 for a in mine]


def row(name: str, times: list[float], event: float | None) -> dict[str, Any]:
    """Put an event beside the alerts of it: `warning_s` is from the first that was not over before it."""
    warned = [event - t for t in times if event is not None and t <= event]
    return {
        "who": name,
        "event_s": event,
        "alerts_s": [round(t, 1) for t in times],
        "warning_s": round(max(warned), 1) if warned else None,
    }


def pairs(flights: list[Flight], alerts: list[Alert]) -> dict[str, list[dict[str, Any]]]:
    """Give the pairs that met, those well separated and those between, with their alerts."""
    found: dict[str, list[dict[str, Any]]] = {"met": [], "clear": [], "between": []}
    for a, b in combinations(flights, 2):
        wide, high = apart(a.path, b.path)
        n = int(END_S / STEP_S)
        lost = lost_at(a.path[:n], b.path[:n])
        kind = "met" if lost is not None else "clear" if is_clear(a.path, b.path) else "between"
        norm = np.maximum(wide[:n] / WIDE_M, high[:n] / HIGH_M)
        times = raised(alerts, AlertKind.CONFLICT, a.told.uav, b.told.uav)
        event = None
        if lost is not None:  # the closest approach of the first encounter
            k = int(lost / STEP_S)
            out = np.flatnonzero(norm[k:] >= 1)
            event = float(k + int(np.argmin(norm[k : k + (int(out[0]) if len(out) else n)]))) * STEP_S
        one = row(f"{a.told.uav}-{b.told.uav}", times, event)
        one |= {"lost_s": lost, "nearest_m": round(float(wide[high < 60].min(initial=9999.0)), 1)}
        one |= {"arranged": b.told.uav == a.told.uav + 1}
        found[kind].append(one)
    return found


def singles(flights: list[Flight], alerts: list[Alert]) -> dict[str, list[dict[str, Any]]]:
    """Give the flights that sank and left, those that did not, with their alerts."""
    found: dict[str, list[dict[str, Any]]] = {"sank": [], "stayed_up": [], "left": [], "stayed_in": []}
    n = int(END_S / STEP_S)
    dangers = ((AlertKind.GROUND, "sank", "stayed_up"), (AlertKind.GEOFENCE, "left", "stayed_in"))
    for one in flights:
        low, out = one.height() < SAFE_M, one.away() > one.radius
        for (kind, yes, no), bad in zip(dangers, (low, out), strict=True):
            k = np.flatnonzero(bad)
            times = raised(alerts, kind, one.told.uav)
            what = yes if len(k) and k[0] < n else no if not len(k) else None
            if what:
                found[what].append(row(str(one.told.uav), times, float(k[0]) * STEP_S if len(k) else None))
    return found


def summary(found: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """Count who was warned in time and who was warned of nothing."""
    out: dict[str, Any] = {}
    for name, rows in found.items():
        if name in ("met", "sank", "left"):
            early = [one for one in rows if one["event_s"] < KNOWN_S]
            rows = [one for one in rows if one["event_s"] >= KNOWN_S]
            warned = [one["warning_s"] or 0.0 for one in rows]
            out[name] = {
                "cases": len(rows),
                f"warned_{MUST_S:.0f}_s_before": sum(1 for w in warned if w >= MUST_S),
                "least_s": min(warned, default=None),
                "median_s": float(np.median(warned)) if warned else None,
                "alerts": sum(len(one["alerts_s"]) for one in rows),
                "before_60_s": len(early),
            }
        else:
            out[name] = {"cases": len(rows), "alerted": sum(bool(one["alerts_s"]) for one in rows)}
    for name in found.keys() & {"met", "clear"}:
        near = {name: [one for one in found[name] if one["arranged"]]}
        if len(near[name]) < len(found[name]):
            out[f"{name}_arranged"] = summary(near)[name]
    return out


def main() -> None:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m tests.bench.alerts", description=__doc__, formatter_class=form)
    parser.add_argument("--seed", type=int, default=7, help="draws everything (7)")
    parser.add_argument("--count", type=int, default=41, help="aircraft in the chain (41: 20 meet, 20 pass clear)")
    parser.add_argument("--loss", type=float, default=0.02, help="share of frames lost (0.02)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every pair and flight with its alerts")
    args = parser.parse_args()
    warm_up()
    began = time.process_time()
    flights = chain(args.count, args.seed, say=lambda said: print(said, flush=True))
    arranged = time.process_time()
    alerts, cost = heard(flights, args.seed, args.loss)
    found = pairs(flights, alerts) | singles(flights, alerts)
    cost |= {"arranging_s": round(arranged - began, 1)}
    raises = sum(1 for a in alerts if a.active)
    told = {"seed": args.seed, "summary": summary(found), "cost": cost, "raised": raises}
    told |= {"all_pairs_once_a_second": cost()}
    told |= {"withdrawn": len(alerts) - raises, "by_kind": _by_kind(alerts)}
    print(json.dumps(told, indent=1))
    if args.json:
        said = [a.sentence for a in alerts]
        args.json.write_text(json.dumps(told | {"cases": found, "sentences": said}, indent=1) + "\n")


def _by_kind(alerts: list[Alert]) -> dict[str, int]:
    kinds = [alert.kind.value for alert in alerts if alert.active]
    return {kind: kinds.count(kind) for kind in sorted(set(kinds))}


if __name__ == "__main__":
    main()
