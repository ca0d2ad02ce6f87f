"""Sensor faults: errors of the estimate that the autopilot uses and reports."""

from collections import deque
from collections.abc import Callable
from math import radians

import numpy as np

from fleet.simulator.faults.fault import Fault
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
