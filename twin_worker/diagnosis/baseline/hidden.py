"""Conceal channels of a flight before its diagnosis, to test the diagnosis without them."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from twin_worker.diagnosis.data.flight import FlightData
from twin_worker.diagnosis.model.baseline import Baseline, exclude_equations

_READINGS = {
    "airspeed": ("Va",),
    "imu": ("a_x", "a_y", "a_z"),
    "pressure": ("baro",),
    "gnss": ("gnss",),
    "wind": (),  # not read: the diagnosis uses neither the estimated wind nor the battery state
    "battery": (),
}
_COMMANDS = {"aileron": 0, "elevator": 1, "rudder": 2, "throttle": 3}
NAMES = (*_READINGS, *_COMMANDS)
"""Channels that can be concealed."""

_EQUATION = {"aileron": "L", "elevator": "M", "rudder": "N", "throttle": "X"}


def check(names: Iterable[str]) -> None:
    """Reject unknown channel names.

    Raises:
        ValueError: if a name is unknown; the message lists the valid names.
    """
    if unknown := [name for name in names if name not in NAMES]:
        raise ValueError(f"--conceal: found {unknown[0]!r}, expected names of {', '.join(NAMES)}; correct it")


def conceal_channels(flight: FlightData, names: Sequence[str], typical: FlightData) -> FlightData:
    """Return a flight without some channels; a concealed command is replaced by its median in `typical`."""
    if not names:
        return flight
    removed = {reading for name in names for reading in _READINGS.get(name, ())}
    readings = {name: x for name, x in flight.readings.items() if name not in removed}
    commands = flight.commands.copy()
    for column in (_COMMANDS[name] for name in names if name in _COMMANDS):
        commands[:, column] = np.median(typical.commands[typical.ok, column])
    limitations = (f"concealed: {', '.join(names)}", *flight.limitations)
    return replace(flight, readings=readings, commands=commands, limitations=limitations)


def exclude_concealed(base: Baseline, names: Iterable[str]) -> Baseline:
    """Return a baseline that ignores the axes whose commands are concealed."""
    return exclude_equations(base, [_EQUATION[name] for name in names if name in _EQUATION])
