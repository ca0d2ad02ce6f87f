"""L1 guidance: lateral acceleration to follow a line or a circle.

    L1 = zeta T v_g / pi        K = 4 zeta^2        a_lat = K v_g^2 / L1 sin(nu)

`nu` is the angle from the ground velocity to a point on the path at distance L1 ahead. Right is positive.
Source: Park, Deyst & How, "A New Nonlinear Guidance Logic for Trajectory Tracking" (2004); ArduPlane L1 controller.
"""

from math import asin, atan, atan2, cos, pi, sin, tan

import numpy as np

from fleet.autopilots import control_law as S
from fleet.autopilots.arduplane import params as P
from fleet.autopilots.control_law import angle_to, clip, hypot, kernel
from fleet.frames import G, wrap
from fleet.mission import P_E, P_N

_XTRACK_I_ANGLE = 0.0873  # crosstrack angle below which the integral is active: 5 deg [rad]
_MAX_CAPTURE_SIN = 0.7071  # sine of the maximum intercept angle: 45 deg [-]
_XTRACK_I_MAX = 0.1  # limit of the crosstrack integral [rad]


@kernel
def ground_track(v: np.ndarray, psi: float) -> tuple[float, float, float]:
    """Return ground velocity north, east and speed; when flying backwards 0.1 m/s along the heading [m/s]."""
    speed = hypot(v[0], v[1])
    if speed < 0.1 or v[0] * cos(psi) + v[1] * sin(psi) < 0.0:
        return 0.1 * cos(psi), 0.1 * sin(psi), 0.1
    return v[0], v[1], speed


@kernel
def distance(par: np.ndarray, speed: float) -> float:
    """Return the L1 distance for a ground speed [m]."""
    return max(par[P.DAMPING] * par[P.PERIOD] * speed / pi, 0.1)


@kernel
def to_roll(par: np.ndarray, a_lat: float, theta: float) -> float:
    """Convert lateral acceleration [m/s2] to the limited bank angle of a level turn [rad]."""
    return clip(atan(a_lat / (G * max(cos(theta), 0.5))), -par[P.ROLL_LIMIT], par[P.ROLL_LIMIT])


@kernel
def keep_turn_direction(ctl: np.ndarray, nu: float, n: float, e: float, psi: float) -> float:
    """Keep the turn direction while the target (n, e) is nearly behind; store and return `nu` [rad]."""
    nu_last = ctl[S.NU]
    if abs(nu) > 0.9 * pi and abs(nu_last) > 0.9 * pi and nu * nu_last < 0.0:
        behind = abs(wrap(atan2(e, n) - psi)) > 2 * pi / 3
        nu = nu_last if behind else nu
    ctl[S.NU] = nu
    return nu


@kernel
def follow_line(
    ctl: np.ndarray,
    par: np.ndarray,
    line: tuple[float, float, float, float],
    p: np.ndarray,
    v: np.ndarray,
    psi: float,
    dt: float,
) -> float:
    """Return the lateral acceleration to follow a line; from the aircraft's position: to fly directly to the end.

    Three regimes: far behind the start, fly to the start; more than 3 s past the end, fly to the end; else capture
    the line with nu = asin(crosstrack / L1) + integral + course error.

    Args:
        ctl, par: controller state, parameters
        line: start and end, north and east of each [m]
        p, v: position and ground velocity, NED, (3,) [m, m/s]
        psi: heading [rad]
        dt: step [s]
    Returns:
        lateral acceleration, right positive [m/s2]
    """
    v_n, v_e, speed = ground_track(v, psi)
    l1 = distance(par, speed)
    t_n, t_e = line[2] - line[0], line[3] - line[1]
    length = max(hypot(t_n, t_e), 1e-6)
    t_n, t_e = t_n / length, t_e / length
    a_n, a_e = p[0] - line[0], p[1] - line[1]
    along, crosstrack = a_n * t_n + a_e * t_e, a_n * t_e - a_e * t_n
    start_distance = hypot(a_n, a_e)
    b_n, b_e = line[2] - p[0], line[3] - p[1]
    if start_distance > l1 and along < -_MAX_CAPTURE_SIN * max(start_distance, 1.0):
        nu = angle_to(v_n, v_e, -a_n, -a_e)
    elif along > length + 3.0 * speed:
        nu = angle_to(v_n, v_e, b_n, b_e)
    else:
        nu1 = asin(clip(crosstrack / l1, -_MAX_CAPTURE_SIN, _MAX_CAPTURE_SIN))
        if par[P.XTRACK_I] <= 0.0:
            ctl[S.XTRACK] = 0.0
        elif abs(nu1) < _XTRACK_I_ANGLE:
            ctl[S.XTRACK] = clip(ctl[S.XTRACK] + nu1 * par[P.XTRACK_I] * dt, -_XTRACK_I_MAX, _XTRACK_I_MAX)
        nu = nu1 + ctl[S.XTRACK] + angle_to(v_n, v_e, t_n, t_e)
    nu = clip(keep_turn_direction(ctl, nu, b_n, b_e, psi), -pi / 2, pi / 2)
    return 4.0 * par[P.DAMPING] ** 2 * speed * speed / l1 * sin(nu)


