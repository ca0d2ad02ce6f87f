"""Share recordings, or flights already read, among processes."""

import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from twin_worker.diagnose.baseline import Baseline
from twin_worker.diagnose.diagnose import diagnose
from twin_worker.diagnose.flight import Flight, read_flights
from twin_worker.diagnose.report import Report

Say = Callable[[str], None]
Told = tuple[list[Report], str]  # of one task: its flights' reports, and why it was refused, or empty


def shared(tasks: Sequence[Path | Flight], base: Baseline, jobs: int, say: Say) -> Iterator[Told]:
    """Diagnose every recording or flight, in order; one that is refused loses no other.

    Args:
        tasks: recordings, or flights
        base: the calibrated simulation
        jobs: processes
        say: takes words of progress, where there is one process
    """
    if jobs == 1:
        yield from (_told(task, base, say) for task in tasks)
        return
    with multiprocessing.get_context("spawn").Pool(jobs, _begin, (base,)) as pool:
        yield from pool.imap(_task, tasks)


_base: Baseline


def _begin(base: Baseline) -> None:
    """Begin a process of the pool: Ctrl-C is the parent's business."""
    global _base
    _base = base
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _task(task: Path | Flight) -> Told:
    return _told(task, _base, lambda word: None)


def _told(task: Path | Flight, base: Baseline, say: Say) -> Told:
    reports: list[Report] = []
    try:
        for flight in [task] if isinstance(task, Flight) else read_flights(task, base.card):
            say(f"{flight.name}: {flight.seconds:.0f} s of flight")
            reports.append(diagnose(flight, base, say))
    except (ValueError, OSError) as error:
        return reports, str(error)
    return reports, ""
