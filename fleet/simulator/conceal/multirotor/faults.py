"""Effects hidden in flights of multirotors: draws, parameters of RotorPy, sensor faults, values in a report.

Magnitudes are those of realistic defects. Names that begin with _ are not in the catalogue.
"""

from collections.abc import Callable, Mapping
from math import pi, sin, sqrt

import numpy as np

from fleet.simulator.conceal.effects import HiddenEffect, Values
from fleet.simulator.faults.carried import SENSOR_FAULTS, SensorFault
from fleet.simulator.faults.physics import Fault
from fleet.simulator.multirotor.airframes import MultirotorType
from fleet.simulator.multirotor.uav import DT, SimulatedMultirotor
from fleet.simulator.vehicle.sensors import Estimate

MOTORS = ("motor1", "motor2", "motor3", "motor4")
AIRFRAMES = {"quad": "ardupilot", "quad_large": "px4"}
"""Airframe and the autopilot that flies it."""
_UPDATE_TICKS = 10  # between changes of the parameters [ticks]


def _uniform(key: str, low: float, high: float, *, signed: bool = False) -> Callable[..., Values]:
    def draw(rng: np.random.Generator, _: bool) -> Values:
        sign = float(rng.choice([-1, 1])) if signed else 1.0
        return {key: sign * float(rng.uniform(low, high))}

    return draw


def _cg(rng: np.random.Generator, _: bool) -> Values:
    distance, direction = rng.uniform(0.06, 0.16), rng.uniform(-pi, pi)
    return {"forward": float(distance * np.cos(direction)), "right": float(distance * np.sin(direction))}


_ALL, _STEPS = tuple(AIRFRAMES), ("step",)
HIDDEN: dict[str, HiddenEffect] = {
    "motor_thrust_loss": HiddenEffect("motor", _uniform("loss", 0.08, 0.25), airframes=_ALL, parts=MOTORS),
    "thrust_loss": HiddenEffect("motor", _uniform("loss", 0.06, 0.18), airframes=_ALL),
    "motor_lag": HiddenEffect("lag", _uniform("added_s", 0.03, 0.08), airframes=_ALL),
    "mass_change": HiddenEffect("mass", _uniform("fraction", 0.06, 0.2, signed=True), airframes=_ALL),
    "cg_shift": HiddenEffect("cg", _cg, airframes=_ALL),
    "drag_increase": HiddenEffect("drag", _uniform("fraction", 0.6, 1.6), airframes=_ALL),
    "gps_latency": HiddenEffect("gps", _uniform("latency_s", 0.15, 0.4), airframes=_ALL),
    "heading_bias": HiddenEffect("heading", _uniform("bias_deg", 6.0, 15.0, signed=True), airframes=_ALL),
    "gyro_bias": HiddenEffect(
        "imu", _uniform("bias_dps", 0.7, 2.0, signed=True), airframes=_ALL, parts=("p", "q", "r")
    ),
    "accel_bias": HiddenEffect(
        "imu", _uniform("bias_mps2", 0.3, 0.8, signed=True), airframes=_ALL, parts=("x", "y", "z")
    ),
    "baro_bias": HiddenEffect("baro", _uniform("bias_m", 5.0, 12.0, signed=True), _STEPS, _ALL),
}
UNKNOWN: dict[str, HiddenEffect] = {
    "_pulsing_motor": HiddenEffect(
        "", lambda rng, _: {"fraction": rng.uniform(0.15, 0.3), "hertz": rng.uniform(0.3, 0.8)}, _STEPS, _ALL, MOTORS
    ),
    "_swinging_load": HiddenEffect(
        "", lambda rng, _: {"share": rng.uniform(0.12, 0.2), "hertz": rng.uniform(0.3, 0.7)}, _STEPS, _ALL
    ),
    "_gyro_scale": HiddenEffect("", _uniform("scale", 0.15, 0.3, signed=True), _STEPS, _ALL),
}
OVERLAPPING = (  # pairs of channels that are not separable
    {"motor", "mass"},
    {"motor", "cg"},
    {"imu", "mass"},
    {"imu", "motor"},
    {"imu", "heading"},
    {"gps", "heading"},
    {"gps", "baro"},
)

Airframe = tuple[MultirotorType, np.ndarray]
"""Parameters, and the relative rotor speed of each motor (4,) [-]."""


def _lose_thrust(airframe: Airframe, fault: Fault, share: float, _: float) -> Airframe:
    kind, motors = airframe
    return kind._replace(k_eta=kind.k_eta * (1 - share * fault.values["loss"])), motors


def _lose_motor(airframe: Airframe, fault: Fault, share: float, _: float) -> Airframe:
    """Turn one motor more slowly: its thrust, reaction torque and power fall."""
    return _scale_motor(airframe, fault.part, 1 - share * fault.values["loss"])


def _scale_motor(airframe: Airframe, part: str, thrust: float) -> Airframe:
    kind, motors = airframe
    motors = motors.copy()
    motors[MOTORS.index(part)] *= sqrt(thrust)
    return kind, motors


def _slow_motors(airframe: Airframe, fault: Fault, share: float, _: float) -> Airframe:
    kind, motors = airframe
    return kind._replace(tau_m=kind.tau_m + share * fault.values["added_s"]), motors