@kernel
def circle_radius(par: np.ndarray, radius: float, va_c: float) -> float:
    """Return the radius that is flown for a requested one: larger in thin air, where the true airspeed is higher [m].

    With NAVL1_LIM_BANK the radius grows only as far as the bank of a level turn at sea level requires.

    Args:
        par: parameters
        radius: requested, not negative [m]
        va_c: commanded airspeed, equivalent [m/s]
    """
    widened = radius * par[P.EAS2TAS] ** 2
    smallest = va_c * va_c / (G * tan(par[P.LIM_BANK])) if par[P.LIM_BANK] > 0.0 else 0.0  # at sea level
    if smallest <= 0.0 or smallest > radius:
        return widened
    return max(smallest * par[P.EAS2TAS] ** 2, radius)


@kernel
def follow_circle(
    ctl: np.ndarray, par: np.ndarray, leg: np.ndarray, p: np.ndarray, v: np.ndarray, psi: float, radius: float
) -> tuple[float, bool]:
    """Capture and follow a circle: omega = 2 pi / T, a = d (omega^2 (r - R) + 2 zeta omega r_dot + v_t^2 / r).

    Args:
        ctl, par, leg: controller state, parameters, row of the route (its target is the centre)
        p, v: position and ground velocity, NED, (3,) [m, m/s]
        psi: heading [rad]
        radius: signed, positive clockwise [m]
    Returns:
        lateral acceleration, right positive [m/s2]; whether the circle is reached
    """
    v_n, v_e, speed = v[0], v[1], max(hypot(v[0], v[1]), 1.0)
    d = 1.0 if radius >= 0.0 else -1.0
    R = max(abs(radius), 1.0)
    c_n, c_e = leg[P_N] - p[0], leg[P_E] - p[1]
    r = max(hypot(c_n, c_e), 0.1)
    out_n, out_e = -c_n / r, -c_e / r
    nu = clip(keep_turn_direction(ctl, angle_to(v_n, v_e, -out_n, -out_e), c_n, c_e, psi), -pi / 2, pi / 2)
    a_capture = 4.0 * par[P.DAMPING] ** 2 * speed * speed / distance(par, speed) * sin(nu)
    omega = 2 * pi / par[P.PERIOD]
    v_t = (out_n * v_e - out_e * v_n) * d
    v_r = v_n * out_n + v_e * out_e
    correction = omega * omega * (r - R) + 2.0 * par[P.DAMPING] * omega * v_r
    if v_r > 0.0 and v_t < 0.0:
        correction = max(correction, 0.0)
    a_circle = d * (correction + v_t * v_t / max(0.5 * R, r))
    if r > R and d * a_capture < d * a_circle:
        return a_capture, False
    return a_circle, True
