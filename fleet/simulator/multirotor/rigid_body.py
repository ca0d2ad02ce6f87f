"""Flight dynamics of a simulated multirotor: RotorPy in SI, NED and FRD, in wind and turbulence.

The equations of motion are `rotorpy.vehicles.multirotor.Multirotor._s_dot_fn` (thrust, reaction torque, rotor drag,
translational lift, frame drag, motor lag, ground contact). They are integrated here with the midpoint rule at 100 Hz:
0.3 ms a step on a slow core, against 1.6 ms of RotorPy's `step`, which starts a solver of variable order each time.
Positions agree with those of that solver within 1 mm after half a second.

Source: Folk, Paulos & Kumar 2023, "RotorPy"; turbulence MIL-F-8785C, sec. 3.7.3.4 (intensities and scales at low
altitude), as first-order Gauss-Markov processes with the time scale of flight through frozen turbulence.
"""

from math import asin, atan2, hypot

import numpy as np
from rotorpy.vehicles.multirotor import Multirotor

from fleet.frames import G
from fleet.simulator.multirotor.airframes import MultirotorType, rotorpy_parameters
from fleet.simulator.vehicle.jsbsim import Truth
from fleet.simulator.vehicle.sensors import pressure_at, pressure_height
from fleet.simulator.vehicle.weather import FT

DT = 0.01  # physics step [s]
_FLIP = np.array([1.0, -1.0, -1.0])  # north west up to north east down, forward left up to forward right down
_RHO, _P, _T = 1.17, 96_000.0, 285.0  # air near the ground of the missions [kg/m3, Pa, K]
_MIN_GUST_SPEED, _MIN_GUST_HEIGHT, _MAX_GUST_HEIGHT = 3.0, 10.0, 300.0  # [m/s], [m], [m]
_IDLE_THRUST = 0.01  # of an armed motor, as a fraction of the maximum [-]


