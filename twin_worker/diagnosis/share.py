"""Diagnose recordings, or flights already read, in parallel processes."""

import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from fleet.telemetry.recording.options import RecordingOptions
from twin_worker.diagnosis.baseline.own_past import OwnPast, conceal_channels, exclude_concealed
from twin_worker.diagnosis.data.flight import FlightData, read_flights
from twin_worker.diagnosis.inference.diagnose import diagnose
from twin_worker.diagnosis.inference.report import Report
from twin_worker.diagnosis.model.baseline import Baseline

ReportProgress = Callable[[str], None]
Reference = Baseline | OwnPast


class RecordingTask(NamedTuple):
    """One recording to diagnose, with the data that it lacks."""

    path: Path
    options: RecordingOptions


TaskResult = tuple[list[Report], str]  # reports of one task, and the error message or an empty string


def diagnose_all(
    tasks: Sequence[Path | RecordingTask | FlightData],
    reference: Reference,
    jobs: int,
    progress: ReportProgress,
    conceal: Sequence[str] = (),
) -> Iterator[TaskResult]:
    """Diagnose every recording or flight, in order; an error in one does not affect the others.

    Args:
        tasks: recordings, or flights
        reference: the calibrated simulation, or the past of each flight
        jobs: number of processes
        progress: callback for progress messages, used with one process only
        conceal: channels to conceal, of `hidden.NAMES`
    """
    if jobs == 1:
        yield from (_diagnose_task(task, reference, progress, conceal) for task in tasks)
        return
    with multiprocessing.get_context("spawn").Pool(jobs, _init_worker, (reference, conceal)) as pool:
        yield from pool.imap(_task, tasks)


_reference: Reference
_conceal: Sequence[str]


def _init_worker(reference: Reference, conceal: Sequence[str]) -> None:
    """Initialise a pool process; only the parent handles Ctrl-C."""
    global _reference, _conceal
    _reference, _conceal = reference, conceal
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _task(task: Path | RecordingTask | FlightData) -> TaskResult:
    return _diagnose_task(task, _reference, lambda message: None, _conceal)


def _diagnose_task(
    task: Path | RecordingTask | FlightData, reference: Reference, progress: ReportProgress, conceal: Sequence[str]
) -> TaskResult:
    reports: list[Report] = []
    try:
        for flight in _flights_of(task, reference):
            progress(f"{flight.name}: {flight.seconds:.0f} s of flight")
            if isinstance(reference, OwnPast):
                reports.append(reference.diagnose(flight, progress, conceal))
            else:
                reports.append(
                    diagnose(conceal_channels(flight, conceal, flight), exclude_concealed(reference, conceal), progress)
                )
    except (ValueError, OSError) as error:
        return reports, str(error)
    return reports, ""


def _flights_of(task: Path | RecordingTask | FlightData, reference: Reference) -> list[FlightData]:
    if isinstance(task, FlightData):
        return [task]
    if isinstance(task, RecordingTask):
        return read_flights(task.path, reference.card, task.options)
    return read_flights(task, reference.card)
