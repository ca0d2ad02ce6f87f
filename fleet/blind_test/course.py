"""Steps of a blind test: simulate, encrypt labels, calibrate, diagnose, commit hashes, decrypt labels, grade."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event
from typing import Any

from fleet.blind_test.mark import Mark, mark
from fleet.blind_test.seal import digest, taken, unseal
from fleet.process.children import run_until

Say = Callable[[str], None]


class Ended(Exception):
    """Signal that a step failed or was stopped; `code` is the exit status."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


@dataclass(frozen=True)
class Paper:
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
    pages: bool

    @property
    def sealed(self) -> Path:
        """Return the path of the encrypted labels."""
        return self.folder / "labels.sealed"


@dataclass(frozen=True)
class Marked:
    """Result of a blind test: graded flights, and the hashes committed before the labels were decrypted."""

    marks: list[Mark]
    sealed: str
    reports: str


def examine(paper: Paper, stop: Event, say: Say) -> Marked:
    """Run a blind test.

    Raises:
        Ended: when a step fails or is stopped.
        ValueError: when the encrypted labels or the reports changed after their hash was committed.
    """
    with TemporaryDirectory(prefix="parauav-key-") as elsewhere:
        key = Path(elsewhere) / "key"
        _conceal(paper, key, stop)
        sealed, secret = digest(paper.sealed), taken(key)
    say(f"labels encrypted, key only in this process: sha256 {sealed}")
    written = [_diagnose(paper, folder, stop, say) for folder in _airframes(paper.folder)]
    reports = digest(*written)
    say(f"reports committed: sha256 {reports}")
    labels: dict[str, Any] = json.loads(unseal(paper.sealed, secret, sealed))
    say("labels decrypted, hash matches")
    (paper.folder / "labels.json").write_text(json.dumps(labels, indent=1) + "\n")
    if digest(*written) != reports:
        raise ValueError(
            "reports: found them changed after the labels were decrypted, expected the committed hash; restart the test"
        )
    told = {one["flight"]: one for path in written for one in json.loads(path.read_text())}
    marks = [mark(name, label, told.get(name)) for name, label in labels.items() if label["role"] != "nominal"]
    return Marked(marks, sealed, reports)


def _airframes(folder: Path) -> list[Path]:
    """Return the folders of the simulated airframes."""
    return sorted(path.parent for path in folder.glob("*/*.card.json"))


def _conceal(paper: Paper, key: Path, stop: Event) -> None:
    given = {"seed": paper.seed, "flights": paper.flights, "jobs": paper.jobs, "out": paper.folder}
    options = [f"--{name}={value}" for name, value in (given | {"sealed": paper.sealed, "key": key}).items()]
    _step(stop, "fleet.blind_test.concealer", *options)


def _diagnose(paper: Paper, folder: Path, stop: Event, say: Say) -> Path:
    """Calibrate on the nominal flights of one airframe and diagnose the others; return the file of reports."""
    nominal, unknown = (sorted(map(str, folder.glob(f"{kind}_*.tlog"))) for kind in ("cal", "rec"))
    model, reports = folder / "model.json", folder / "reports.json"
    say(f"{folder.name}: calibrating on {len(nominal)} nominal flights")
    card = folder / f"{folder.name}.card.json"
    _step(stop, "twin_worker.diagnosis.learn", f"--airframe={card}", f"--out={model}", "--", *nominal)
    say(f"{folder.name}: diagnosing {len(unknown)} flights without labels")
    pages = [f"--report={folder / 'pages'}"] if paper.pages else []
    told = [f"--model={model}", f"--json={reports}", f"--jobs={paper.jobs}", *pages]
    _step(stop, "twin_worker.diagnosis", *told, "--", *unknown, fine=(0, 1))  # a rejected flight is graded as missed
    return reports


def _step(stop: Event, module: str, *options: str, fine: tuple[int, ...] = (0,)) -> None:
    code = run_until(stop, module, *options)
    if stop.is_set() or code not in fine:
        raise Ended(0 if stop.is_set() else code)