def _change_mass(airframe: Airframe, fault: Fault, share: float, _: float) -> Airframe:
    """Add mass at the centre of gravity, which leaves the moments of inertia."""
    kind, motors = airframe
    return kind._replace(mass=kind.mass * (1 + share * fault.values["fraction"])), motors


def _shift_cg(airframe: Airframe, fault: Fault, share: float, _: float) -> Airframe:
    kind, motors = airframe
    forward, right = (share * kind.arm * fault.values[name] for name in ("forward", "right"))
    return kind._replace(cg=(kind.cg[0] + forward, kind.cg[1] - right)), motors


def _add_drag(airframe: Airframe, fault: Fault, share: float, _: float) -> Airframe:
    kind, motors = airframe
    x, y, z = ((1 + share * fault.values["fraction"]) * c for c in kind.drag)
    return kind._replace(drag=(x, y, z)), motors


def _pulse_motor(airframe: Airframe, fault: Fault, share: float, t: float) -> Airframe:
    wave = sin(2 * pi * fault.values["hertz"] * t)
    return _scale_motor(airframe, fault.part, 1 + share * fault.values["fraction"] * wave)


def _swing_load(airframe: Airframe, fault: Fault, share: float, t: float) -> Airframe:
    kind, motors = airframe
    offset = share * fault.values["share"] * kind.arm * sin(2 * pi * fault.values["hertz"] * t)
    return kind._replace(cg=(kind.cg[0] + offset, kind.cg[1])), motors


PHYSICS: dict[str, Callable[[Airframe, Fault, float, float], Airframe]] = {
    "motor_thrust_loss": _lose_motor,
    "thrust_loss": _lose_thrust,
    "motor_lag": _slow_motors,
    "mass_change": _change_mass,
    "cg_shift": _shift_cg,
    "drag_increase": _add_drag,
    "_pulsing_motor": _pulse_motor,
    "_swinging_load": _swing_load,
}
"""(airframe, fault, intensity, time [s]) to the airframe with the fault."""

_NOISE = np.array([0.05] * 3 + [0.1] * 3 + [0.05] * 4)  # of `RotorBody.accelerations`, up to some hertz
_SENSOR_NOISE: dict[str, np.ndarray] = {
    "rates": np.full(3, 0.003),
    "force": np.full(3, 0.07),
    "euler": np.full(3, 0.0044),
    "v": np.full(3, 0.075),
    "p": np.full(3, 0.5),
}


def reported_values(name: str, airframe: MultirotorType, values: Mapping[str, float]) -> Values:
    """Return the expected report values; a motor lag includes that of the healthy motor."""
    if name == "motor_lag":
        return {"tau_s": airframe.tau_m + values["added_s"]}
    return dict(values) if name in HIDDEN else {}


class FaultyMultirotor(SimulatedMultirotor):
    """Simulated multirotor with faults, which measures how strongly each of them acts."""

    faults: tuple[Fault, ...] = ()

    def attach(self, faults: tuple[Fault, ...]) -> None:
        """Attach faults before the first step."""
        self.faults = faults
        self.healthy: Airframe = self.vehicle.kind, self.vehicle.motors
        self.squares = {fault: [0.0, 0] for fault in faults}  # sum of squares over noise, number of instants
        self._sensor_faults: list[tuple[Fault, SensorFault]] = [
            (fault, SENSOR_FAULTS[fault.name](fault, DT)) for fault in faults if fault.name in SENSOR_FAULTS
        ]

    def strength(self, fault: Fault) -> float:
        """Return the rms of the strongest reading or acceleration that a fault changes, over its noise."""
        total, n = self.squares[fault]
        return float(np.sqrt(total / max(n, 1)))

    def _tick(self) -> list[bytes]:
        if self.faults and self.tick % _UPDATE_TICKS == 0:
            self._update_physics(self.tick * DT)
        return super()._tick()

    def _update_physics(self, t: float) -> None:
        physics = [fault for fault in self.faults if fault.name in PHYSICS]
        for fault in physics if not self.vehicle.on_ground else ():
            if fault.intensity(t) > 0:
                self.vehicle.set_parameters(*self._altered(t, without=fault))
                healthy = self.vehicle.accelerations()
                self.vehicle.set_parameters(*self._altered(t))
                self._note(fault, (self.vehicle.accelerations() - healthy) / _NOISE)
        if physics:
            self.vehicle.set_parameters(*self._altered(t))

    def _altered(self, t: float, without: Fault | None = None) -> Airframe:
        airframe = self.healthy
        for fault in self.faults:
            if fault.name in PHYSICS and fault is not without:
                airframe = PHYSICS[fault.name](airframe, fault, fault.intensity(t), t)
        return airframe

    def _note(self, fault: Fault, changes: np.ndarray) -> None:
        self.squares[fault][0] += float(np.abs(changes).max()) ** 2
        self.squares[fault][1] += 1

    def _measure(self) -> Estimate:
        e, t = super()._measure(), self.tick * DT
        for fault, apply in getattr(self, "_sensor_faults", ()):
            before, e = e, apply(e, fault.intensity(t))
            if fault.intensity(t) > 0:
                changes = [(getattr(e, name) - getattr(before, name)) / s for name, s in _SENSOR_NOISE.items()]
                self._note(fault, np.concatenate(changes))
        return e
