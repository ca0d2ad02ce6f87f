"""Attitude and rate control of a simulated multirotor, with the mixer of a quadrotor in X.

    phi_ref' = clip((phi_c - phi_ref) / input_tc), slew limited          ArduCopter only; PX4 commands phi_c directly
    p_c = phi_ref' + P (phi_ref - phi)                                     about the body axes
    roll = P (p_c - p) + I int(p_c - p) - D p'                            and the same for pitch and yaw
    thrust_i = throttle +- roll / 2 +- pitch / 2 +- yaw / 2, then the inverse of the thrust curve

Source: structure, parameter names and defaults of the ArduCopter and PX4 documentation of the attitude controllers.
"""

from math import radians, sqrt
from typing import NamedTuple

import numpy as np

from fleet.frames import wrap
from fleet.simulator.vehicle.sensors import Estimate

_MIX = np.array(  # roll, pitch, yaw of motor 1 front right, 2 rear left, 3 front left, 4 rear right
    [[-1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, -1.0], [-1.0, -1.0, -1.0]]
)
_MAX_YAW = 0.25  # share of thrust for yaw [-]
_D_FILTER_S = 0.02  # time constant of the derivative [s]
_MAX_INTEGRAL = 0.25  # [-]


class AttitudeGains(NamedTuple):
    """Gains of one autopilot, SI: roll and pitch share them."""

    angle_p: float  # [1/s]
    yaw_p: float  # [1/s]
    rate: tuple[float, float, float]  # P, I, D of the roll and pitch rate [s, -, s2]
    yaw_rate: tuple[float, float]  # P, I [s, -]
    input_tc: float  # time constant of the shaped command; 0: not shaped [s]
    max_rate: float  # [rad/s]
    max_yaw_rate: float  # [rad/s]
    expo: float  # thrust curve that the autopilot assumes [-]


def attitude_gains(params: dict[str, float], is_px4: bool) -> AttitudeGains:
    """Read the gains from the parameters of the autopilot."""
    get = params.__getitem__
    if is_px4:
        return AttitudeGains(
            get("MC_ROLL_P"),
            get("MC_YAW_P"),
            (get("MC_ROLLRATE_P"), get("MC_ROLLRATE_I"), get("MC_ROLLRATE_D")),
            (get("MC_YAWRATE_P"), get("MC_YAWRATE_I")),
            0.0,
            radians(get("MC_ROLLRATE_MAX")),
            radians(get("MPC_YAWRAUTO_MAX")),
            get("THR_MDL_FAC"),
        )
    return AttitudeGains(
        get("ATC_ANG_RLL_P"),
        get("ATC_ANG_YAW_P"),
        (get("ATC_RAT_RLL_P"), get("ATC_RAT_RLL_I"), get("ATC_RAT_RLL_D")),
        (get("ATC_RAT_YAW_P"), get("ATC_RAT_YAW_I")),
        get("ATC_INPUT_TC"),
        radians(220.0),
        radians(get("ATC_SLEW_YAW") * 0.01),
        get("MOT_THST_EXPO"),
    )


class AttitudeController:
    """Attitude controller of one aircraft; `step` returns the four motor inputs."""

    def __init__(self, gains: AttitudeGains, psi: float):
        self._gains = gains
        self.psi_ref = psi  # slew-limited heading [rad]
        self._ref = [0.0, 0.0]  # shaped roll and pitch [rad]
        self._integral = np.zeros(3)
        self._rates = np.zeros(3)  # filtered body rates [rad/s]

    def reset(self, psi: float) -> None:
        """Restart on the ground."""
        self.psi_ref, self._ref = psi, [0.0, 0.0]
        self._integral[:] = 0.0

    def step(
        self, command: tuple[float, float, float], throttle: float, e: Estimate, dt: float, *, flying: bool
    ) -> np.ndarray:
        """Return the motor inputs 0..1, (4,).

        Args:
            command: roll, pitch, heading [rad]
            throttle: mean thrust over maximum thrust [-]
            e: estimated state
            dt: time since the last call [s]
            flying: off the ground; integrators rest otherwise
        """
        g = self._gains
        slew = float(np.clip(wrap(command[2] - self.psi_ref) / max(dt, 1e-6), -g.max_yaw_rate, g.max_yaw_rate))
        self.psi_ref = float(wrap(self.psi_ref + slew * dt))
        yaw_rate = slew + g.yaw_p * float(wrap(self.psi_ref - e.euler[2]))
        yaw_rate = min(max(yaw_rate, -2 * g.max_yaw_rate), 2 * g.max_yaw_rate)
        rates_c = np.array([*self._lean_rates(command, e, dt), yaw_rate])
        previous = self._rates
        self._rates = previous + (e.rates - previous) * dt / (dt + _D_FILTER_S)
        error = rates_c - e.rates
        P, I, D = g.rate
        if flying:
            step = error * dt * np.array([I, I, g.yaw_rate[1]])
            self._integral = np.clip(self._integral + step, -_MAX_INTEGRAL, _MAX_INTEGRAL)
        torque = error * np.array([P, P, g.yaw_rate[0]]) + self._integral
        torque[:2] -= D * (self._rates - previous)[:2] / dt
        torque[2] = min(max(torque[2], -_MAX_YAW), _MAX_YAW)
        return self._mix(torque, throttle)

    def _lean_rates(self, command: tuple[float, float, float], e: Estimate, dt: float) -> list[float]:
        """Return the commanded roll and pitch rates [rad/s].

        A rotation about the body's vertical axis keeps the direction of thrust and changes roll and pitch.
        """
        g, rates = self._gains, []
        phi, theta = self._ref
        turned = float(e.rates[2]) * dt
        self._ref = [phi + theta * turned, theta - phi * turned]
        for k in range(2):
            feed_forward = 0.0
            if g.input_tc > 0:
                feed_forward = min(max((command[k] - self._ref[k]) / g.input_tc, -g.max_rate), g.max_rate)
                self._ref[k] += feed_forward * dt
            else:
                self._ref[k] = command[k]
            rate = feed_forward + g.angle_p * (self._ref[k] - float(e.euler[k]))
            rates.append(min(max(rate, -g.max_rate), g.max_rate))
        return rates

    def _mix(self, torque: np.ndarray, throttle: float) -> np.ndarray:
        """Mix torques and thrust to motor inputs; attitude has priority over thrust, and both over yaw."""
        lean = 0.5 * _MIX[:, :2] @ torque[:2]
        reach = float(np.abs(lean).max())
        centre = min(max(throttle, min(reach, 0.5)), 1.0 - min(reach, 0.5))
        left = max(min(centre - reach, 1.0 - centre - reach), 0.02)
        yaw = min(max(0.5 * float(torque[2]), -left), left)
        thrust = np.clip(centre + lean + _MIX[:, 2] * yaw, 0.0, 1.0)
        expo = self._gains.expo
        if expo <= 0:
            return thrust
        return (-(1 - expo) + np.sqrt((1 - expo) ** 2 + 4 * expo * thrust)) / (2 * expo)


def square_root_control(error: float, p: float, limit: float) -> float:
    """Return p e near zero, and the speed of a braking distance beyond; ArduPilot's square root controller."""
    if p <= 0:
        return 0.0
    linear = limit / p**2
    if abs(error) <= linear:
        return p * error
    return sqrt(2 * limit * (abs(error) - linear / 2)) * (1 if error > 0 else -1)
