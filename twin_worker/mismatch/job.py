"""Input and result of one diagnosis job, and the job itself: a pure function that runs in any process."""

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

NEWEST_S = 20.0  # newest flight whose residuals are monitored [s]
GREW = 1.5  # mean square of the recent residuals over the earlier ones that triggers a diagnosis [-]
_LEAST_ROWS = 50  # of both parts, one row every 0.2 s

Rows = dict[str, tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Job:
    """Recent flight of one aircraft.

    Attributes:
        uav: UAV id
        rows: received telemetry, by kind
        params: autopilot parameters
        card: the aircraft
        baseline: comparison model; None: the aircraft's own past
        past_end: end of that past [s since 1970]
        full: diagnose without a residual check
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
    """Result of one diagnosis job.

    Attributes:
        uav: UAV id
        begin, end: flight of the diagnosis [s since 1970]
        residual_growth: mean square of the recent residuals over the earlier ones, worst channel; nan if undetermined
        report: the diagnosis; None if the residuals did not require one
        effect_outputs: what the diagnosed effects add to the aircraft's dynamics, row by row
        refusal: reason for no diagnosis, or empty
        defect: internal error that ended the job without a result, or empty
        details: its traceback, for the log
        cpu_s: CPU time used [s]
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
    """Copy the telemetry for a diagnosis from `start` on [s since 1970], appended to the stored past."""
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
    """Return the result of a job that ended with an internal error."""
    return replace(_unanswered(job), failed=why, cpu_s=cpu_s, details=details)


def _unanswered(job: Job) -> Answer:
    t = job.rows["attitude"][0]
    return Answer(job.uav, float(t[0]) if len(t) else 0.0, float(t[-1]) if len(t) else 0.0)


def work(job: Job) -> Answer:
    """Check the recent residuals and diagnose if they grew; a `ValueError` becomes a refusal."""
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
        report = later(report, None, until)  # the newest seconds can be a climb: no permanent loss yet
    return replace(found, report=report, pushes=pushes(flight, base, report))


def growth(flight: Flight, base: Baseline) -> float:
    """Return the mean square of the recent residuals over the earlier ones, of the channel with the largest growth."""
    case = Case(flight, base)
    sight = Sight(case, own_weather(case))
    late = case.t > case.t[-1] - NEWEST_S
    now, before = sight.part(late), sight.part(~late)
    if min(now.ok.sum(), before.ok.sum()) < min(_LEAST_ROWS, 0.5 * NEWEST_S / STEP_S):
        return float("nan")
    size = [((x.e + x.Jn @ sight.xn)[x.ok] ** 2).mean(axis=0) for x in (now, before)]
    return float((size[0] / np.maximum(size[1], base.usual * 0.5)).max())
