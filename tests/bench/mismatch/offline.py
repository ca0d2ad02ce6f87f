"""Diagnose labelled flights offline and score them, with intervals; expensive intermediate results stay in a cache.

    python -m tests.bench.mismatch.offline --cache /tmp/cache --recordings recordings --sets open sitl calmwindy
    python -m tests.bench.mismatch.offline --cache /tmp/cache --sets /tmp/exam/26011 --json before.json

Sets: `open` (concealed-open), `sitl` (sitl and sitl-more on s01 to s03), `calmwindy` (the same on calm and windy
nominal flights together), or the folder of an examination of `fleet prove` with its labels opened. Half of sitl-more is
held out (`HELD_OUT`) and only read with `--held-out`. Flights are read once, models are calibrated once per source of
the baseline, and reports are stored per source of the whole diagnosis.
"""

import argparse
import hashlib
import json
import os
import pickle
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from scipy.stats import beta

from fleet.blind_test.mark import GradedFlight, grade, score
from fleet.process.file_options import output_file
from twin_worker.diagnosis.baseline import calibrate as calibration
from twin_worker.diagnosis.data.card import read_card
from twin_worker.diagnosis.data.flight import FlightData, read_flights
from twin_worker.diagnosis.inference.diagnose import diagnose
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.diagnosis.output.keep import as_json

HELD_OUT = ("h03", "h14", "h20", "n5", "f05", "f13")
"""Flights of sitl-more that no rule was chosen on."""
ZERO_S = 2.045  # boot time of the first attitude of flights without a start stamp [s]
Value = TypeVar("Value")


class Case(NamedTuple):
    """One flight with its label and the key of its baseline."""

    name: str
    path: Path
    base: str
    label: dict[str, Any]


def effect(name: str, t_s: float | None = None, surface: str = "", **params: float) -> dict[str, Any]:
    """Describe one concealed effect as `fleet prove` does; `t_s` is boot time."""
    out: dict[str, Any] = {"name": name, "params": params}
    if surface:
        out["surface"] = surface
    return out | ({"t0": t_s - ZERO_S} if t_s else {})


SITL = {
    "s04_wind_step": [effect("wind_steady", 266.2, speed_mps=9.0)],
    "s05_engine_75": [effect("thrust_loss", 246.08, loss=0.3)],
    "s06_drag_up": [effect("drag_increase", dCD=0.06)],
    "s07_servo_slow": [effect("actuator_lag", 236.14, tau_s=0.25)],
    "s08_airspeed_ratio": [effect("airspeed_scale", 216.12, scale=(1.99 / 2.6) ** 0.5)],
    "s10_multi3_nominal": [],
}
MORE: dict[str, list[dict[str, Any]]] = {
    "h01": [],
    "h02": [],
    "h03": [effect("turbulence", 299.1)],
    "h10": [effect("actuator_delay", 283.17, delay_s=0.05)],
    "h14": [effect("heading_bias", 190.1)],
    "h17": [effect("thrust_loss", 190.14, loss=0.28), effect("airspeed_scale", 280.1, scale=(1.99 / 2.5) ** 0.5)],
    "h20": [],
    "n1": [],
    "n3": [],
    "n5": [],
    "f02": [effect("drag_increase", 180.114, dCD=0.04)],
    "f05": [effect("control_effectiveness_loss", 221.154, "aileron", loss=0.45)],
    "f08": [effect("cg_shift", 231.095, dx_m=0.05)],
    "f13": [effect("mass_change", 240.114, dmass_kg=-0.4)],
}
OPEN_PARAMS = ("loss", "tau_s", "scale", "latency_s", "offset", "speed_mps", "from_deg", "dmass_kg")
ROLES = {0: "control", 1: "single", 2: "compound"}


def cases(name: str, recordings: Path, held_out: bool) -> tuple[list[Case], dict[str, tuple[list[Path], Path]]]:
    """Return the flights of one set, and the nominal flights and the card of each of its baselines."""
    if name == "open":
        folder = recordings / "concealed-open"
        labels = json.loads((folder / "labels.json").read_text())
        found = [
            Case(stem, folder / f"{stem}.tlog", "open", _open_label(label))
            for stem, label in labels.items()
            if label["role"] != "nominal"
        ]
        return found, {"open": (sorted(folder.glob("cal_*.tlog")), folder / "card.json")}
    if name in ("sitl", "calmwindy"):
        sitl, more = recordings / "sitl", recordings / "sitl-more"
        chosen = {stem: effects for stem, effects in MORE.items() if held_out == (stem in HELD_OUT)}
        paths = {stem: more / f"{stem}.tlog.xz" for stem in chosen}
        nominal = sorted(sitl.glob("s0[123]*.tlog.xz"))
        if name == "calmwindy":
            nominal = [more / "n1.tlog.xz", more / "n3.tlog.xz"]
            chosen = {stem: effects for stem, effects in chosen.items() if stem not in ("n1", "n3")}
        if not held_out:
            chosen |= SITL
            paths |= {stem: sitl / f"{stem}.tlog.xz" for stem in SITL}
        found = [
            Case(stem, paths[stem], name, {"role": ROLES[len(effects)], "airframe": "sitl", "effects": effects})
            for stem, effects in chosen.items()
        ]
        return found, {name: (nominal, Path("skywalker"))}
    folder = Path(name)
    labels = json.loads((folder / "labels.json").read_text())
    found = [
        Case(stem, folder / label["airframe"] / f"{stem}.tlog", f"{folder.name}-{label['airframe']}", label)
        for stem, label in labels.items()
        if label["role"] != "nominal"
    ]
    bases = {
        f"{folder.name}-{kind}": (sorted((folder / kind).glob("cal_*.tlog")), folder / kind / f"{kind}.card.json")
        for kind in ("c172p", "small")
    }
    return found, bases


