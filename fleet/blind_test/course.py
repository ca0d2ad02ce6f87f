"""Steps of a blind test: simulate, encrypt labels, calibrate, diagnose, commit hashes, decrypt labels, grade."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event
from typing import Any

from fleet.blind_test.mark import GradedFlight, grade
from fleet.blind_test.seal import consume_key, decrypt, digest
from fleet.process.children import run_until

LogFunction = Callable[[str], None]


class RunAborted(Exception):
    """Signal that a step failed or was stopped; `code` is the exit status."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


@dataclass(frozen=True)
class BlindTestConfig:
    """Configuration of one blind test.

    Attributes:
        seed, flights: seed of all random draws, number of flights
        folder: output folder for recordings, encrypted labels, models and reports
        jobs: number of processes
        write_pages: also write figures and a page for every flight
    """

    seed: int
    flights: int
    folder: Path
    jobs: int
    write_pages: bool

    @property
    def sealed_labels(self) -> Path:
        """Return the path of the encrypted labels."""
        return self.folder / "labels.sealed"


@dataclass(frozen=True)
class BlindTestResult:
    """Result of a blind test: graded flights, and the hashes committed before the labels were decrypted."""

    results: list[GradedFlight]
    labels_sha256: str
    reports_sha256: str


def run_blind_test(config: BlindTestConfig, stop: Event, log: LogFunction) -> BlindTestResult:
    """Run a blind test.

    Raises:
        RunAborted: when a step fails or is stopped.
        ValueError: when the encrypted labels or the reports changed after their hash was committed.
    """
    with TemporaryDirectory(prefix="parauav-key-") as key_folder:
        key = Path(key_folder) / "key"
        settings: dict[str, object] = {"seed": config.seed, "flights": config.flights, "jobs": config.jobs}
        settings |= {"out": config.folder, "sealed": config.sealed_labels, "key": key}
        options = [f"--{name}={value}" for name, value in settings.items()]
        _run_step(stop, "fleet.blind_test.concealer", *options)
        labels_hash, key_bytes = digest(config.sealed_labels), consume_key(key)
    log(f"labels encrypted, key only in this process: sha256 {labels_hash}")
    airframe_folders = sorted(path.parent for path in config.folder.glob("*/*.card.json"))
    report_paths = [_diagnose(config, folder, stop, log) for folder in airframe_folders]
    reports_hash = digest(*report_paths)
    log(f"reports committed: sha256 {reports_hash}")
    labels: dict[str, Any] = json.loads(decrypt(config.sealed_labels, key_bytes, labels_hash))
    log("labels decrypted, hash matches")
    (config.folder / "labels.json").write_text(json.dumps(labels, indent=1) + "\n")
    if digest(*report_paths) != reports_hash:
        raise ValueError(
            "reports: found them changed after the labels were decrypted, expected the committed hash; restart the test"
        )
    report_by_flight = {report["flight"]: report for path in report_paths for report in json.loads(path.read_text())}
    results = [
        grade(name, label, report_by_flight.get(name)) for name, label in labels.items() if label["role"] != "nominal"
    ]
    return BlindTestResult(results, labels_hash, reports_hash)


def _diagnose(config: BlindTestConfig, folder: Path, stop: Event, log: LogFunction) -> Path:
    """Calibrate on the nominal flights of one airframe and diagnose the others; return the file of reports."""
    nominal, test_flights = (sorted(map(str, folder.glob(f"{prefix}_*.tlog"))) for prefix in ("cal", "rec"))
    model, reports = folder / "model.json", folder / "reports.json"
    log(f"{folder.name}: calibrating on {len(nominal)} nominal flights")
    card = folder / f"{folder.name}.card.json"
    _run_step(stop, "twin_worker.diagnosis.learn", f"--airframe={card}", f"--out={model}", "--", *nominal)
    log(f"{folder.name}: diagnosing {len(test_flights)} flights without labels")
    page_options = [f"--report={folder / 'pages'}"] if config.write_pages else []
    options = [f"--model={model}", f"--json={reports}", f"--jobs={config.jobs}", *page_options]
    accepted_codes = (0, 1)  # a rejected flight is graded as missed
    _run_step(stop, "twin_worker.diagnosis", *options, "--", *test_flights, accepted_codes=accepted_codes)
    return reports


def _run_step(stop: Event, module: str, *options: str, accepted_codes: tuple[int, ...] = (0,)) -> None:
    code = run_until(stop, module, *options)
    if stop.is_set() or code not in accepted_codes:
        raise RunAborted(0 if stop.is_set() else code)
