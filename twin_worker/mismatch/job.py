"""What one diagnosis is given and gives back, and the work itself: pure, so that any process may do it."""

import time
from dataclasses import dataclass, replace

import numpy as np

from fleet.contract import COLUMNS
from twin_worker.diagnosis.baseline.own_past import later
from twin_worker.diagnosis.baseline.past import BEFORE_S, calibrate_past, since
from twin_worker.diagnosis.data.card import Card
from twin_worker.diagnosis.data.flight import Flight, lay
from twin_worker.diagnosis.data.smooth import STEP_S
from twin_worker.diagnosis.inference.diagnose import diagnose
from twin_worker.diagnosis.inference.isolation.whitened_residuals import Sight
from twin_worker.diagnosis.inference.report import Report
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.diagnosis.model.residual import Case
from twin_worker.diagnosis.model.weather import own_weather
from twin_worker.mismatch.effect_increments import Push, pushes
from twin_worker.telemetry.history import History

NEWEST_S = 20.0  # newest flight whose residuals are watched [s]
GREW = 1.5  # their mean square over that of the flight before, from which a diagnosis is worth its time [-]
_LEAST_ROWS = 50  # of both, at one every 0.2 s

Rows = dict[str, tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Job:
    """One aircraft's recent flight.

    Attributes:
        uav: whose
        rows: telemetry as it came, by kind
        params: autopilot parameters
        card: the aircraft
        base: what it is compared with; None: its own past
        until: end of that past [s since 1970]
        whole: diagnose whatever the residuals say
    """

    uav: int
    rows: Rows
    params: dict[str, float]
    card: Card
    base: Baseline | None
    until: float = 0.0
    whole: bool = False


@dataclass(frozen=True)
class Answer:
    """What became of it.

    Attributes:
        uav: whose
        begin, end: the flight it was done on [s since 1970]
        grew: mean square of the newest residuals over those before, of the worst channel; nan where it cannot be told
        report: the diagnosis; None where nothing called for one
        pushes: what the effects found do to the aircraft, row by row
        refused: why there is neither, or empty
        failed: what defect of ours ended it without a result, or empty
        details: where that was met, for the log
        cpu_s: processor time it took [s]
    """

    uav: int
    begin: float
    end: float
    grew: float = float("nan")
    report: Report | None = None
    pushes: Push | None = None
    refused: str = ""
    failed: str = ""
    details: str = ""
    cpu_s: float = 0.0


def rows_of(history: History, start: float, past: Rows | None = None) -> Rows:
    """Copy what a diagnosis needs of a history from `start` on [s since 1970], behind what is kept of the past."""
    out = {}
    for kind in COLUMNS:
        t, x = history.rows(kind, start)
        if past is not None and len(past[kind][0]):
            old, before = past[kind]
            new = t > old[-1]
            t, x = np.concatenate([old, t[new]]), np.concatenate([before, x[new]])
        out[kind] = t, x
    return out


def failed(job: Job, why: str, *, cpu_s: float = 0.0, details: str = "") -> Answer:
    """Answer a job that a defect has ended."""
    return replace(_unanswered(job), failed=why, cpu_s=cpu_s, details=details)


def _unanswered(job: Job) -> Answer:
    t = job.rows["attitude"][0]
    return Answer(job.uav, float(t[0]) if len(t) else 0.0, float(t[-1]) if len(t) else 0.0)


def work(job: Job) -> Answer:
    """Look at the newest residuals, and diagnose where they call for it; what cannot be is refused in a sentence."""
    begun = time.process_time()
    found = _unanswered(job)
    try:
        found = _work(job, found)
    except (ValueError, np.linalg.LinAlgError) as error:
        found = replace(found, refused=str(error))
    return replace(found, cpu_s=time.process_time() - begun)


def _work(job: Job, found: Answer) -> Answer:
    history = History(keep_s=np.inf)
    for kind, (t, x) in job.rows.items():
        history.put(kind, t, x)
    flight = lay(f"uav-{job.uav}", history, job.params, job.card)
    base, until = job.base, job.until - flight.zero
    if base is None:
        base = calibrate_past(flight, until, job.card)
        flight = since(flight, until - BEFORE_S)
    found = replace(found, begin=flight.zero, grew=growth(flight, base))
    if not (job.whole or found.grew > GREW):
        return found
    report = diagnose(flight, base)
    if job.base is None:
        report = later(report, None, until)  # the newest seconds may be a climb: nothing is lost for good yet
    return replace(found, report=report, pushes=pushes(flight, base, report))


def growth(flight: Flight, base: Baseline) -> float:
    """Return how much larger the newest residuals are than those before, mean square, of the channel that grew most."""
    case = Case(flight, base)
    sight = Sight(case, own_weather(case))
    late = case.t > case.t[-1] - NEWEST_S
    now, before = sight.part(late), sight.part(~late)
    if min(now.ok.sum(), before.ok.sum()) < min(_LEAST_ROWS, 0.5 * NEWEST_S / STEP_S):
        return float("nan")
    size = [((x.e + x.Jn @ sight.xn)[x.ok] ** 2).mean(axis=0) for x in (now, before)]
    return float((size[0] / np.maximum(size[1], base.usual * 0.5)).max())
