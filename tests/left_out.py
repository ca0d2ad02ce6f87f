"""Nominal flights, each diagnosed by a simulation calibrated on the others; two processes."""

import multiprocessing
from collections.abc import Sequence

from twin_worker.diagnose.calibrate import calibrate
from twin_worker.diagnose.card import Card
from twin_worker.diagnose.diagnose import diagnose
from twin_worker.diagnose.flight import Flight
from twin_worker.diagnose.report import Report


def left_out(flights: Sequence[Flight], card: Card) -> list[Report]:
    """Diagnose every flight by the others."""
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        return pool.map(_one, [(flights, card, k) for k in range(len(flights))], chunksize=1)


def _one(task: tuple[Sequence[Flight], Card, int]) -> Report:
    flights, card, k = task
    return diagnose(flights[k], calibrate([flight for i, flight in enumerate(flights) if i != k], card))
