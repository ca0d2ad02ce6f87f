"""Conceal channels of a flight before it is diagnosed: what would give an answer away is compared afterwards."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from twin_worker.diagnosis.data.flight import Flight
from twin_worker.diagnosis.model.baseline import Baseline, silenced

_READINGS = {
    "airspeed": ("Va",),
    "imu": ("a_x", "a_y", "a_z"),
    "pressure": ("baro",),
    "gnss": ("gnss",),
    "wind": (),  # the estimator's wind and a battery's state are nowhere read: concealing them changes nothing
    "battery": (),
}
_COMMANDS = {"aileron": 0, "elevator": 1, "rudder": 2, "throttle": 3}
NAMES = (*_READINGS, *_COMMANDS)
"""What may be concealed."""


_EQUATION = {"aileron": "L", "elevator": "M", "rudder": "N", "throttle": "X"}


def check(names: Iterable[str]) -> None:
    """Refuse names of channels there are none of.

    Raises:
        ValueError: the sentence lists those there are.
    """
    if strange := [name for name in names if name not in NAMES]:
        raise ValueError(f"--conceal: found {strange[0]!r}, expected some of {', '.join(NAMES)}; name those")


def concealed(flight: Flight, names: Sequence[str], usual: Flight) -> Flight:
    """Return a flight without some channels; an unknown command stands where it usually stood in `usual`."""
    if not names:
        return flight
    gone = {reading for name in names for reading in _READINGS.get(name, ())}
    readings = {name: x for name, x in flight.readings.items() if name not in gone}
    commands = flight.commands.copy()
    for column in (_COMMANDS[name] for name in names if name in _COMMANDS):
        commands[:, column] = np.median(usual.commands[usual.ok, column])
    lacks = (f"concealed: {', '.join(names)}", *flight.lacks)
    return replace(flight, readings=readings, commands=commands, lacks=lacks)


def deaf(base: Baseline, names: Iterable[str]) -> Baseline:
    """Return a baseline that does not judge axes whose commands are concealed: it cannot tell what they should do."""
    return silenced(base, [_EQUATION[name] for name in names if name in _EQUATION])
