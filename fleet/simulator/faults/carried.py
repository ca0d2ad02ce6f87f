"""All faults of one aircraft, in the four places where the aircraft asks for them."""

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
    """The faults one aircraft carries."""

    def __init__(self, faults: Sequence[Fault], aircraft: Aircraft, tick_s: float, sense_s: float):
        """Return every fault its place.

        Args:
            faults: what is wrong
            aircraft: started
            tick_s: time between two calls of `move` [s]
            sense_s: time between two calls of `sense` [s]
        """
        self.faults = faults
        odd = [(fault, ODD[fault.name](fault.values, aircraft)) for fault in faults if fault.name in ODD]
        self._presses = [(fault, oddity.press) for fault, oddity in odd]
        self._moves = [(f, _one(f, MOVES[f.name](f.values, tick_s))) for f in faults if f.name in MOVES]
        self._moves += [(fault, oddity.move) for fault, oddity in odd]
        self._spoils = [(fault, SPOILS[fault.name](fault, sense_s)) for fault in faults if fault.name in SPOILS]
        self._spoils += [(fault, oddity.sense) for fault, oddity in odd]
        self._world = World([fault for fault in faults if fault.name in CHANGES or fault.name in WINDS], aircraft)
        self.moved = {fault: np.zeros(4) for fault in faults}  # what each last did to the commands
        self.spoilt = {fault: np.zeros(14) for fault in faults}  # and to the estimate, see `numbers`

    def press(self, t: float, without: Fault | None = None) -> None:
        """Change the physics, by all faults or by all but one."""
        self._world.press(t, without)
        for fault, press in self._presses:
            press(t, 0.0 if fault is without else fault.share(t))

    def wind(self, t: float, height: float) -> np.ndarray:
        """Return the wind added, NED, (3,) [m/s]."""
        return self._world.wind(t, height)

    def sense(self, t: float, e: Estimate) -> Estimate:
        """Return what the autopilot believes."""
        for fault, spoil in self._spoils:
            good, e = e, spoil(e, fault.share(t))
            self.spoilt[fault] = numbers(e) - numbers(good)
        return e

    def move(self, t: float, commands: Commands) -> Commands:
        """Return where surfaces and motor go."""
        for fault, move in self._moves:
            told, commands = commands, move(t, fault.share(t), commands)
            self.moved[fault] = np.subtract(commands, told)
        return commands


def numbers(e: Estimate) -> np.ndarray:
    """Lay out rates, force, euler, v, Va and height, (14,)."""
    return np.concatenate([e.rates, e.force, e.euler, e.v, [e.Va, -e.p[2]]])


def _one(fault: Fault, move: Move) -> Callable[[float, float, Commands], Commands]:
    """Let a servo's fault act on its own surface."""
    i = SURFACES.index(fault.of)

    def moved(t: float, share: float, commands: Commands) -> Commands:
        deltas = list(commands)
        deltas[i] = move(deltas[i], share)
        return deltas[0], deltas[1], deltas[2], deltas[3]

    return moved
