"""All faults of one aircraft, in the four places where the aircraft asks for them."""

from collections.abc import Sequence

import numpy as np

from fleet.pretend.faults.fault import Fault
from fleet.pretend.faults.oddities import ODD
from fleet.pretend.faults.physics import CHANGES, WINDS, World
from fleet.pretend.faults.sensing import SPOILS, Senses
from fleet.pretend.faults.servos import MOVES, Commands, Linkage
from fleet.pretend.jsbsim import Aircraft
from fleet.pretend.sensors import Estimate


class Carried:
    """The faults one aircraft carries."""

    def __init__(self, faults: Sequence[Fault], aircraft: Aircraft, tick_s: float, sense_s: float):
        """Give every fault its place.

        Args:
            faults: what is wrong
            aircraft: started
            tick_s: time between two calls of `move` [s]
            sense_s: time between two calls of `sense` [s]
        """
        self._linkage = Linkage([fault for fault in faults if fault.name in MOVES], tick_s)
        self._senses = Senses([fault for fault in faults if fault.name in SPOILS], sense_s)
        self._odd = [(fault, ODD[fault.name](fault.values, aircraft)) for fault in faults if fault.name in ODD]
        self._world = World([fault for fault in faults if fault.name in CHANGES or fault.name in WINDS], aircraft)

    def press(self, t: float) -> None:
        """Change the physics."""
        self._world.press(t)
        for fault, oddity in self._odd:
            oddity.press(t, fault.share(t))

    def wind(self, t: float, height: float) -> np.ndarray:
        """Give the wind added, NED, (3,) [m/s]."""
        return self._world.wind(t, height)

    def sense(self, t: float, e: Estimate) -> Estimate:
        """Give what the autopilot believes."""
        e = self._senses.sense(t, e)
        for fault, oddity in self._odd:
            e = oddity.sense(e, fault.share(t))
        return e

    def move(self, t: float, commands: Commands) -> Commands:
        """Give where surfaces and motor go."""
        commands = self._linkage.move(t, commands)
        for fault, oddity in self._odd:
            commands = oddity.move(t, fault.share(t), commands)
        return commands
