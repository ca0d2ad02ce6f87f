"""All faults of one aircraft: physics, wind, sensors, estimate and commands."""

from collections import deque
from collections.abc import Callable, Sequence
from math import radians

import numpy as np

from fleet.simulator.faults.oddities import UNCATALOGUED
from fleet.simulator.faults.physics import PHYSICS_FAULTS, WIND_FAULTS, Fault, FaultyPhysics
from fleet.simulator.faults.servos import SERVO_FAULTS, SURFACES, Commands, ServoFault
from fleet.simulator.vehicle.jsbsim import Aircraft
from fleet.simulator.vehicle.sensors import Estimate, pressure_at, pressure_height

_BUFFER_S = 3.0  # length of the buffer of fixes

SensorFault = Callable[[Estimate, float], Estimate]
"""(estimate, intensity of the fault) to estimate; may have state."""


def _airspeed_scale(fault: Fault, dt: float) -> SensorFault:
    return lambda e, share: e._replace(Va=e.Va * (1 + share * (fault.values["scale"] - 1)))


def _airspeed_bias(fault: Fault, dt: float) -> SensorFault:
    return lambda e, share: e._replace(Va=e.Va + share * fault.values["bias_mps"])


def _gps_latency(fault: Fault, dt: float) -> SensorFault:
    fixes: deque[tuple[np.ndarray, np.ndarray, float]] = deque(maxlen=round(_BUFFER_S / dt))

    def apply(e: Estimate, intensity: float) -> Estimate:
        fixes.appendleft((e.p, e.v, e.gps_height))
        p, v, satellites = fixes[min(round(intensity * fault.values["latency_s"] / dt), len(fixes) - 1)]
        return e._replace(p=p, v=v, gps_height=satellites)

    return apply


def _imu_misalignment(fault: Fault, dt: float) -> SensorFault:
    """Return rates and forces in the axes of a unit rotated relative to the body by a rotation vector."""
    rotation = np.radians([fault.values.get(name, 0.0) for name in ("roll_deg", "pitch_deg", "yaw_deg")])

    def apply(e: Estimate, intensity: float) -> Estimate:
        axes = _rotation(-intensity * rotation)
        return e._replace(rates=axes @ e.rates, force=axes @ e.force)

    return apply


def _rotation(rotation: np.ndarray) -> np.ndarray:
    """Return the rotation matrix of a rotation vector [rad], (3, 3): exp of its cross product matrix."""
    angle = float(np.linalg.norm(rotation))
    x, y, z = rotation / angle if angle > 0 else rotation
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def _axis_vector(fault: Fault, axes: str) -> np.ndarray:
    return np.eye(3)[axes.index(fault.part)]


def _gyro_bias(fault: Fault, dt: float) -> SensorFault:
    bias = radians(fault.values["bias_dps"]) * _axis_vector(fault, "pqr")
    return lambda e, share: e._replace(rates=e.rates + share * bias)


def _accel_bias(fault: Fault, dt: float) -> SensorFault:
    bias = fault.values["bias_mps2"] * _axis_vector(fault, "xyz")
    return lambda e, share: e._replace(force=e.force + share * bias)


def _heading_bias(fault: Fault, dt: float) -> SensorFault:
    bias = np.array([0.0, 0.0, radians(fault.values["bias_deg"])])
    return lambda e, share: e._replace(euler=e.euler + share * bias)


def _baro_bias(fault: Fault, dt: float) -> SensorFault:
    """Shift the static pressure by a height; the estimated height follows it."""
    bias = fault.values["bias_m"]

    def apply(e: Estimate, intensity: float) -> Estimate:
        pressure = pressure_at(pressure_height(e.pressure) + intensity * bias)
        return e._replace(p=e.p - np.array([0.0, 0.0, intensity * bias]), pressure=pressure)  # p is NED

    return apply


SENSOR_FAULTS: dict[str, Callable[[Fault, float], SensorFault]] = {
    "airspeed_scale": _airspeed_scale,
    "airspeed_bias": _airspeed_bias,
    "gps_latency": _gps_latency,
    "imu_misalignment": _imu_misalignment,
    "gyro_bias": _gyro_bias,
    "accel_bias": _accel_bias,
    "heading_bias": _heading_bias,
    "baro_bias": _baro_bias,
}


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
