"""Distribute the aircraft of recordings over processes, and show progress."""

import multiprocessing
import signal
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from fleet.report.progress import shown
from fleet.telemetry.recording.recordings import Recording
from twin_worker.evaluation.drive import Drive, Plan
from twin_worker.evaluation.scoring.case import Case

Task = tuple[Sequence[Path], Plan, int, tuple[int, int]]  # files, plan, offset, number of this process of how many


@dataclass
class Progress:
    """Progress of one recording."""

    name: str
    shares: Any  # progress of each process, 0..1
    at: slice = field(default_factory=lambda: slice(None))

    @property
    def share(self) -> float:
        """Return the progress of the slowest process, 0..1."""
        return float(min(self.shares[self.at]))

    def words(self) -> str:
        """Return the activity."""
        return "assessed" if self.share >= 1.0 else "assessing"


@dataclass(frozen=True)
class Found:
    """Result of an evaluation.

    Attributes:
        cases: evaluated starts, in the order of files
        missed: intervals without any prediction
        sentences: warnings of the readers
    """

    cases: list[Case]
    silent: int
    sentences: list[str]


def assess(files: Sequence[Path], plan: Plan, *, jobs: int = 1, offset: int = 0, say: Any = print) -> Found:
    """Evaluate the twins on recordings.

    Args:
        files: recordings
        plan: settings
        jobs: processes; each reads every file and evaluates its share of the aircraft
        offset: UAV id = MAVLink system id + this
        report: prints a line of progress where there is no terminal
    Raises:
        ValueError: when a file is not a recording.
    """
    context = multiprocessing.get_context("spawn")
    shares = context.Array("d", len(files) * jobs)
    bars = [Progress(path.name, shares, slice(k * jobs, (k + 1) * jobs)) for k, path in enumerate(files)]
    tasks: list[Task] = [(files, plan, offset, (k, jobs)) for k in range(jobs)]
    with shown(bars, say, Console(stderr=True), leave=False):
        if jobs == 1:
            parts = [_part(tasks[0], shares)]
        else:
            with context.Pool(jobs, _begin, (shares,)) as pool:
                parts = pool.map(_task, tasks, chunksize=1)
    order = {name: k for k, name in enumerate(names(files))}
    found = [case for part in parts for case in part.cases]
    cases = sorted(found, key=lambda case: (order[case.asked.flight.rpartition(":")[0]], case.asked.uav))
    return Found(cases, sum(part.silent for part in parts), parts[0].sentences)


_shares: Any = None


def _begin(shares: Any) -> None:
    """Initialise a process of the pool; it ignores Ctrl-C, which the parent handles."""
    global _shares
    _shares = shares
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _task(task: Task) -> Found:
    return _part(task, _shares)


def _part(task: Task, shares: Any) -> Found:
    """Evaluate this process's share of the aircraft, numbered in order of appearance."""
    files, plan, offset, mine = task
    k, jobs = mine
    cases: list[Case] = []
    silent, sentences, before = 0, [], 0
    for number, (path, name) in enumerate(zip(files, names(files), strict=True)):
        recording = Recording(path, offset)
        drive = Drive(name, plan, partial(_is_mine, before, mine))
        cases += drive.run(_messages(recording, shares, number * jobs + k))
        shares[number * jobs + k] = 1.0
        before += len(drive.examined)
        silent += drive.silent
        sentences += recording.skipped
    return Found(cases, silent, sentences)


def _is_mine(before: int, mine: tuple[int, int], number: int) -> bool:
    return (before + number) % mine[1] == mine[0]


def names(files: Sequence[Path]) -> list[str]:
    """Return the names of recordings: the file name, or the path where file names are equal."""
    often = Counter(path.name for path in set(files))
    return [path.name if often[path.name] == 1 else str(path) for path in files]


def _messages(recording: Recording, shares: Any, at: int) -> Iterator[Any]:
    for _, news in recording.steps():
        shares[at] = min(recording.share, 0.999)
        yield from news
