"""Steps of a blind test: simulate, encrypt labels, calibrate, diagnose, commit hashes, decrypt labels, grade."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event
from typing import Any

from fleet.blind_test.examiner import ForceCheck, check_forces
from fleet.blind_test.mark import GradedFlight, grade
from fleet.blind_test.seal import consume_key, decrypt, digest
from fleet.process.children import run_until
from fleet.telemetry.recording.options import NO_OPTIONS, RecordingOptions

LogFunction = Callable[[str], None]


class RunAborted(Exception):
    """Signal that a step failed or was stopped; `code` is the exit status."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


@dataclass(frozen=True)
class InjectedFlights:
    """Healthy recordings of one aircraft that faults are concealed in, and the reference of their diagnosis.

    Attributes:
        files: recordings
        model, against: calibrated model, or nominal recordings, each flight without itself; none: its own past
        airframe: card of the aircraft
        options: what the recordings lack
    """

    files: tuple[Path, ...]
    model: Path | None = None
    against: tuple[Path, ...] = ()
    airframe: Path | None = None
    options: RecordingOptions = NO_OPTIONS

    @property
    def reference(self) -> str:
        """Return the reference as text."""
        return "model" if self.model else "other flights" if self.against else "own past"


@dataclass(frozen=True)
class BlindTestConfig:
    """Configuration of one blind test.

    Attributes:
        seed, flights: seed of all random draws, number of flights
        folder: output folder for recordings, encrypted labels, models and reports
        jobs: number of processes
        write_pages: also write figures and a page for every flight
        injected: recordings that faults are concealed in; none: simulated flights
        smallest: magnitudes of simulated effects as a share of the usual ones, from this to 1
        aircraft: class of the simulated aircraft, wing or quad
    """

    seed: int
    flights: int
    folder: Path
    jobs: int
    write_pages: bool
    injected: InjectedFlights | None = None
    smallest: float = 1.0
    aircraft: str = "wing"

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
        settings: dict[str, object] = {"seed": config.seed, "flights": config.flights}
        settings |= {"out": config.folder, "sealed": config.sealed_labels, "key": key}
        if config.injected is None:
            settings |= {"jobs": config.jobs, "smallest": config.smallest, "aircraft": config.aircraft}
            _run_step(stop, "fleet.blind_test.concealer", *_options(settings))
        else:
            settings |= {"airframe": config.injected.airframe, "model": config.injected.model}
            options = (*_options(settings), *config.injected.options.arguments(), "--")
            _run_step(stop, "fleet.blind_test.inject.injector", *options, *map(str, config.injected.files))
        labels_hash, key_bytes = digest(config.sealed_labels), consume_key(key)
    log(f"labels encrypted, key only in this process: sha256 {labels_hash}")
    if config.injected is None:
        folders = sorted({path.parent for path in config.folder.glob("*/cal_*.tlog")})
        report_paths = [_diagnose_simulated(config, folder, stop, log) for folder in folders]
    else:
        folders = sorted(path.parent for path in config.folder.glob("*/source.json"))
        report_paths = [_diagnose_injected(config, config.injected, folder, stop, log) for folder in folders]
    reports_hash = digest(*report_paths)
    log(f"reports committed: sha256 {reports_hash}")
    labels: dict[str, Any] = json.loads(decrypt(config.sealed_labels, key_bytes, labels_hash))
    log("labels decrypted, hash matches")
    (config.folder / "labels.json").write_text(json.dumps(labels, indent=1) + "\n")
    if digest(*report_paths) != reports_hash:
        raise ValueError(
            "reports: found them changed after the labels were decrypted, expected the committed hash; restart the test"
        )
    log("predicting forces again on held-out blocks")
    report_by_flight = {report["flight"]: report for path in report_paths for report in json.loads(path.read_text())}
    results = [
        grade(name, label, report_by_flight.get(name), _check(config, name, label, report_by_flight.get(name)))
        for name, label in labels.items()
        if label["role"] != "nominal"
    ]
    return BlindTestResult(results, labels_hash, reports_hash)


def _check(
    config: BlindTestConfig, name: str, label: dict[str, Any], report: dict[str, Any] | None
) -> ForceCheck | None:
    """Predict the forces of a named flight again from the model of its report, against the recording."""
    if report is None or not report.get("predictions"):
        return None
    suffix = ".tlog" if config.injected is None else ".parauav"
    return check_forces(config.folder / label["airframe"] / f"{name}{suffix}", Path(report["predictions"]))


def _diagnose_simulated(config: BlindTestConfig, folder: Path, stop: Event, log: LogFunction) -> Path:
    """Calibrate on the nominal flights of one airframe and diagnose the others; return the file of reports."""
    nominal, test_flights = (sorted(map(str, folder.glob(f"{prefix}_*.tlog"))) for prefix in ("cal", "rec"))
    model = folder / "model.json"
    log(f"{folder.name}: calibrating on {len(nominal)} nominal flights")
    cards = [f"--airframe={card}" for card in folder.glob("*.card.json")]  # multirotors need none
    _run_step(stop, "twin_worker.diagnosis.learn", *cards, f"--out={model}", "--", *nominal)
    log(f"{folder.name}: diagnosing {len(test_flights)} flights without labels")
    return _diagnose(config, folder, stop, [f"--model={model}"])


def _diagnose_injected(
    config: BlindTestConfig, injected: InjectedFlights, folder: Path, stop: Event, log: LogFunction
) -> Path:
    """Diagnose the altered copies of one recording; return the file of reports."""
    source = json.loads((folder / "source.json").read_text())
    reference = [f"--against-own-past={source['until']}", *_options({"airframe": injected.airframe})]
    if injected.model is not None:
        reference = [f"--model={injected.model}"]
    elif injected.against:
        nominal = [str(path) for path in injected.against if str(path.absolute()) != source["path"]]
        model = folder / "model.json"
        log(f"{folder.name}: calibrating on {len(nominal)} other flights")
        options = (*_options({"airframe": injected.airframe, "out": model}), *injected.options.arguments(), "--")
        _run_step(stop, "twin_worker.diagnosis.learn", *options, *nominal)
        reference = [f"--model={model}"]
    log(f"{folder.name}: diagnosing {len(list(folder.glob('rec_*')))} copies without labels")
    return _diagnose(config, folder, stop, reference)


def _diagnose(config: BlindTestConfig, folder: Path, stop: Event, reference: list[str]) -> Path:
    reports = folder / "reports.json"
    page_options = [f"--report={folder / 'pages'}"] if config.write_pages else []
    options = [*reference, f"--json={reports}", f"--jobs={config.jobs}", *page_options]
    recordings = sorted(str(path) for path in folder.glob("rec_*") if path.suffix in (".tlog", ".parauav"))
    if not recordings:
        reports.write_text("[]\n")
        return reports
    accepted_codes = (0, 1, 2)  # a rejected flight is graded as missed
    _run_step(stop, "twin_worker.diagnosis", *options, "--", *recordings, accepted_codes=accepted_codes)
    if not reports.exists():  # invalid options, which the diagnosis has reported
        raise RunAborted(2)
    return reports


def _options(settings: Mapping[str, object]) -> list[str]:
    """Return options of a command line, without those that are None."""
    return [f"--{name}={value}" for name, value in settings.items() if value is not None]


def _run_step(stop: Event, module: str, *options: str, accepted_codes: tuple[int, ...] = (0,)) -> None:
    code = run_until(stop, module, *options)
    if stop.is_set() or code not in accepted_codes:
        raise RunAborted(0 if stop.is_set() else code)
