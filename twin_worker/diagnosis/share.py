"""Diagnose recordings, or flights already read, in parallel processes."""

import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from twin_worker.diagnosis.baseline.hidden import concealed, deaf
from twin_worker.diagnosis.baseline.own_past import OwnPast
from twin_worker.diagnosis.data.flight import Flight, read_flights
from twin_worker.diagnosis.inference.diagnose import diagnose
from twin_worker.diagnosis.inference.report import Report
from twin_worker.diagnosis.model.baseline import Baseline

Say = Callable[[str], None]
Against = Baseline | OwnPast
Told = tuple[list[Report], str]  # reports of one task, and the error message or an empty string


def shared(
    tasks: Sequence[Path | Flight], against: Against, jobs: int, say: Say, conceal: Sequence[str] = ()
) -> Iterator[Told]:
    """Diagnose every recording or flight, in order; an error in one does not affect the others.

    Args:
        tasks: recordings, or flights
        reference: the calibrated simulation, or the past of each flight
        jobs: number of processes
        progress: callback for progress messages, used with one process only
        conceal: channels to conceal, of `hidden.NAMES`
    """
    if jobs == 1:
        yield from (_told(task, against, say, conceal) for task in tasks)
        return
    with multiprocessing.get_context("spawn").Pool(jobs, _begin, (against, conceal)) as pool:
        yield from pool.imap(_task, tasks)


_against: Against
_conceal: Sequence[str]


def _begin(against: Against, conceal: Sequence[str]) -> None:
    """Initialise a pool process; only the parent handles Ctrl-C."""
    global _against, _conceal
    _against, _conceal = against, conceal
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _task(task: Path | Flight) -> Told:
    return _told(task, _against, lambda word: None, _conceal)


def _told(task: Path | Flight, against: Against, say: Say, conceal: Sequence[str]) -> Told:
    reports: list[Report] = []
    try:
        for flight in [task] if isinstance(task, Flight) else read_flights(task, against.card):
            say(f"{flight.name}: {flight.seconds:.0f} s of flight")
            if isinstance(against, OwnPast):
                reports.append(against.diagnose(flight, say, conceal))
            else:
                reports.append(diagnose(concealed(flight, conceal, flight), deaf(against, conceal), say))
    except (ValueError, OSError) as error:
        return reports, str(error)
    return reports, ""
