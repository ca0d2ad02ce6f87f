"""Are the real failures of ALFA named, and its healthy flights not?

    python -m tests.bench.alfa --recordings recordings --json alfa.json

Two references: each flight's own first `--until` seconds, the same for all flights and before every failure; and
models calibrated on the healthy flights of the same day (else of the same month) without the judged flight. A healthy
flight that the calibration refuses is left out, as its message demands. Laws and tables come from the judged flight's
own trusted part alone. Both are scored by `score_alfa.py` of the recordings.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from twin_worker.diagnosis.baseline.calibrate import calibrate
from twin_worker.diagnosis.baseline.own_past import OwnPast, with_output_faults
from twin_worker.diagnosis.data.card import UNKNOWN
from twin_worker.diagnosis.data.flight import FlightData, read_flights
from twin_worker.diagnosis.inference.diagnose import diagnose
from twin_worker.diagnosis.inference.report import Report
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.diagnosis.output.keep import as_json

PREFIX_LENGTH = len("alfa_mm-dd")


def same_day_model(flight: FlightData, healthy: Sequence[FlightData]) -> Baseline:
    """Calibrate on the healthy flights of the day, else of the month, without `flight`."""
    others = [one for one in healthy if one.name != flight.name]
    chosen: list[FlightData] = []
    for length in (PREFIX_LENGTH, PREFIX_LENGTH - len("-dd")):
        chosen = chosen or [one for one in others if one.name[:length] == flight.name[:length]]
    while True:
        try:
            return calibrate(chosen, UNKNOWN)
        except ValueError as error:
            left = [one for one in chosen if not str(error).startswith(f"{one.name}:")]
            if len(left) == len(chosen):
                raise
            chosen = left


def judged(flight: FlightData, healthy: Sequence[FlightData], until: float | None) -> Report:
    """Diagnose one flight by its own past, or with a model where `until` is None."""
    if until is not None:
        return OwnPast(until, UNKNOWN).diagnose(flight)
    return with_output_faults(diagnose(flight, same_day_model(flight, healthy)), flight)


def scored(rows: list[dict[str, Any]], scorer: Path) -> str:
    """Return what the scorer of the recordings prints."""
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{row['flight']}.json" for row in rows]
        for path, row in zip(paths, rows, strict=True):
            path.write_text(json.dumps(row))
        command = [sys.executable, str(scorer), *map(str, paths)]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def main() -> int:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path, required=True)
    parser.add_argument("--until", type=float, default=46.0, help="end of the trusted past [s] (46)")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    flights: list[FlightData] = []
    refused: dict[str, str] = {}
    for path in sorted((args.recordings / "real").glob("alfa_*_failure*.tlog.xz")):
        try:
            flights += read_flights(path, UNKNOWN)
        except ValueError as error:
            refused[path.name.split(".")[0]] = str(error)
    healthy = [flight for flight in flights if "no_failure" in flight.name]
    result: dict[str, Any] = {}
    for mode, until in (("own past", args.until), ("model", None)):
        rows = [{"flight": name, "verdict": "refused", "sentence": text} for name, text in refused.items()]
        for flight in flights:
            try:
                rows.append(as_json(judged(flight, healthy, until)))
            except ValueError as error:
                rows.append({"flight": flight.name, "verdict": "refused", "sentence": str(error)})
            print(f"{mode}: {flight.name}: {rows[-1]['verdict']}: {rows[-1]['sentence'][:120]}", flush=True)
        score = scored(rows, args.recordings / "score_alfa.py")
        print(f"{mode}: {score}", flush=True)
        result[mode] = {"score": score, "flights": rows}
    if args.json:
        args.json.write_text(json.dumps(result, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
