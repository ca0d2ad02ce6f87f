"""`python -m tests.bench.prediction`: every recording, ours beside the best simple method.

Prints one row per recording (vehicle, modes, methods used, figures) and, over all real flights of a kind, the paired
difference of the error to each simple method with its 95 % interval over flights. The result of each recording is
cached in a folder, so that a run can be continued. Flights of the ALFA set last one to three minutes: they are scored
from 20 s after their first sample on, as far as they go; all others as `fleet assess` does.
"""

import argparse
import json
import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from fleet.contract import Status
from fleet.telemetry.recording.options import NO_OPTIONS
from fleet.telemetry.recording.recordings import Recording
from twin_worker.evaluation.drive import EvaluationPlan, RecordingDriver
from twin_worker.evaluation.scoring.compare import ONE_FLIGHT, WORSE, paired_difference
from twin_worker.evaluation.scoring.log import OURS, EvaluationCase
from twin_worker.evaluation.scoring.score import LIMITS, passage_quantile, score_method, survival_at
from twin_worker.service.warm_up import warm_up

SIMPLE = ("cv", "ct", "imm", "route", "route_wind")
LOOK_AHEADS = (5, 16, 30, 60)
KINDS = {"alfa_": "ALFA, GUIDED", "px4_proto": "PX4 fixed wing", "cuav": "real ArduPlane", "c": "real multirotor"}
SETS = ("real", "sitl-more", "sitl", "copter")
ALFA = EvaluationPlan(every_s=2.5, methods=SIMPLE, first_s=20.0, event_free_s=10.0)
OTHERS = EvaluationPlan(methods=SIMPLE)


def recordings(folder: Path, sets: list[str]) -> list[Path]:
    """Return the telemetry recordings of some sets, without onboard copies of the same flights and reader tests."""
    files = [path for name in sets for path in sorted((folder / name).iterdir())]
    names = (".tlog", ".tlog.xz", ".ulg.xz", ".bin.xz", ".bin")
    return [
        path
        for path in files
        if path.name.endswith(names) and path.name != "alfa_20180718_155331_1_engine_failure.tlog"
    ]


def evaluate(path: Path) -> dict[str, Any]:
    """Evaluate one recording; return plain values for JSON."""
    plan = ALFA if path.name.startswith("alfa_") else OTHERS
    recording, driver = Recording(path, 0, NO_OPTIONS), RecordingDriver(path.name, plan)
    modes: Counter[str] = Counter()
    vehicles: set[str] = set()

    def messages() -> Any:
        for _, batch in recording.steps():
            for message in batch:
                if isinstance(message, Status) and message.mode:
                    modes[message.mode] += 1
                    vehicles.add(message.vehicle)
                yield message

    cases = list(driver.run(messages()))
    counted = [case for case in cases if not case.exclusion and {OURS, *SIMPLE} <= set(case.start.forecasts)]
    return {
        "recording": path.name,
        "set": path.parent.name,
        "vehicle": ", ".join(sorted(vehicles)),
        "modes": [mode for mode, _ in modes.most_common(4)],
        "starts": len(counted),
        "excluded": Counter(case.exclusion for case in cases if case.exclusion),
        "methods": Counter(case.start.forecasts[OURS].source for case in counted),
        "flight": [case.start.flight for case in counted],
        "scores": {name: scores(counted, name) for name in (OURS, *SIMPLE)} if counted else {},
    }


def scores(cases: list[EvaluationCase], name: str) -> dict[str, Any]:
    """Return passages and errors of a method at each start."""
    one = score_method(cases, name)
    columns = {str(s): one.column_at(s) for s in LOOK_AHEADS}
    distance = {s: [round(float(x), 2) for x in one.distance[:, k]] for s, k in columns.items() if k is not None}
    return {"passages": one.passages[LIMITS[0]].tolist(), "distance": distance}


def figures(result: dict[str, Any], name: str) -> dict[str, Any]:
    """Return t10 quartile, share held for 60 s and median errors of a method over the starts of a recording."""
    one = result["scores"][name]
    passages = np.array(one["passages"])
    return {
        "t10_lq_s": passage_quantile(passages, 0.25),
        "held_60": survival_at(passages, 60.0),
        "p50_m": {s: median(np.array(values)) for s, values in one["distance"].items()},
    }


