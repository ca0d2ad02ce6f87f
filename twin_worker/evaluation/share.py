"""Distribute the aircraft of recordings over processes, and show progress."""

import multiprocessing
import signal
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console

from fleet.report.progress import show_progress
from fleet.telemetry.recording.recordings import Recording
from twin_worker.evaluation.drive import EvaluationPlan, RecordingDriver
from twin_worker.evaluation.scoring.log import EvaluationCase

# files, plan, offset, number of this process of how many
Task = tuple[Sequence[Path], EvaluationPlan, int, tuple[int, int]]


@dataclass
class Progress:
    """Progress of one recording."""

    name: str
    shares: Any  # progress of each process on each recording, 0..1
    processes: slice

    @property
    def share(self) -> float:
        """Return the progress of the slowest process, 0..1."""
        return float(min(self.shares[self.processes]))

    def progress_text(self) -> str:
        """Return the activity."""
        return "assessed" if self.share >= 1.0 else "assessing"


@dataclass(frozen=True)
class Evaluation:
    """Result of an evaluation.

    Attributes:
        cases: evaluated starts, in the order of files
        missed: intervals without any prediction
        sentences: warnings of the readers
        refused: reason for each recording that could not be read
    """

    cases: list[EvaluationCase]
    missed: int
    sentences: list[str]
    refused: list[str] = field(default_factory=list)


def assess_recordings(
    files: Sequence[Path], plan: EvaluationPlan, *, jobs: int = 1, offset: int = 0, report: Any = print
) -> Evaluation:
    """Evaluate the twins on recordings.

    Args:
        files: recordings
        plan: settings
        jobs: processes; each reads every file and evaluates its share of the aircraft
        offset: UAV id = MAVLink system id + this
        report: prints a line of progress where there is no terminal
    Raises:
        ValueError: when no file is a recording; the text has every reason.
    """
    context = multiprocessing.get_context("spawn")
    shares = context.Array("d", len(files) * jobs)
    recordings = [Progress(path.name, shares, slice(k * jobs, (k + 1) * jobs)) for k, path in enumerate(files)]
    tasks: list[Task] = [(files, plan, offset, (k, jobs)) for k in range(jobs)]
    with show_progress(recordings, report, Console(stderr=True), leave=False):
        if jobs == 1:
            evaluations = [_evaluate_share(tasks[0], shares)]
        else:
            with context.Pool(jobs, _init_process, (shares,)) as pool:
                evaluations = pool.map(_task, tasks, chunksize=1)
    order = {name: k for k, name in enumerate(recording_names(files))}
    unsorted_cases = [case for evaluation in evaluations for case in evaluation.cases]
    cases = sorted(unsorted_cases, key=lambda case: (order[case.start.flight.rpartition(":")[0]], case.start.uav))
    return Evaluation(cases, sum(part.missed for part in evaluations), *_texts(evaluations[0], files))


def _texts(first: Evaluation, files: Sequence[Path]) -> tuple[list[str], list[str]]:
    """Return warnings and refusals, the same in every process."""
    if len(first.refused) == len(files):
        raise ValueError("; ".join(first.refused))
    return first.sentences, first.refused


_shares: Any = None


def _init_process(shares: Any) -> None:
    """Initialise a process of the pool; it ignores Ctrl-C, which the parent handles."""
    global _shares
    _shares = shares
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _task(task: Task) -> Evaluation:
    return _evaluate_share(task, _shares)


def _evaluate_share(task: Task, shares: Any) -> Evaluation:
    """Evaluate this process's share of the aircraft, numbered in order of appearance."""
    files, plan, offset, (k, jobs) = task
    cases: list[EvaluationCase] = []
    missed, sentences, refused, uav_count = 0, list[str](), list[str](), 0
    for number, (path, name) in enumerate(zip(files, recording_names(files), strict=True)):
        try:
            recording = Recording(path, offset, plan.options)
            drive = RecordingDriver(name, plan, (uav_count, k, jobs))
            cases += drive.run(_messages(recording, shares, number * jobs + k))
        except (ValueError, OSError) as error:
            refused.append(str(error))
            shares[number * jobs + k] = 1.0
            continue
        shares[number * jobs + k] = 1.0
        uav_count += len(drive.uavs)
        missed += drive.missed
        sentences += recording.skipped
    return Evaluation(cases, missed, sentences, refused)


def recording_names(files: Sequence[Path]) -> list[str]:
    """Return the names of recordings: the file name, or the path where file names are equal."""
    counts = Counter(path.name for path in set(files))
    return [path.name if counts[path.name] == 1 else str(path) for path in files]


def _messages(recording: Recording, shares: Any, slot: int) -> Iterator[Any]:
    for _, messages in recording.steps():
        shares[slot] = min(recording.share, 0.999)
        yield from messages
