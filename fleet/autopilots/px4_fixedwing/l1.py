"""L1 guidance of PX4 before 1.13: lateral acceleration to follow a line or a circle.

    L1 = zeta T v_g / pi        K = 4 zeta^2        a_lat = K v_g^2 / L1 sin(nu)

It differs from ArduPlane's in three points: no crosstrack integral, the requested radius is flown at every height, and
an aircraft on a circle that flies against its direction flies straight on instead of turning towards the centre.
Source: Park, Deyst & How, "A New Nonlinear Guidance Logic for Trajectory Tracking" (2004); PX4 ecl library.
"""

from math import asin, hypot, pi, sin

import numpy as np

from fleet.autopilots.control_law import angle_to, clip, kernel
from fleet.autopilots.px4_fixedwing import params as P
from fleet.mission import P_E, P_N

_MAX_CAPTURE_SIN = 0.7071  # sine of the maximum intercept angle: 45 deg [-]
_MIN_SPEED = 0.1  # minimum ground speed in the equations [m/s]
_WRONG_WAY = 2.0  # speed against the direction of a circle from which the aircraft is not turned inwards [m/s]


@kernel
def distance(par: np.ndarray, speed: float) -> float:
    """Return the L1 distance for a ground speed [m]."""
    return par[P.DAMPING] * par[P.PERIOD] * max(speed, _MIN_SPEED) / pi


@kernel
def _towards(par: np.ndarray, speed: float, nu: float) -> float:
    """Return the lateral acceleration towards the reference point at the angle `nu` from the course [m/s2]."""
    return 4.0 * par[P.DAMPING] ** 2 * speed * speed / distance(par, speed) * sin(clip(nu, -pi / 2, pi / 2))


@kernel
def follow_line(par: np.ndarray, t_n: float, t_e: float, e: float, v: np.ndarray) -> float:
    """Return the lateral acceleration to follow a line, right positive [m/s2].

    Args:
        par: parameters
        t_n, t_e: unit vector along the line
        e: distance right of it [m]
        v: ground velocity, NED, (3,) [m/s]
    """
    speed = max(hypot(v[0], v[1]), _MIN_SPEED)
    nu1 = asin(clip(-e / distance(par, speed), -_MAX_CAPTURE_SIN, _MAX_CAPTURE_SIN))
    return _towards(par, speed, nu1 + angle_to(v[0], v[1], t_n, t_e))


@kernel
def follow_circle(
    ctl: np.ndarray, par: np.ndarray, leg: np.ndarray, p: np.ndarray, v: np.ndarray, radius: float
) -> float:
    """Return the lateral acceleration to capture and follow a circle, right positive [m/s2].

    omega = 2 pi / T, a = d (omega^2 (r - R) + 2 zeta omega r_dot + v_t^2 / r)

    Args:
        ctl, par, leg: controller state, parameters, row of the route (its target is the centre)
        p, v: position and ground velocity, NED, (3,) [m, m/s]
        radius: signed, positive clockwise [m]
    """
    speed = max(hypot(v[0], v[1]), _MIN_SPEED)
    d, R = (1.0 if radius > 0.0 else -1.0), abs(radius)
    out_n, out_e = p[0] - leg[P_N], p[1] - leg[P_E]
    r = max(hypot(out_n, out_e), 0.1)
    out_n, out_e = out_n / r, out_e / r
    v_t, v_r = (out_n * v[1] - out_e * v[0]) * d, v[0] * out_n + v[1] * out_e
    omega = 2.0 * pi / par[P.PERIOD]
    correction = omega * omega * (r - R) + 2.0 * par[P.DAMPING] * omega * v_r
    if v_t < -_WRONG_WAY and ctl[P.ON_CIRCLE] > 0.0:
        correction = max(correction, 0.0)
    a_circle = d * (correction + v_t * v_t / max(0.5 * R, r))
    a_capture = _towards(par, speed, angle_to(v[0], v[1], -out_n, -out_e))
    ctl[P.ON_CIRCLE] = 0.0 if r > R and d * a_capture < d * a_circle else 1.0
    return a_circle if ctl[P.ON_CIRCLE] > 0.0 else a_capture
