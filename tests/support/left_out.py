"""Nominal flights, each diagnosed by a simulation calibrated on the others."""

from collections.abc import Iterator, Sequence

from twin_worker.diagnosis.baseline.calibrate import calibrate
from twin_worker.diagnosis.data.card import AircraftCard
from twin_worker.diagnosis.data.flight import FlightData
from twin_worker.diagnosis.inference.diagnose import diagnose
from twin_worker.diagnosis.inference.report import Report


def left_out(flights: Sequence[FlightData], card: AircraftCard) -> Iterator[Report]:
    """Diagnose every flight by the others."""
    for k, flight in enumerate(flights):
        yield diagnose(flight, calibrate([one for i, one in enumerate(flights) if i != k], card))