def _open_label(label: dict[str, Any]) -> dict[str, Any]:
    effects = []
    for one in label["effects"]:
        params = {key: x for key, x in one["params"].items() if key in OPEN_PARAMS}
        entry = {"name": one["name"], "params": params, "t0": one.get("t0") or 0.0}
        if "surface" in one["params"]:
            entry["surface"] = one["params"]["surface"]
        effects.append(entry)
    return {"role": ROLES[len(effects)], "airframe": "c172p", "effects": effects}


class Cache:
    """Pickled values in a folder, by key."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder

    def get(self, key: str, compute: Callable[[], Value]) -> Value:
        """Return the stored value, computed and stored if it is missing."""
        path = self._folder / f"{key}.pickle"
        if path.exists():
            return pickle.loads(path.read_bytes())  # type: ignore[no-any-return]
        value = compute()
        path.write_bytes(pickle.dumps(value))
        return value


def source_hash(*folders: str) -> str:
    """Return a hash of the source of some folders of the diagnosis."""
    root = Path(calibration.__file__).parents[1]
    files = sorted(path for folder in folders for path in (root / folder).rglob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:10]


def diagnosed(flight: FlightData, base: Baseline) -> dict[str, Any] | None:
    """Diagnose one flight; None if it is refused."""
    try:
        return as_json(diagnose(flight, base))
    except ValueError as error:
        print(error, flush=True)
        return None


def interval(k: int, n: int) -> tuple[float, float]:
    """Return the 95 % interval of a share of k in n (Clopper and Pearson 1934)."""
    low = beta.ppf(0.025, k, n - k + 1) if k else 0.0
    return float(low), float(beta.ppf(0.975, k + 1, n - k)) if k < n else 1.0


def line(graded: GradedFlight, report: dict[str, Any]) -> str:
    """Return one row of the table."""
    hit = "ok   " if graded.hit else "class" if graded.role == "single" and graded.in_class else "WRONG"
    truth = "+".join(graded.concealed) or graded.role
    return f"{hit} {graded.flight:20} {graded.airframe:6} {truth:40} {report.get('sentence', 'refused')[:200]}"


def figures(results: list[GradedFlight]) -> Iterator[str]:
    """Yield the figures of a set with their intervals."""
    single = [one for one in results if one.role == "single"]
    control = [one for one in results if one.role == "control"]
    unknown = [one for one in results if one.role == "unknown"]
    compound = [one for one in results if one.role == "compound"]
    wrong = [one for one in single if one.named and not one.in_class]
    late = [abs(dt) for one in results for dt, _ in one.late]
    covered = [size.covered for one in results for _, size in one.sizes if size.covered is not None]
    rows = {
        "first": (sum(one.hit for one in single), len(single)),
        "class": (sum(one.in_class for one in single), len(single)),
        "wrong name": (len(wrong), len(single)),
        "control named": (sum(bool(one.named) for one in control), len(control)),
        "control unknown": (sum(one.verdict == "unknown" for one in control), len(control)),
        "unknown": (sum(one.hit for one in unknown), len(unknown)),
        "unknown named": (sum(bool(one.named) for one in unknown), len(unknown)),
        "compound recall": (
            sum(len(set(one.concealed) & set(one.named)) for one in compound),
            sum(len(one.concealed) for one in compound),
        ),
        "onset <= 3 s": (sum(dt <= 3.0 for dt in late), len(late)),
        "onset <= 5 s": (sum(dt <= 5.0 for dt in late), len(late)),
        "2 sigma": (sum(map(bool, covered)), len(covered)),
    }
    for name, (k, n) in rows.items():
        if n:
            low, high = interval(k, n)
            yield f"{name:16} {k:3d} of {n:3d}  {k / n:4.0%}  [{low:.0%}, {high:.0%}]"
    total = score(results)
    extra, magnitude = total["compound_extra_per_flight"], total["magnitude_median_err"]
    yield f"extra per compound flight {extra}, magnitude median {magnitude}, class size {total['class_size_median']}"


def main() -> int:
    """Diagnose and score."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="+", required=True)
    parser.add_argument("--recordings", type=Path, default=os.environ.get("PARAUAV_RECORDINGS", "recordings"))
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("--held-out", action="store_true", help="the held-out flights, instead of the others")
    parser.add_argument("--only", nargs="+", help="flights")
    parser.add_argument("--json", type=output_file, metavar="FILE", help="write the results to FILE")
    args = parser.parse_args()
    cache, rows = Cache(args.cache), []
    version = source_hash("baseline", "model", "data", "inference")
    for name in args.sets:
        found, nominal = cases(name, args.recordings, args.held_out)
        results, started = [], time.perf_counter()
        for case in found:
            if args.only and case.name not in args.only:
                continue
            files, card_path = nominal[case.base]
            card = read_card(card_path)
            reads = {path: f"{card_path.name}-{path.name.split('.')[0]}" for path in (*files, case.path)}
            flights = {path: cache.get(key, partial(read_flights, path, card)) for path, key in reads.items()}
            nominal_flights = [flight for path in files for flight in flights[path]]
            base = cache.get(f"base-{case.base}-{version}", partial(calibration.calibrate, nominal_flights, card))
            for flight in flights[case.path]:
                key = f"report-{case.base}-{flight.name}-{version}"
                report = cache.get(key, partial(diagnosed, flight, base))
                results.append(grade(flight.name, case.label, report))
                rows.append((report or {"flight": flight.name}) | {"set": name, "label": case.label})
                print(line(results[-1], report or {}), flush=True)
        print(f"--- {name}: {len(results)} flights, {time.perf_counter() - started:.0f} s")
        print(*figures(results), sep="\n", flush=True)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
