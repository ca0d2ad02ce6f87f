"""Multirotors of a recording, and the reports of each: from the rotor model, or from control alone."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from fleet.contract import Params, Sample, Status
from fleet.telemetry.recording.options import NO_OPTIONS, RecordingOptions
from fleet.telemetry.recording.recordings import replay_messages
from fleet.vehicles import vehicle_class
from twin_worker.diagnosis.inference.report import Report
from twin_worker.diagnosis.multirotor.baseline import RotorBaseline, calibrate_rotors
from twin_worker.diagnosis.multirotor.control_loss import find_control_loss, unjudged
from twin_worker.diagnosis.multirotor.diagnose import diagnose_rotors, loss_report
from twin_worker.diagnosis.multirotor.flight import RotorFlight, rotor_flight
from twin_worker.diagnosis.multirotor.search import nominal_gains
from twin_worker.telemetry.history import TelemetryHistory


@dataclass
class RotorRecording:
    """Telemetry and parameters of one multirotor as recorded."""

    name: str
    history: TelemetryHistory = field(default_factory=lambda: TelemetryHistory(keep_s=np.inf))
    params: dict[str, float] = field(default_factory=dict)

    def flight(self) -> RotorFlight:
        """Return the flight on the grid.

        Raises:
            ValueError: if required telemetry is missing; the message names it.
        """
        return rotor_flight(self.name, self.history, self.params)


def holds_rotorcraft(path: Path, options: RecordingOptions = NO_OPTIONS) -> bool:
    """Return whether the first aircraft whose type is reported flies on rotors only."""
    for message in replay_messages(path, options=options):
        if isinstance(message, Status) and message.vehicle != "unknown":
            return vehicle_class(message.vehicle).is_rotorcraft
    return False


def read_rotorcraft(path: Path, options: RecordingOptions = NO_OPTIONS) -> list[RotorRecording]:
    """Read every multirotor of a recording.

    Raises:
        ValueError: if there is none.
    """
    recordings: dict[int, RotorRecording] = {}
    rotors: set[int] = set()
    stem = path.name.split(".")[0]
    for message in replay_messages(path, options=options):
        one = recordings.setdefault(message.uav, RotorRecording(f"{stem}-uav{message.uav}"))
        if isinstance(message, Sample):
            one.history.add(message)
        elif isinstance(message, Params):
            one.params.update(message.values)
        elif isinstance(message, Status) and vehicle_class(message.vehicle).is_rotorcraft:
            rotors.add(message.uav)
    rotorcraft = [one for uav, one in sorted(recordings.items()) if uav in rotors]
    if not rotorcraft:
        raise ValueError(f"{stem}: found no multirotor, expected one; use a model of its own vehicle class")
    return [replace(one, name=stem) for one in rotorcraft] if len(recordings) == 1 else rotorcraft


def calibrate_multirotor(
    files: Sequence[Path], log: Callable[[str], None], until: float = np.inf, options: RecordingOptions = NO_OPTIONS
) -> RotorBaseline:
    """Calibrate on recordings, or on the part of each before `until` [s, on its own clock].

    Raises:
        ValueError: if a recording has no usable flight.
    """
    flights = []
    for path in files:
        log(f"reading {path.name}")
        flights += [before(one.flight(), until) for one in read_rotorcraft(path, options)]
    return calibrate_rotors(flights, log, nominal_gains)


def before(flight: RotorFlight, until: float) -> RotorFlight:
    """Return the flight with only the rows before `until` [s].

    Raises:
        ValueError: if too few rows remain.
    """
    part = replace(flight, ok=flight.ok & (flight.t < until))
    if part.seconds < _MIN_PAST_S:
        raise ValueError(
            f"{flight.name}: found {part.seconds:.0f} s in the air before {until:.0f} s, expected {_MIN_PAST_S:.0f} s; "
            "name a later time"
        )
    return part


_MIN_PAST_S = 30.0


def diagnose_recording(
    recording: RotorRecording, reference: RotorBaseline | float, log: Callable[[str], None]
) -> Report:
    """Diagnose one multirotor.

    Loss of control comes first: after it, the rotor model does not apply. Without it, and with telemetry too slow for
    the rotor model, the report states what was judged.

    Args:
        recording: as read
        reference: calibrated model, or the end of its own past [s]
        log: receives progress
    """
    if (loss := find_control_loss(recording.history, recording.params)) is not None:
        return loss_report(recording.name, loss)
    reason = unjudged(recording.history, recording.params)
    try:
        flight = recording.flight()
    except ValueError as error:
        if reason:
            raise ValueError(f"{error}; control is not judged either: {reason}") from None
        return loss_report(recording.name, None, (str(error).split(": ", 1)[-1],))
    if not isinstance(reference, RotorBaseline):
        reference = calibrate_rotors([before(flight, reference)], log, nominal_gains)
    return diagnose_rotors(flight, reference)
