"""Position control of a simulated multirotor: reference to roll, pitch and throttle.

    v_c = v_ref + square root control of the position error;   a_c = a_ref + P e + I int(e) + D e',
    e = v_c - v, with PX4 - D v'
    horizontal a_c at most g tan(tilt limit), with ArduCopter the part across the reference velocity first
    theta_c = atan(-a_forward / g_z), phi_c = atan(a_right cos(theta_c) / g_z)
    throttle = (hover (1 - ff a_down_c / g) - P_a e - I_a int(e)) / (cos(phi) cos(theta)),   e = a_down_c - a_down

ArduCopter closes the vertical acceleration (ff = 0) and leans by g_z = g; PX4 commands the thrust vector (ff = 1,
g_z = g - a_down_c) and integrates the vertical velocity.
Source: structure, parameter names and defaults of the ArduCopter and PX4 documentation of the position controllers.
"""

from math import atan, cos, hypot, radians, sin, sqrt, tan
from typing import NamedTuple

import numpy as np

from fleet.frames import G
from fleet.simulator.multirotor.attitude import square_root_control
from fleet.simulator.vehicle.sensors import Estimate

_ACC_FILTER_S, _D_FILTER_S = 0.008, 0.032  # [s]
_MAX_ACC_Z = 5.0  # of the vertical command [m/s2]
_MAX_ACC_INTEGRAL, _IMAX = 3.0, 10.0  # horizontal, of PX4 and ArduCopter [m/s2]


class Reference(NamedTuple):
    """Point that the position controller follows, NED."""

    p: np.ndarray  # (3,) [m]
    v: np.ndarray  # (3,) [m/s]
    a: np.ndarray  # (3,) [m/s2]


class PositionGains(NamedTuple):
    """Gains of one autopilot, SI."""

    pos_p: float
    vel: tuple[float, float, float]  # horizontal P, I, D
    pos_p_z: float
    vel_z: tuple[float, float]  # vertical P, I
    acc_z: tuple[float, float]  # P, I of the vertical acceleration, per m/s2
    acc: float  # horizontal limit of the square root control [m/s2]
    tilt: float  # [rad]
    hover: float  # throttle in hover [-]
    speed_z: tuple[float, float]  # up, down limits of the velocity command [m/s]
    thrust_vector: bool  # commands the thrust vector, as PX4 does


def position_gains(params: dict[str, float], is_px4: bool) -> PositionGains:
    """Read the gains from the parameters of the autopilot."""
    get = params.__getitem__
    if is_px4:
        return PositionGains(
            get("MPC_XY_P"),
            (get("MPC_XY_VEL_P_ACC"), get("MPC_XY_VEL_I_ACC"), get("MPC_XY_VEL_D_ACC")),
            get("MPC_Z_P"),
            (get("MPC_Z_VEL_P_ACC"), get("MPC_Z_VEL_I_ACC")),
            (0.0, 0.0),
            get("MPC_ACC_HOR"),
            radians(get("MPC_TILTMAX_AIR")),
            get("MPC_THR_HOVER"),
            (get("MPC_Z_VEL_MAX_UP"), get("MPC_Z_VEL_MAX_DN")),
            True,
        )
    return PositionGains(
        get("PSC_POSXY_P"),
        (get("PSC_VELXY_P"), get("PSC_VELXY_I"), get("PSC_VELXY_D")),
        get("PSC_POSZ_P"),
        (get("PSC_VELZ_P"), 0.0),
        (0.1 * get("PSC_ACCZ_P"), 0.1 * get("PSC_ACCZ_I")),
        0.01 * get("WPNAV_ACCEL"),
        radians(0.01 * get("ANGLE_MAX")),
        get("MOT_THST_HOVER"),
        (0.012 * get("WPNAV_SPEED_UP"), 0.012 * get("WPNAV_SPEED_DN")),
        False,
    )