def median(values: np.ndarray) -> float:
    """Return the median of the finite values."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else float("nan")


def pooled(results: list[dict[str, Any]], kind: str) -> dict[str, Any]:
    """Return the figures of all real flights of a kind, and the paired difference to each simple method."""
    chosen = [one for one in results if one["set"] == "real" and kind_of(one["recording"]) == kind and one["starts"]]
    flight = np.array([name for one in chosen for name in one["flight"]])
    out: dict[str, Any] = {"kind": kind, "flights": len(set(flight.tolist())), "starts": len(flight), "methods": {}}
    for name in (OURS, *SIMPLE):
        passages = np.array([row for one in chosen for row in one["scores"][name]["passages"]]).reshape(-1, 2)
        out["methods"][name] = {"t10_lq_s": passage_quantile(passages, 0.25), "difference_m": {}}
        for s in map(str, LOOK_AHEADS):
            pairs = np.array(
                [
                    row
                    for one in chosen
                    for row in zip(*(one["scores"][m]["distance"][s] for m in (OURS, name)), strict=True)
                ]
            ).reshape(-1, 2)
            valid = np.isfinite(pairs).all(axis=1)
            out["methods"][name].setdefault("p50_m", {})[s] = median(pairs[:, 1])
            if name != OURS and valid.any():
                difference = paired_difference(pairs[valid], flight[valid], np.median, better=-1.0)
                out["methods"][name]["difference_m"][s] = difference
    return out


def kind_of(name: str) -> str:
    """Return the kind of a real flight by the name of its recording."""
    return next((kind for prefix, kind in KINDS.items() if name.startswith(prefix)), "real multirotor")


def table(results: list[dict[str, Any]]) -> str:
    """Return the Markdown table of all recordings."""
    rows = [
        "| Recording | vehicle, modes | starts | methods | t10 quartile [s] | 60 s held "
        "| median error at 5 / 16 / 30 / 60 s [m] | best simple method at each: t10 quartile, errors |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for one in results:
        name, modes = one["recording"].split(".")[0], ", ".join(one["modes"])
        if not one["starts"]:
            reason = max(one["excluded"], key=one["excluded"].get, default="nothing predicted")
            rows.append(f"| {name} | {one['vehicle']}: {modes} | 0 | {reason} | – | – | – | – |")
            continue
        own, simple = figures(one, OURS), [figures(one, other) for other in SIMPLE]
        methods = ", ".join(f"{n} {method}" for method, n in sorted(one["methods"].items(), key=lambda x: -x[1]))
        best = {s: min((x["p50_m"][s] for x in simple), key=_nan_last) for s in map(str, LOOK_AHEADS)}
        t10 = max(x["t10_lq_s"] for x in simple)
        rows.append(
            f"| {name} | {one['vehicle']}: {modes} | {one['starts']} | {methods} | {_number(own['t10_lq_s'])} "
            f"| {_share(own['held_60'])} | {_errors(own['p50_m'])} | {_number(t10)}; {_errors(best)} |"
        )
    return "\n".join(rows)


def _nan_last(x: float) -> float:
    return x if np.isfinite(x) else np.inf


def _number(x: float) -> str:
    return f"{x:.1f}" if np.isfinite(x) else "–"


def _share(x: float) -> str:
    return f"{x:.0%}" if np.isfinite(x) else "–"


def _errors(by_s: dict[str, float]) -> str:
    return " / ".join(_number(by_s[str(s)]) for s in LOOK_AHEADS)


def pooled_text(results: list[dict[str, Any]]) -> str:
    """Return the comparison over flights as Markdown."""
    rows = [
        "| Kind | flights, starts | method | t10 quartile [s] | median error at 5 / 16 / 30 / 60 s [m] "
        "| difference ours minus method [m] (95 %) |",
        "|---|---|---|---|---|---|",
    ]
    for kind in dict.fromkeys(KINDS.values()):
        one = pooled(results, kind)
        for name, row in one["methods"].items() if one["starts"] else ():
            text = "; ".join(_interval(s, x) for s, x in row["difference_m"].items()) or "–"
            counts = f"{one['flights']}, {one['starts']}"
            rows.append(
                f"| {kind} | {counts} | {name} | {_number(row['t10_lq_s'])} | {_errors(row['p50_m'])} | {text} |"
            )
    return "\n".join(rows)


def _interval(s: str, x: dict[str, Any]) -> str:
    if x["verdict"] == ONE_FLIGHT:
        return f"{s} s: {x['difference']}"
    return f"{s} s: {x['difference']} ({x['low']} to {x['high']}){' worse' if x['verdict'] == WORSE else ''}"


def load_or(path: Path, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the cached result of a recording, else evaluate and cache it."""
    if not path.exists():
        path.write_text(json.dumps(make()))
    return json.loads(path.read_text())  # type: ignore[no-any-return]


def main() -> None:
    """Evaluate the recordings, one at a time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path(os.environ.get("PARAUAV_RECORDINGS", "recordings")))
    parser.add_argument("--sets", nargs="+", default=list(SETS), choices=SETS)
    parser.add_argument("--only", default="", help="recordings whose name contains this")
    parser.add_argument("--cache", type=Path, default=Path("prediction-bench"), help="folder of the results so far")
    parser.add_argument("--json", type=Path, help="write all figures")
    args = parser.parse_args()
    args.cache.mkdir(parents=True, exist_ok=True)
    warm_up()
    results = []
    for path in recordings(args.folder, args.sets):
        if args.only not in path.name:
            continue
        try:
            results.append(
                load_or(args.cache / f"{path.parent.name}-{path.name}.json", lambda path=path: evaluate(path))
            )  # type: ignore[misc]
            print(path.name, results[-1]["starts"], "starts", flush=True)
        except ValueError as error:
            print(f"{path.name}: {error}", flush=True)
    print(table(results), "", pooled_text(results), sep="\n")
    if args.json:
        summary = [pooled(results, kind) for kind in dict.fromkeys(KINDS.values())]
        args.json.write_text(json.dumps({"recordings": results, "pooled": summary}, indent=1) + "\n")


if __name__ == "__main__":
    main()
