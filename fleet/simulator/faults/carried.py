"""All faults of one aircraft: physics, wind, estimate and commands."""

from collections.abc import Callable, Sequence

import numpy as np

from fleet.simulator.faults.fault import Fault
from fleet.simulator.faults.oddities import UNCATALOGUED
from fleet.simulator.faults.physics import PHYSICS_FAULTS, WIND_FAULTS, FaultyPhysics
from fleet.simulator.faults.sensing import SENSOR_FAULTS
from fleet.simulator.faults.servos import SERVO_FAULTS, SURFACES, Commands, ServoFault
from fleet.simulator.vehicle.jsbsim import Aircraft
from fleet.simulator.vehicle.sensors import Estimate


class FaultSet:
    """Faults of one aircraft."""

    def __init__(self, faults: Sequence[Fault], aircraft: Aircraft, tick_s: float, estimate_s: float):
        """Assign each fault to physics, wind, estimate or commands.

        Args:
            faults: faults of the aircraft
            aircraft: started
            tick_s: time between two calls of `apply_to_commands` [s]
            estimate_s: time between two calls of `apply_to_estimate` [s]
        """
        self.faults = faults
        uncatalogued = [
            (fault, UNCATALOGUED[fault.name](fault.values, aircraft)) for fault in faults if fault.name in UNCATALOGUED
        ]
        self._physics_functions = [(fault, oddity.apply_to_physics) for fault, oddity in uncatalogued]
        self._servo_functions = [
            (f, _on_one_surface(f, SERVO_FAULTS[f.name](f.values, tick_s))) for f in faults if f.name in SERVO_FAULTS
        ]
        self._servo_functions += [(fault, oddity.apply_to_commands) for fault, oddity in uncatalogued]
        self._sensor_functions = [
            (fault, SENSOR_FAULTS[fault.name](fault, estimate_s)) for fault in faults if fault.name in SENSOR_FAULTS
        ]
        self._sensor_functions += [(fault, oddity.apply_to_estimate) for fault, oddity in uncatalogued]
        self._physics = FaultyPhysics(
            [fault for fault in faults if fault.name in PHYSICS_FAULTS or fault.name in WIND_FAULTS], aircraft
        )
        self.command_changes = {fault: np.zeros(4) for fault in faults}  # last change of the commands by each fault
        self.estimate_changes = {
            fault: np.zeros(14) for fault in faults
        }  # last change of the estimate, see `estimate_vector`

    def apply_to_physics(self, t: float, excluding: Fault | None = None) -> None:
        """Apply the physics faults, all or all but one."""
        self._physics.apply(t, excluding)
        for fault, apply in self._physics_functions:
            apply(t, 0.0 if fault is excluding else fault.intensity(t))

    def wind(self, t: float, height: float) -> np.ndarray:
        """Return the wind added, NED, (3,) [m/s]."""
        return self._physics.wind(t, height)

    def apply_to_estimate(self, t: float, e: Estimate) -> Estimate:
        """Return the estimate with sensor faults."""
        for fault, apply in self._sensor_functions:
            original, e = e, apply(e, fault.intensity(t))
            self.estimate_changes[fault] = estimate_vector(e) - estimate_vector(original)
        return e

    def apply_to_commands(self, t: float, commands: Commands) -> Commands:
        """Return surface and motor positions with servo faults."""
        for fault, apply in self._servo_functions:
            original, commands = commands, apply(t, fault.intensity(t), commands)
            self.command_changes[fault] = np.subtract(commands, original)
        return commands


def estimate_vector(e: Estimate) -> np.ndarray:
    """Return rates, force, euler, v, Va and height as one vector, (14,)."""
    return np.concatenate([e.rates, e.force, e.euler, e.v, [e.Va, -e.p[2]]])


def _on_one_surface(fault: Fault, servo_fault: ServoFault) -> Callable[[float, float, Commands], Commands]:
    """Apply a servo fault to its surface only."""
    i = SURFACES.index(fault.part)

    def apply(t: float, intensity: float, commands: Commands) -> Commands:
        deltas = list(commands)
        deltas[i] = servo_fault(deltas[i], intensity)
        return deltas[0], deltas[1], deltas[2], deltas[3]

    return apply
