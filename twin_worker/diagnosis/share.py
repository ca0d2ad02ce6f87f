"""Diagnose recordings, or flights already read, in parallel processes."""

import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fleet.report.detection_limits import find_source, load_table, report_sentences
from fleet.telemetry.recording.options import NO_OPTIONS, RecordingOptions
from twin_worker.diagnosis.baseline.own_past import OwnPast, conceal_channels, exclude_concealed, with_output_faults
from twin_worker.diagnosis.data.flight import FlightData, read_flights
from twin_worker.diagnosis.inference.diagnose import diagnose
from twin_worker.diagnosis.inference.report import Report, ReportOutcome
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.diagnosis.multirotor.baseline import RotorBaseline
from twin_worker.diagnosis.multirotor.recordings import diagnose_recording, holds_rotorcraft, read_rotorcraft

ReportProgress = Callable[[str], None]
Reference = Baseline | RotorBaseline | OwnPast


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
    diagnose_task = partial(_diagnose_task, reference=reference, conceal=conceal)
    if jobs == 1:
        yield from (diagnose_task(task, progress=progress) for task in tasks)
        return
    # only the parent handles Ctrl-C
    with multiprocessing.get_context("spawn").Pool(jobs, signal.signal, (signal.SIGINT, signal.SIG_IGN)) as pool:
        yield from pool.imap(diagnose_task, tasks)


def _diagnose_task(
    task: Path | RecordingTask | FlightData,
    reference: Reference,
    conceal: Sequence[str],
    progress: ReportProgress = lambda message: None,
) -> TaskResult:
    reports: list[Report] = []
    try:
        if isinstance(reference, RotorBaseline) or _is_multirotor(task, reference):
            return _diagnose_rotors(task, reference, conceal, progress), ""
        assert not isinstance(reference, RotorBaseline)
        for flight in _flights_of(task, reference):
            progress(f"{flight.name}: {flight.seconds:.0f} s of flight")
            if isinstance(reference, OwnPast):
                report = reference.diagnose(flight, progress, conceal)
            else:
                visible = conceal_channels(flight, conceal, flight)
                report = diagnose(visible, exclude_concealed(reference, conceal), progress)
                report = with_output_faults(report, visible)
            reports.append(with_detection_limits(report, flight, reference))
    except (ValueError, OSError) as error:
        return reports, str(error)
    return reports, ""


def _is_multirotor(task: Path | RecordingTask | FlightData, reference: Reference) -> bool:
    """Return whether a task with its own past as reference is a recording of a multirotor."""
    if isinstance(task, FlightData) or not isinstance(reference, OwnPast):
        return False
    recording = task if isinstance(task, RecordingTask) else RecordingTask(task, NO_OPTIONS)
    return holds_rotorcraft(recording.path, recording.options)


def _diagnose_rotors(
    task: Path | RecordingTask | FlightData, reference: Reference, conceal: Sequence[str], progress: ReportProgress
) -> list[Report]:
    """Diagnose every multirotor of a recording.

    Raises:
        ValueError: if the recording has no usable multirotor, or channels are to be concealed.
    """
    if isinstance(task, FlightData) or isinstance(reference, Baseline):
        raise TypeError("found flight data of a fixed wing, expected a recording of a multirotor")
    if conceal:
        raise ValueError(f"--conceal: found {conceal[0]!r} for a multirotor, expected none; leave it out")
    recording = task if isinstance(task, RecordingTask) else RecordingTask(task, NO_OPTIONS)
    past = reference if isinstance(reference, RotorBaseline) else reference.until
    return [diagnose_recording(one, past, progress) for one in read_rotorcraft(recording.path, recording.options)]


def with_detection_limits(report: Report, flight: FlightData, reference: Baseline | OwnPast) -> Report:
    """Return the report with the limits of detection measured on the nearest aircraft with such telemetry."""
    own_past = isinstance(reference, OwnPast)
    vane = flight.vane if isinstance(reference, OwnPast) else reference.vane
    speed = float(np.median(np.hypot(flight.readings["v_n"], flight.readings["v_e"])[flight.ok]))
    named = [finding.hypothesis.effect.name for finding in report.findings if report.outcome is ReportOutcome.NAMED]
    source = find_source(load_table(), vane, own_past, speed)
    return replace(report, detection_limits=report_sentences(source, named))


def _flights_of(task: Path | RecordingTask | FlightData, reference: Baseline | OwnPast) -> list[FlightData]:
    if isinstance(task, FlightData):
        return [task]
    if isinstance(task, RecordingTask):
        return read_flights(task.path, reference.card, task.options)
    return read_flights(task, reference.card)