class RotorBody:
    """One multirotor on the ground or in flight."""

    def __init__(self, kind: MultirotorType, motors: np.ndarray, rng: np.random.Generator, w20: float):
        """Place the aircraft on the ground at the origin.

        Args:
            kind: its parameters
            motors: relative rotor speed of each motor, (4,) [-]
            rng: draws heading and turbulence
            w20: wind at 20 ft that sets the turbulence [m/s]
        """
        self.kind = kind
        self._model = Multirotor(rotorpy_parameters(kind), enable_ground=True)
        self._motors, self._w20, self._rng = motors, w20, rng
        psi = float(rng.uniform(-np.pi, np.pi))
        self._s = np.zeros(20)
        self._s[6:10] = (0.0, 0.0, -np.sin(psi / 2), np.cos(psi / 2))  # of the body forward left up: i j k w
        self._command = np.zeros(4)
        self._mean_wind = np.zeros(3)
        self._gust = self._gust_std(_MIN_GUST_HEIGHT) * rng.standard_normal(3)
        self._force = np.array([0.0, 0.0, G])  # specific force, forward left up [m/s2]

    @property
    def motors(self) -> np.ndarray:
        """Return the relative rotor speed of each motor, (4,) [-]."""
        return self._motors

    def set_parameters(self, kind: MultirotorType, motors: np.ndarray) -> None:
        """Change the parameters, and the relative rotor speed of each motor, (4,) [-]; state and inputs stay."""
        self._command *= motors / self._motors
        self.kind, self._motors = kind, motors
        self._model = Multirotor(rotorpy_parameters(kind), enable_ground=True)

    def accelerations(self) -> np.ndarray:
        """Return the linear, angular and relative rotor accelerations at this instant, (10,) [m/s2, rad/s2, 1/s]."""
        rate = self._model._s_dot_fn(0.0, self._s, self._command)
        return np.concatenate([rate[3:6], rate[10:13], rate[16:] / self.kind.top_speed])

    def set_wind(self, north: float, east: float) -> None:
        """Set the mean wind, direction it blows to [m/s]."""
        self._mean_wind[:] = (north, -east, 0.0)

    def set_motors(self, inputs: np.ndarray | None) -> None:
        """Set the motor inputs 0..1, (4,) [-]; None: motors off."""
        if inputs is None:
            self._command[:] = 0.0
            return
        u = np.clip(inputs, 0.0, 1.0)
        thrust = np.maximum((1 - self.kind.expo) * u + self.kind.expo * u**2, _IDLE_THRUST)
        self._command[:] = np.minimum(self.kind.top_speed * self._motors * np.sqrt(thrust), self.kind.top_speed)

    def _gust_std(self, height: float) -> np.ndarray:
        """Return the intensities along north, east and down [m/s]."""
        h = min(max(height, _MIN_GUST_HEIGHT), _MAX_GUST_HEIGHT) / FT
        vertical = 0.1 * self._w20
        horizontal = vertical / (0.177 + 0.000823 * h) ** 0.4
        return np.array([horizontal, horizontal, vertical])

    def _step_gust(self, airspeed: float) -> None:
        height = min(max(float(self._s[2]), _MIN_GUST_HEIGHT), _MAX_GUST_HEIGHT)
        scale = height / (0.177 + 0.000823 * height / FT) ** 1.2  # horizontal length scale [m]
        rate = max(airspeed, _MIN_GUST_SPEED) / np.array([scale, scale, height])
        decay = np.exp(-DT * rate)
        noise = np.sqrt(1 - decay**2) * self._rng.standard_normal(3)
        self._gust = decay * self._gust + self._gust_std(height) * noise

    def step(self) -> None:
        """Advance by DT."""
        s, model = self._s, self._model
        self._step_gust(float(np.linalg.norm(s[3:6] - s[13:16])))
        s[13:16] = self._mean_wind + self._gust
        half = s + 0.5 * DT * model._s_dot_fn(0.0, s, self._command)
        rate = model._s_dot_fn(0.0, half, self._command)
        self._force = self._rotation().T @ (rate[3:6] + np.array([0.0, 0.0, model.g]))
        s = s + DT * rate
        s[6:10] /= np.linalg.norm(s[6:10])
        np.clip(s[16:], 0.0, self.kind.top_speed, out=s[16:])
        if s[2] <= 0.001:
            s = Multirotor._pack_state(model._handle_vehicle_on_ground(Multirotor._unpack_state(s)))
        self._s = s

    @property
    def on_ground(self) -> bool:
        """Return whether the aircraft stands on the ground."""
        return bool(self._s[2] <= 0.002)

    @property
    def power(self) -> float:
        """Return the power of the rotors over that at full speed, the sum of cubes of their speeds [-]."""
        return float(np.mean((self._s[16:] / self.kind.top_speed) ** 3))

    def _rotation(self) -> np.ndarray:
        i, j, k, w = self._s[6:10]
        return np.array(
            [
                [1 - 2 * (j * j + k * k), 2 * (i * j - k * w), 2 * (i * k + j * w)],
                [2 * (i * j + k * w), 1 - 2 * (i * i + k * k), 2 * (j * k - i * w)],
                [2 * (i * k - j * w), 2 * (j * k + i * w), 1 - 2 * (i * i + j * j)],
            ]
        )

    def truth(self) -> Truth:
        """Return the true state."""
        s = self._s
        i, j, k, w = s[6], -s[7], -s[8], s[9]  # forward right down to north east down
        phi = atan2(2 * (w * i + j * k), 1 - 2 * (i * i + j * j))
        theta = asin(min(max(2 * (w * j - k * i), -1.0), 1.0))
        psi = atan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k))
        air = self._rotation().T @ (s[3:6] - s[13:16]) * _FLIP
        Va = float(np.linalg.norm(air))
        beta = asin(min(max(air[1] / max(Va, 1e-3), -1.0), 1.0))
        attitude = np.array([phi, theta, psi])
        angles = (atan2(air[2], hypot(air[0], 1e-3)), beta)
        pressure = pressure_at(pressure_height(_P) + float(s[2]))  # the home has pressure _P
        return Truth(
            s[:3] * _FLIP,
            s[3:6] * _FLIP,
            attitude,
            s[10:13] * _FLIP,
            self._force * _FLIP,
            Va,
            *angles,
            _RHO,
            pressure,
            _T,
        )
