"""PX4's multicopter trajectory: a jerk-limited velocity follows the line to the waypoint.

    v_top = speed from which braking to the corner speed is possible with MPC_ACC_HOR and MPC_JERK_AUTO
    corner speed^2 = a R tan(angle / 2) / 2         R at most NAV_ACC_RAD and half the leg, angle between the legs
    velocity target = v_top towards a point of the line max(NAV_ACC_RAD, 5 m) ahead
    each axis: a towards sign(e) min(sqrt(2 jerk |e|), a_max), limited in jerk
    trajectory time runs slower by 1 - (distance of the aircraft behind it) / MPC_XY_ERR_MAX

The next leg begins within NAV_ACC_RAD horizontally and NAV_MC_ALT_RAD vertically.
Source: PX4 documentation of multicopter trajectories, corner speeds and acceptance, parameter names and defaults.
"""

from math import acos, pi, sqrt, tan

import numba as nb
import numpy as np

from fleet.autopilots.copter import A_N, B_N, END, HOLD, SPEED
from fleet.autopilots.copter_legs import JERK, track_reference

LAW = "px4: jerk-limited velocity along the legs, behind the position loop"

# parameters after those of `copter_legs`: acceptance [m], horizontal and vertical acceleration up and down [m/s2],
# vertical speed limits up and down [m/s], MPC_XY_ERR_MAX [m]
ACCEPT, ACCEPT_Z, ACC, ACC_UP, ACC_DOWN, UP, DOWN, MAX_LAG = range(10, 18)
N_PAR = 18

SEGMENT, WAIT = range(2)  # state of the navigation
N_STATE = 2

_SUBSTEPS = 2
_MIN_LOOK_M, _MIN_CORNER = 5.0, 0.1  # [m], [m/s]


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _allowed_speed(distance: float, final: float, acc: float, jerk: float) -> float:
    """Return the speed from which braking to `final` is possible."""
    b = 4.0 * acc * acc / jerk
    return 0.5 * (sqrt(b * b + 8.0 * acc * distance + 4.0 * final * final) - b)


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _corner_speed(segment: np.ndarray, following: np.ndarray, par: np.ndarray) -> float:
    """Return the speed at the corner between two legs."""
    n0, e0 = segment[B_N] - segment[A_N], segment[B_N + 1] - segment[A_N + 1]
    n1, e1 = following[B_N] - following[A_N], following[B_N + 1] - following[A_N + 1]
    length, after = sqrt(n0 * n0 + e0 * e0), sqrt(n1 * n1 + e1 * e1)
    if length * after < 1e-3:
        return _MIN_CORNER
    angle = acos(min(max(-(n0 * n1 + e0 * e1) / (length * after), -1.0), 1.0))
    if angle > pi - 1e-3:
        return 1e3
    return max(sqrt(0.5 * par[ACC] * min(par[ACCEPT], 0.5 * length) * tan(0.5 * angle)), _MIN_CORNER)


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _velocity_target(segments: np.ndarray, k: int, r: np.ndarray, par: np.ndarray, out: np.ndarray) -> None:
    segment = segments[k]
    n, e = segment[B_N] - r[0, 0], segment[B_N + 1] - r[0, 1]
    distance = sqrt(n * n + e * e)
    final = 0.0
    if segment[END] > 0.0 and k + 1 < len(segments):
        final = _corner_speed(segment, segments[k + 1], par)
    line_n, line_e = segment[B_N] - segment[A_N], segment[B_N + 1] - segment[A_N + 1]
    length = sqrt(line_n * line_n + line_e * line_e)
    rise = segment[B_N + 2] - segment[A_N + 2]
    whole = sqrt(length * length + rise * rise)
    top = segment[SPEED] * length / whole if whole > 1e-6 else segment[SPEED]
    if length > 1.0:
        along = (r[0, 0] - segment[A_N]) * line_n / length + (r[0, 1] - segment[A_N + 1]) * line_e / length
        aim = min(max(along, 0.0) + max(par[ACCEPT], _MIN_LOOK_M), length)
        n, e = segment[A_N] + line_n / length * aim - r[0, 0], segment[A_N + 1] + line_e / length * aim - r[0, 1]
    size = sqrt(n * n + e * e)
    speed = 0.0 if distance < 0.05 else min(_allowed_speed(distance, final, par[ACC], par[JERK]), top)
    out[0], out[1] = (speed * n / size, speed * e / size) if size > 1e-6 else (0.0, 0.0)
    dz = segment[B_N + 2] - r[0, 2]
    vertical = _allowed_speed(abs(dz), 0.0, par[ACC_UP] if dz > 0 else par[ACC_DOWN], par[JERK])
    if length < 1.0:
        vertical = min(vertical, segment[SPEED])
    out[2] = min(vertical, par[DOWN]) if dz > 0 else -min(vertical, par[UP])


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _step_axis(r: np.ndarray, i: int, target: float, limit: float, dt_jerk: tuple[float, float]) -> None:
    """Advance velocity and acceleration of one axis."""
    dt, jerk = dt_jerk
    error = target - r[1, i]
    a_c = min(sqrt(2.0 * jerk * abs(error)), limit)
    a_c = a_c if error > 0.0 else -a_c
    r[2, i] += min(max(a_c - r[2, i], -jerk * dt), jerk * dt)
    if abs(error) <= abs(r[2, i]) * dt and abs(r[2, i]) <= 2.0 * jerk * dt:
        r[1, i], r[2, i] = target, 0.0
    else:
        r[1, i] += r[2, i] * dt


@nb.njit(cache=True, error_model="numpy", nogil=True)
def follow(
    state: np.ndarray, segments: np.ndarray, xva: np.ndarray, par: np.ndarray, dt: float, out: np.ndarray
) -> None:
    """Simulate the flight along the segments; arguments as of `copter_legs.follow`, the trajectory starts at `xva`."""
    r, target = xva.copy(), np.zeros(3)
    h = dt / _SUBSTEPS
    for row in range(len(out)):
        out[row] = xva[0]
        for _ in range(_SUBSTEPS):
            k = int(state[SEGMENT])
            _velocity_target(segments, k, r, par, target)
            speed = max(sqrt(r[1, 0] ** 2 + r[1, 1] ** 2), 1e-3)
            behind = ((r[0, 0] - xva[0, 0]) * r[1, 0] + (r[0, 1] - xva[0, 1]) * r[1, 1]) / speed
            stretch = min(max(1.0 - behind / par[MAX_LAG], 0.0), 1.0)
            for i in range(3):
                step = h * stretch if i < 2 else h
                limit = par[ACC] if i < 2 else par[ACC_UP] if target[2] < 0.0 else par[ACC_DOWN]
                _step_axis(r, i, target[i], limit, (step, par[JERK]))
                r[0, i] += r[1, i] * step
            track_reference(xva, r, par, h)
            _arrive(state, segments, xva, par, h)


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _arrive(state: np.ndarray, segments: np.ndarray, xva: np.ndarray, par: np.ndarray, dt: float) -> None:
    k = int(state[SEGMENT])
    segment = segments[k]
    n, e, d = segment[B_N] - xva[0, 0], segment[B_N + 1] - xva[0, 1], segment[B_N + 2] - xva[0, 2]
    if state[WAIT] > 0.0 or (sqrt(n * n + e * e) < par[ACCEPT] and abs(d) < par[ACCEPT_Z]):
        state[WAIT] += dt
        if state[WAIT] >= segment[HOLD] and k + 1 < len(segments):
            state[SEGMENT], state[WAIT] = k + 1.0, 0.0
