"""All faults of one aircraft: physics, wind, sensors, estimate and commands."""

from collections import deque
from collections.abc import Callable, Sequence
from math import exp, radians

import numpy as np

from fleet.simulator.faults.physics import PHYSICS_FAULTS, TIMED_FAULTS, WIND_FAULTS, Fault
from fleet.simulator.faults.servos import COMMAND_FAULTS, SERVO_FAULTS, SURFACES, CommandFault, Commands
from fleet.simulator.vehicle.jsbsim import DT, Aircraft
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


def _gyro_scale(fault: Fault, dt: float) -> SensorFault:
    return lambda e, share: e._replace(rates=e.rates * (1 + share * fault.values["scale"]))


def _accelerometer_scale(fault: Fault, dt: float) -> SensorFault:
    return lambda e, share: e._replace(force=e.force * (1 + share * fault.values["scale"]))


def _static_line_lag(fault: Fault, dt: float) -> SensorFault:
    """Apply a first-order lag to the static pressure of the height, as from a partly blocked static line."""
    state: list[float] = []

    def apply(e: Estimate, intensity: float) -> Estimate:
        previous, tau = state[0] if state else e.pressure, intensity * fault.values["tau_s"]
        state[:] = [e.pressure + (previous - e.pressure) * exp(-dt / tau) if tau > 0 else e.pressure]
        lag = pressure_height(e.pressure) - pressure_height(state[0])
        return e._replace(p=e.p + np.array([0.0, 0.0, lag]), pressure=state[0])  # p is NED

    return apply


def _pitot_lag(fault: Fault, dt: float) -> SensorFault:
    """Apply a first-order lag to the airspeed, as from water in the pitot line."""
    state: list[float] = []

    def apply(e: Estimate, intensity: float) -> Estimate:
        previous, tau = state[0] if state else e.Va, intensity * fault.values["tau_s"]
        state[:] = [e.Va + (previous - e.Va) * exp(-dt / tau) if tau > 0 else e.Va]
        return e._replace(Va=state[0])

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
    "_gyro_scale": _gyro_scale,
    "_accelerometer_scale": _accelerometer_scale,
    "_static_line_lag": _static_line_lag,
    "_pitot_lag": _pitot_lag,
}


class FaultSet:
    """Faults of one aircraft."""

    def __init__(
        self, faults: Sequence[Fault], aircraft: Aircraft, tick_s: float = DT, estimate_s: float = 2 * DT
    ) -> None:
        """Assign each fault to physics, wind, estimate or commands, and store the nominal properties.

        Args:
            faults: faults of the aircraft
            aircraft: started
            tick_s: time between two calls of `apply_to_commands` [s]
            estimate_s: time between two calls of `apply_to_estimate` [s]
        """
        self._aircraft = aircraft
        self._winds = [fault for fault in faults if fault.name in WIND_FAULTS]
        self._increments = [(f, PHYSICS_FAULTS[f.name](aircraft, f.values)) for f in faults if f.name in PHYSICS_FAULTS]
        self._nominal = {name: aircraft[name] for _, increments in self._increments for name in increments}
        self._timed = [(f, TIMED_FAULTS[f.name](aircraft, f.values)) for f in faults if f.name in TIMED_FAULTS]
        self._commands = [(f, _on_one_surface(f, tick_s)) for f in faults if f.name in SERVO_FAULTS]
        self._commands += [(f, COMMAND_FAULTS[f.name](f.values)) for f in faults if f.name in COMMAND_FAULTS]
        self._sensors = [(f, SENSOR_FAULTS[f.name](f, estimate_s)) for f in faults if f.name in SENSOR_FAULTS]
        self.command_changes = {fault: np.zeros(4) for fault in faults}  # last change of the commands by each fault
        self.estimate_changes = {fault: np.zeros(14) for fault in faults}  # of the estimate, see `estimate_vector`

    def apply_to_physics(self, t: float, excluding: Fault | None = None) -> None:
        """Set the JSBSim properties for `t` [s], optionally excluding one fault."""
        values = dict(self._nominal)
        for fault, increments in self._increments:
            intensity = 0.0 if fault is excluding else fault.intensity(t)
            for name, increment in increments.items():
                values[name] += intensity * increment
        for name, value in values.items():
            if self._aircraft[name] != value:
                self._aircraft[name] = value
        for fault, apply in self._timed:
            apply(t, 0.0 if fault is excluding else fault.intensity(t))

    def wind(self, t: float, height: float) -> np.ndarray:
        """Return the wind added at `t` [s] and `height` above home [m], NED, (3,) [m/s]."""
        winds = [fault.intensity(t) * WIND_FAULTS[fault.name](fault.values, height) for fault in self._winds]
        return np.sum([np.zeros(3), *winds], axis=0)

    def apply_to_estimate(self, t: float, e: Estimate) -> Estimate:
        """Return the estimate with sensor faults."""
        for fault, apply in self._sensors:
            original, e = e, apply(e, fault.intensity(t))
            self.estimate_changes[fault] = estimate_vector(e) - estimate_vector(original)
        return e

    def apply_to_commands(self, t: float, commands: Commands) -> Commands:
        """Return surface and motor positions with servo faults."""
        for fault, apply in self._commands:
            original, commands = commands, apply(t, fault.intensity(t), commands)
            self.command_changes[fault] = np.subtract(commands, original)
        return commands


def estimate_vector(e: Estimate) -> np.ndarray:
    """Return rates, force, euler, v, Va and height as one vector, (14,)."""
    return np.concatenate([e.rates, e.force, e.euler, e.v, [e.Va, -e.p[2]]])


def _on_one_surface(fault: Fault, dt: float) -> CommandFault:
    """Apply a servo fault to its surface only."""
    i, servo_fault = SURFACES.index(fault.part), SERVO_FAULTS[fault.name](fault.values, dt)

    def apply(t: float, intensity: float, commands: Commands) -> Commands:
        deltas = list(commands)
        deltas[i] = servo_fault(deltas[i], intensity)
        return deltas[0], deltas[1], deltas[2], deltas[3]

    return apply