class PositionController:
    """Position controller of one aircraft."""

    def __init__(self, gains: PositionGains):
        self._gains = gains
        self.reset()

    def reset(self) -> None:
        """Clear the integrators."""
        self._integral = np.zeros(2)
        self._integral_z = 0.0
        self._filtered: np.ndarray | None = None
        self._acc_down = 0.0
        self._beyond = np.zeros(2)

    def step(self, ref: Reference, e: Estimate, dt: float) -> tuple[float, float, float]:
        """Return roll and pitch [rad] and throttle [-]."""
        a_n, a_e = self._horizontal(ref, e, dt)
        a_down, throttle = self._vertical(ref, e, dt)
        g_z = max(G - a_down, 0.3 * G) if self._gains.thrust_vector else G
        a_n, a_e = self._limit(np.array([a_n, a_e]), ref.v[:2], g_z * tan(self._gains.tilt))
        c, s = cos(e.euler[2]), sin(e.euler[2])
        forward, right = a_n * c + a_e * s, -a_n * s + a_e * c
        theta_c = atan(-forward / g_z)
        phi_c = atan(right * cos(theta_c) / g_z)
        boost = 1.0 / max(cos(e.euler[0]) * cos(e.euler[1]), 0.5)
        return phi_c, theta_c, min(max(throttle * boost, 0.05), 0.95)

    def _limit(self, a: np.ndarray, v: np.ndarray, limit: float) -> tuple[float, float]:
        """Limit the horizontal acceleration command, (2,) [m/s2]; keep it where the integrator must not grow."""
        size, speed = hypot(*a), hypot(*v)
        self._beyond = a if size > limit else np.zeros(2)
        if size <= limit:
            return float(a[0]), float(a[1])
        if self._gains.thrust_vector or speed < 1e-3:
            return float(a[0] * limit / size), float(a[1] * limit / size)
        along = v / speed
        across = a - (a @ along) * along
        across *= min(1.0, limit / max(hypot(*across), 1e-9))
        rest = sqrt(max(limit**2 - float(across @ across), 0.0))
        a = across + min(max(float(a @ along), -rest), rest) * along
        return float(a[0]), float(a[1])

    def _integrate(self, change: np.ndarray) -> None:
        """Change the horizontal integrator; at the limit PX4's stays, ArduCopter's turns without growth."""
        px4, size = self._gains.thrust_vector, hypot(*self._integral)
        beyond = bool(change @ self._beyond > 0.0)
        if px4 and np.any(self._beyond):
            return
        self._integral += change
        top = size if beyond else _MAX_ACC_INTEGRAL if px4 else _IMAX
        self._integral *= min(1.0, top / max(hypot(*self._integral), 1e-6))

    def take_over(self, e: Estimate) -> None:
        """Let the horizontal integrator command the present tilt, as ArduCopter does when a controller begins."""
        phi, theta, psi = e.euler
        forward, right = -G * tan(theta), G * tan(phi) / cos(theta)
        self._integral = np.array([forward * cos(psi) - right * sin(psi), forward * sin(psi) + right * cos(psi)])

    def _horizontal(self, ref: Reference, e: Estimate, dt: float) -> tuple[float, float]:
        g = self._gains
        offset = ref.p[:2] - e.p[:2]
        distance = hypot(*offset)
        pull = square_root_control(distance, g.pos_p, g.acc) / max(distance, 1e-6)
        v_c = ref.v[:2] + offset * pull
        error = v_c - e.v[:2]
        signal = -e.v[:2] if g.thrust_vector else error  # PX4 has no derivative of the command
        previous = self._filtered if self._filtered is not None else signal.copy()
        self._filtered = previous + (signal - previous) * dt / (dt + _D_FILTER_S)
        P, I, D = g.vel
        self._integrate(I * error * dt)
        a = ref.a[:2] + P * error + self._integral + D * (self._filtered - previous) / dt
        return float(a[0]), float(a[1])

    def _vertical(self, ref: Reference, e: Estimate, dt: float) -> tuple[float, float]:
        """Return the commanded acceleration downward [m/s2] and the throttle before the tilt compensation [-]."""
        g = self._gains
        up, down = g.speed_z
        v_c = float(ref.v[2]) + square_root_control(float(ref.p[2] - e.p[2]), g.pos_p_z, 2.0)
        error = min(max(v_c, -up), down) - float(e.v[2])
        a_c = float(ref.a[2]) + g.vel_z[0] * error
        if g.thrust_vector:
            self._integral_z = min(max(self._integral_z + g.vel_z[1] * error * dt, -0.5 * G), 0.5 * G)
            a_c = min(max(a_c + self._integral_z, -_MAX_ACC_Z), 0.6 * G)
            return a_c, g.hover * (1 - a_c / G)
        a_c = min(max(a_c, -_MAX_ACC_Z), _MAX_ACC_Z)
        phi, theta, _ = e.euler
        axis = np.array([-sin(theta), sin(phi) * cos(theta), cos(phi) * cos(theta)])  # in the body frame
        measured = float(axis @ e.force) + G
        self._acc_down += (measured - self._acc_down) * dt / (dt + _ACC_FILTER_S)
        acc_error = a_c - self._acc_down
        self._integral_z = min(max(self._integral_z + g.acc_z[1] * acc_error * dt, -0.4), 0.4)
        return a_c, g.hover - g.acc_z[0] * acc_error - self._integral_z


class ShapedPosition:
    """ArduCopter's shaping of a position target at rest: square root control, limited acceleration and jerk."""

    def __init__(self, p: np.ndarray, limits: tuple[float, float, float]):
        """Start at rest at a horizontal position, (2,) [m]; limits of speed, acceleration and jerk [m/s, ...]."""
        self.p, self.v, self.a = p.copy(), np.zeros(2), np.zeros(2)
        self._limits = limits

    def step(self, target: np.ndarray, dt: float) -> None:
        """Advance towards a target, (2,) [m], by dt [s]."""
        top, acc, jerk = self._limits
        k = jerk / acc
        self.p = self.p + dt * (self.v + 0.5 * dt * self.a)
        self.v = self.v + dt * self.a
        offset = target - self.p
        distance = hypot(*offset)
        v_c = np.zeros(2)
        if distance > 1e-9:
            speed = min(square_root_control(distance, k, acc), distance / dt)
            closing = max(float(self.v @ offset) / distance, 0.0)
            slope = k if distance <= acc / k**2 else acc / speed
            v_c = offset / distance * min(max(speed - slope * closing / k, -top), top)
        change = _braking_first(k * (v_c - self.v), self.v, acc) - self.a
        self.a = self.a + change * min(1.0, jerk * dt / max(hypot(*change), 1e-9))


def _braking_first(a: np.ndarray, v: np.ndarray, limit: float) -> np.ndarray:
    """Limit an acceleration: deceleration first, then across the velocity, then along it."""
    speed, size = hypot(*v), max(hypot(*a), 1e-9)
    if speed < 1e-6:
        return a * min(1.0, limit / size)
    a = a * min(1.0, 2.0 * limit / size)
    forward = v / speed
    along = float(a @ forward)
    across = a - along * forward
    sideways = max(hypot(*across), 1e-9)
    if along > 0.0:
        across *= min(1.0, limit / sideways)
        along = min(along, sqrt(max(limit**2 - float(across @ across), 0.0)))
    else:
        along = max(along, -limit)
        across *= min(1.0, sqrt(max(limit**2 - along**2, 0.0)) / sideways)
    return across + along * forward
