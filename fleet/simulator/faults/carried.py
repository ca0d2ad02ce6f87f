"""All faults of one aircraft: physics, wind, estimate and commands."""

from collections.abc import Callable, Sequence

import numpy as np

from fleet.simulator.faults.fault import Fault
from fleet.simulator.faults.oddities import ODD
from fleet.simulator.faults.physics import CHANGES, WINDS, World
from fleet.simulator.faults.sensing import SPOILS
from fleet.simulator.faults.servos import MOVES, SURFACES, Commands, Move
from fleet.simulator.vehicle.jsbsim import Aircraft
from fleet.simulator.vehicle.sensors import Estimate


class Carried:
    """Faults of one aircraft."""

    def __init__(self, faults: Sequence[Fault], aircraft: Aircraft, tick_s: float, sense_s: float):
        """Assign each fault to physics, wind, estimate or commands.

        Args:
            faults: faults of the aircraft
            aircraft: started
            tick_s: time between two calls of `apply_to_commands` [s]
            estimate_s: time between two calls of `apply_to_estimate` [s]
        """
        self.faults = faults
        odd = [(fault, ODD[fault.name](fault.values, aircraft)) for fault in faults if fault.name in ODD]
        self._presses = [(fault, oddity.press) for fault, oddity in odd]
        self._moves = [(f, _one(f, MOVES[f.name](f.values, tick_s))) for f in faults if f.name in MOVES]
        self._moves += [(fault, oddity.move) for fault, oddity in odd]
        self._spoils = [(fault, SPOILS[fault.name](fault, sense_s)) for fault in faults if fault.name in SPOILS]
        self._spoils += [(fault, oddity.sense) for fault, oddity in odd]
        self._world = World([fault for fault in faults if fault.name in CHANGES or fault.name in WINDS], aircraft)
        self.moved = {fault: np.zeros(4) for fault in faults}  # last change of the commands by each fault
        self.spoilt = {fault: np.zeros(14) for fault in faults}  # last change of the estimate, see `estimate_vector`

    def press(self, t: float, without: Fault | None = None) -> None:
        """Apply the physics faults, all or all but one."""
        self._world.press(t, without)
        for fault, press in self._presses:
            press(t, 0.0 if fault is without else fault.share(t))

    def wind(self, t: float, height: float) -> np.ndarray:
        """Return the wind added, NED, (3,) [m/s]."""
        return self._world.wind(t, height)

    def sense(self, t: float, e: Estimate) -> Estimate:
        """Return the estimate with sensor faults."""
        for fault, spoil in self._spoils:
            good, e = e, spoil(e, fault.share(t))
            self.spoilt[fault] = numbers(e) - numbers(good)
        return e

    def move(self, t: float, commands: Commands) -> Commands:
        """Return surface and motor positions with servo faults."""
        for fault, move in self._moves:
            told, commands = commands, move(t, fault.share(t), commands)
            self.moved[fault] = np.subtract(commands, told)
        return commands


def numbers(e: Estimate) -> np.ndarray:
    """Return rates, force, euler, v, Va and height as one vector, (14,)."""
    return np.concatenate([e.rates, e.force, e.euler, e.v, [e.Va, -e.p[2]]])


def _one(fault: Fault, move: Move) -> Callable[[float, float, Commands], Commands]:
    """Apply a servo fault to its surface only."""
    i = SURFACES.index(fault.of)

    def moved(t: float, share: float, commands: Commands) -> Commands:
        deltas = list(commands)
        deltas[i] = move(deltas[i], share)
        return deltas[0], deltas[1], deltas[2], deltas[3]

    return moved
