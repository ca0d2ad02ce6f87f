"""State estimate of a simulated autopilot: true state plus the errors of the estimator of a small UAV.

Standard deviations: position 0.5 m, velocity 0.07 m/s, attitude 0.25 deg; noise and a small bias of gyros and
accelerometers; airspeed 2 % scale error and 0.25 m/s noise. The autopilot uses and reports these values.

Source: orders of magnitude of EKF innovations in ArduPlane flight logs; Beard & McLain (2012) ch. 7 for the sensors.
"""

from math import nan, radians, sqrt
from typing import NamedTuple

import numpy as np

from fleet.simulator.vehicle.jsbsim import Truth
from fleet.simulator.vehicle.weather import GaussMarkov

# name: standard deviation, correlation time [s] (0 = white), components
_ERRORS = (
    ("p", 0.5, 60.0, 3),  # [m]
    ("v", 0.07, 15.0, 3),  # [m/s]
    ("v_white", 0.02, 0.0, 3),  # [m/s]
    ("euler", radians(0.25), 30.0, 3),  # [rad]
    ("euler_white", radians(0.02), 0.0, 3),  # [rad]
    ("gyro", 0.003, 0.0, 3),  # [rad/s]
    ("gyro_bias", 0.001, 300.0, 3),  # [rad/s], residual bias of the estimator
    ("accel", 0.06, 0.0, 3),  # [m/s2]
    ("accel_bias", 0.04, 300.0, 3),  # [m/s2]
    ("airspeed", 0.25, 0.3, 1),  # [m/s]
)
AIRSPEED_SCALE = 0.02  # standard deviation of the pitot tube's scale error [-]
SEA_LEVEL_RHO = 1.225  # [kg/m3]
_SEA_LEVEL_PA, _LAPSE, _POWER = 101_325.0, 2.25577e-5, 5.25588  # ICAO standard atmosphere [Pa, 1/m, -]
BOARD_K = 14.0  # excess of board temperature over outside air [K]
_ALTITUDE_ERRORS = (
    ("pressure", 2.0, 0.0, 1),  # [Pa]
    ("pressure_wander", 3.0, 60.0, 1),  # [Pa]
    ("satellites", 1.5, 100.0, 1),  # [m]
)
SERVO_LOW, SERVO_TRIM, SERVO_HIGH = 1100, 1500, 1900  # SERVOn_MIN, _TRIM, _MAX of surfaces [us]
MOTOR_IDLE, MOTOR_FULL = 1000, 2000  # SERVO3_MIN, SERVO3_MAX [us]


class Estimate(NamedTuple):
    """State estimate of the autopilot; frames and units as in `Truth`, except the airspeed."""

    p: np.ndarray
    v: np.ndarray
    euler: np.ndarray
    rates: np.ndarray
    force: np.ndarray
    Va: float  # equivalent airspeed of a pitot tube: Va_true sqrt(rho / 1.225) [m/s]
    pressure: float = nan  # static [Pa]; this and the following only for onboard recordings
    board_temperature: float = nan  # of the board [K]
    gps_height: float = nan  # height above home from satellites only [m]


class Sensors:
    """Sensors and estimator of one aircraft."""

    def __init__(
        self,
        rng: np.random.Generator,
        dt: float,
        scale_rng: np.random.Generator | None = None,
        altitude_rng: np.random.Generator | None = None,
    ):
        """Draw the first errors.

        Args:
            rng: draws the errors
            dt: time between two calls of `measure` [s]
            scale_rng: draws the airspeed scale instead of `rng`
            altitude_rng: draws the errors of barometer and satellite height; None: without these sensors
        """
        self._noise = _noise(rng, _ERRORS, dt)
        self._altitude_noise = None if altitude_rng is None else _noise(altitude_rng, _ALTITUDE_ERRORS, dt)
        self.airspeed_scale = 1 + AIRSPEED_SCALE * float(np.clip((scale_rng or rng).standard_normal(), -2, 2))

    def measure(self, truth: Truth) -> Estimate:
        """Return the true state plus errors."""
        e = self._noise.step()
        estimate = Estimate(
            truth.p + e[0:3],
            truth.v + e[3:6] + e[6:9],
            truth.euler + e[9:12] + e[12:15],
            truth.rates + e[15:18] + e[18:21],
            truth.force + e[21:24] + e[24:27],
            float(truth.Va * sqrt(truth.rho / SEA_LEVEL_RHO) * self.airspeed_scale + e[27]),
        )
        if self._altitude_noise is None:
            return estimate
        white, wander, gps_error = map(float, self._altitude_noise.step())
        return estimate._replace(
            pressure=truth.P + white + wander,
            board_temperature=truth.T + BOARD_K,
            gps_height=gps_error - float(truth.p[2]),
        )


def _noise(rng: np.random.Generator, errors: tuple[tuple[str, float, float, int], ...], dt: float) -> GaussMarkov:
    sigma = np.concatenate([np.full(n, s) for _, s, _, n in errors])
    tau = np.concatenate([np.full(n, t) for _, _, t, n in errors])
    return GaussMarkov(rng, sigma, tau, dt)


def pressure_height(pressure: float) -> float:
    """Return the height of a pressure [Pa] in the standard atmosphere [m]."""
    return float((1 - (pressure / _SEA_LEVEL_PA) ** (1 / _POWER)) / _LAPSE)


def pressure_at(height: float) -> float:
    """Return the pressure of the standard atmosphere at a height [m], in [Pa]."""
    return float(_SEA_LEVEL_PA * (1 - _LAPSE * height) ** _POWER)


def servo_pulses(delta_a: float, delta_e: float, delta_r: float, delta_t: float) -> tuple[int, int, int, int]:
    """Convert commands to whole pulse widths in output order: aileron, elevator, throttle, rudder [us]."""
    half = SERVO_HIGH - SERVO_TRIM
    a, e, r = (SERVO_TRIM + round(half * min(max(x, -1.0), 1.0)) for x in (delta_a, delta_e, delta_r))
    return a, e, MOTOR_IDLE + round((MOTOR_FULL - MOTOR_IDLE) * min(max(delta_t, 0.0), 1.0)), r


def servo_commands(pulses: tuple[int, int, int, int]) -> tuple[float, float, float, float]:
    """Convert pulse widths [us] to delta_a, delta_e, delta_r, delta_t."""
    a, e, t, r = pulses
    delta_a, delta_e, delta_r = ((x - SERVO_TRIM) / (SERVO_HIGH - SERVO_TRIM) for x in (a, e, r))
    return delta_a, delta_e, delta_r, (t - MOTOR_IDLE) / (MOTOR_FULL - MOTOR_IDLE)
