"""PX4's multicopter trajectory: a jerk-limited velocity towards the waypoint.

    v_top = speed from which braking to the corner speed is possible with MPC_ACC_HOR and MPC_JERK_AUTO
    corner speed^2 = MPC_XY_TRAJ_P a R tan(angle / 2)         R = NAV_ACC_RAD, angle between the legs
    velocity target = v_top towards the waypoint; in a turn, to the point of the line max(NAV_ACC_RAD, 5 m) away, not
    faster than before the turn; along a slope, as fast as both horizontal and vertical limits permit
    v, a of each axis: jerk, constant acceleration, opposite jerk, all three over the time of the slowest
    trajectory time runs slower by 1 - (distance of the aircraft behind it) / MPC_XY_ERR_MAX

The next leg begins within NAV_ACC_RAD horizontally and NAV_MC_ALT_RAD vertically, after a take-off within the latter. A
NAV_DELAY waits at the waypoint before it, which the aircraft has approached as if to fly on.
Source: PX4 1.16 documentation and behaviour of navigator, position smoothing and landing, parameter names, defaults.
"""

from math import acos, pi, sqrt, tan

import numba as nb
import numpy as np

from fleet.autopilots.copter import A_N, B_N, HOLD, N_SEGMENT, SPEED
from fleet.autopilots.position_loop import JERK, POS_P, VEL_D, VEL_P, drag, track_reference
from fleet.autopilots.position_loop import N_PAR as _N_LOOP
from fleet.compiled_frames import assign

LAW = "px4: jerk-limited velocity along the legs, behind the position loop"

PHASE = N_SEGMENT
"""Column after those of a segment: one of the following."""
LEG, TAKEOFF, CLIMB_IN_PLACE, LANDING = 0.0, 1.0, 2.0, 3.0
N_COLUMNS = N_SEGMENT + 1

# parameters after those of `position_loop`: acceptance [m], horizontal and vertical acceleration up and down [m/s2],
# vertical speed limits up and down [m/s], MPC_XY_ERR_MAX [m], MPC_XY_TRAJ_P [-], take-off speed [m/s] and its ramp [s],
# heights above ground where landing begins to slow down and is slow [m], landing speed [m/s], position of the ground
# down [m]
ACCEPT, ACCEPT_Z, ACC, ACC_UP, ACC_DOWN, UP, DOWN, MAX_LAG, TURN_GAIN = range(_N_LOOP, _N_LOOP + 9)
TAKEOFF_SPEED, RAMP, HIGH, LOW, LAND_SPEED, GROUND = range(_N_LOOP + 9, _N_LOOP + 15)
N_PAR = _N_LOOP + 15

# state of the navigation: segment, time waited at its end [s], speed before the turn [m/s]; position, velocity and
# acceleration of the trajectory, three each
SEGMENT, WAIT, TURN_SPEED, TRAJECTORY = range(4)
N_STATE = 12

_SUBSTEPS = 2
_MIN_L1 = 5.0  # [m]
_TURNING, _TURNING_SPEED = 0.98, 0.2  # cosine of velocity and target [-], [m/s]
_SLOW = 0.5  # speed below which horizontal and vertical limits act apart [m/s]


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _allowed_speed(distance: float, final: float, acc: float, jerk: float) -> float:
    """Return the speed from which braking to `final` is possible."""
    b = 4.0 * acc * acc / jerk
    return max(0.5 * (sqrt(b * b + 8.0 * acc * distance + 4.0 * final * final) - b), final)


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _is_wait(segment: np.ndarray) -> bool:
    """Return whether a segment is a wait at the point before it."""
    length2 = 0.0
    for i in range(3):
        length2 += (segment[B_N + i] - segment[A_N + i]) ** 2
    return length2 < 1e-4


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _waypoints(segments: np.ndarray, k: int, x: np.ndarray, radius: float, out: np.ndarray) -> None:
    """Return the point before, the target and the point after it, (3, 3); others for an aircraft off the line."""
    line = k
    while line > 0 and _is_wait(segments[line]):
        line -= 1
    after = k
    if not segments[k, HOLD] > 0.0:
        while after + 1 < len(segments):
            after += 1
            if not _is_wait(segments[after]):
                break
        else:
            after = k
    for i in range(3):
        out[0, i], out[1, i] = segments[line, A_N + i], segments[k, B_N + i]
        out[2, i] = segments[after, B_N + i]
    n, e = out[1, 0] - out[0, 0], out[1, 1] - out[0, 1]
    length = sqrt(n * n + e * e)
    if length < 1e-6:
        return
    n, e = n / length, e / length
    from_n, from_e = x[0] - out[0, 0], x[1] - out[0, 1]
    along = from_n * n + from_e * e
    if along > length:  # the target is behind
        assign(out[0], x)
    elif along < 0.0 and from_n**2 + from_e**2 > radius**2:  # the point before is in front
        assign(out[2], out[1])
        assign(out[1], out[0])
        assign(out[0], x)
    elif (from_n * e - from_e * n) ** 2 > radius**2:  # far from the line
        assign(out[2], out[1])
        out[1, 0], out[1, 1] = out[0, 0] + along * n, out[0, 1] + along * e
        assign(out[0], x)


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _top_speed(r: np.ndarray, points: np.ndarray, cruise: float, par: np.ndarray) -> float:
    """Return the speed at the trajectory from which the corner can be passed and the point after it stopped at."""
    n, e = points[1, 0] - r[0, 0], points[1, 1] - r[0, 1]
    after_n, after_e = points[2, 0] - points[1, 0], points[2, 1] - points[1, 1]
    distance, after = sqrt(n * n + e * e), sqrt(after_n * after_n + after_e * after_e)
    corner = 0.0
    if after > 1e-3 and after >= par[ACCEPT]:
        cosine = -(n * after_n + e * after_e) / max(distance * after, 1e-9)
        angle = min(acos(min(max(cosine, -1.0), 1.0)), pi - 1e-7)
        in_turn = sqrt(par[TURN_GAIN] * par[ACC] * par[ACCEPT] * tan(0.5 * angle))
        corner = min(in_turn, min(cruise, _allowed_speed(after, 0.0, par[ACC], par[JERK])))
    return min(cruise, _allowed_speed(distance, corner, par[ACC], par[JERK]))


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _is_turning(r: np.ndarray, target: np.ndarray, radius: float) -> bool:
    n, e = target[0] - r[0, 0], target[1] - r[0, 1]
    speed, distance = sqrt(r[1, 0] ** 2 + r[1, 1] ** 2), sqrt(n * n + e * e)
    aligned = r[1, 0] * n + r[1, 1] * e >= _TURNING * speed * distance
    return speed > _TURNING_SPEED and not aligned and distance > radius


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _velocity_target(
    state: np.ndarray, segments: np.ndarray, xr: tuple[np.ndarray, np.ndarray], par: np.ndarray, out: np.ndarray
) -> None:
    """Return the velocity that the trajectory tends to, (3,), for an aircraft at x and a trajectory r."""
    x, r = xr
    segment = segments[int(state[SEGMENT])]
    points = np.empty((3, 3))
    _waypoints(segments, int(state[SEGMENT]), x, par[ACCEPT], points)
    speed = _top_speed(r, points, segment[SPEED], par)
    n, e = points[1, 0] - r[0, 0], points[1, 1] - r[0, 1]
    if _is_turning(r, points[1], par[ACCEPT]):
        speed = min(speed, state[TURN_SPEED])
        line_n, line_e = points[1, 0] - points[0, 0], points[1, 1] - points[0, 1]
        length = max(sqrt(line_n * line_n + line_e * line_e), 1e-6)
        line_n, line_e = line_n / length, line_e / length
        along = n * line_n + e * line_e  # from the trajectory to the foot of the target
        across_n, across_e = n - along * line_n, e - along * line_e  # to the nearest point of the line
        reach = max(par[ACCEPT], _MIN_L1)
        ahead = sqrt(max(reach * reach - across_n**2 - across_e**2, 0.0))
        n, e = across_n + ahead * line_n, across_e + ahead * line_e
    else:
        state[TURN_SPEED] = speed
    size, dz = sqrt(n * n + e * e), points[1, 2] - r[0, 2]
    if segment[PHASE] == LANDING:
        share = min(max((par[GROUND] - x[2] - par[LOW]) / max(par[HIGH] - par[LOW], 1e-3), 0.0), 1.0)
        out[0], out[1] = speed * n / max(size, 1e-6), speed * e / max(size, 1e-6)
        out[2] = par[LAND_SPEED] + share * (par[DOWN] - par[LAND_SPEED])
        return
    limit, acc = (par[DOWN], par[ACC_DOWN]) if dz > 0.0 else (par[UP], par[ACC_UP])
    if _lifts_off(segment, x, par):
        limit = par[TAKEOFF_SPEED]
    limit = min(limit, _allowed_speed(abs(dz), 0.0, acc, par[JERK]))
    scale = sqrt(speed * speed + limit * limit) / max(sqrt(size * size + dz * dz), 1e-9)
    out[0], out[1], out[2] = scale * n, scale * e, scale * dz
    across = scale * size
    if across > speed:
        out[0], out[1] = out[0] * speed / across, out[1] * speed / across
        out[2] *= 1.0 if speed < _SLOW and across < _SLOW else speed / across
    rise = abs(out[2])
    if rise > limit:
        together = 1.0 if limit < _SLOW and rise < _SLOW else limit / rise
        out[0], out[1], out[2] = out[0] * together, out[1] * together, out[2] * limit / rise


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _lifts_off(segment: np.ndarray, x: np.ndarray, par: np.ndarray) -> bool:
    return segment[PHASE] == TAKEOFF and par[GROUND] - x[2] < par[HIGH]


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _plan(motion: tuple[float, float], target: float, acc: float, jerk: float, out: np.ndarray) -> None:
    """Plan the fastest change of velocity: sense and three times; motion: velocity and acceleration."""
    v, a = motion
    unforced = v + a * abs(a) / (2.0 * jerk)  # velocity when the acceleration has been taken back
    sense = 1.0 if target > unforced or (target == unforced and a > 0.0) else -1.0
    change, a = sense * (target - v), sense * a
    first = (sqrt(max(0.5 * a * a + jerk * change, 0.0)) - a) / jerk
    first = max(min(first, (acc - a) / jerk), 0.0)
    last = max(a / jerk + first, 0.0)
    peak = a + jerk * first
    gained = a * first + 0.5 * jerk * first**2 + peak * last - 0.5 * jerk * last**2
    out[0], out[1], out[3] = sense, first, last
    out[2] = max((change - gained) / peak, 0.0) if abs(peak) > 1e-7 else 0.0


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _stretch(change: float, a: float, duration: float, acc_jerk: tuple[float, float], out: np.ndarray) -> None:
    """Plan the same change over a longer time; change and acceleration in the sense of the plan."""
    acc, jerk = acc_jerk
    square = (duration * jerk) ** 2 + 2.0 * duration * a * jerk - a * a - 4.0 * jerk * change
    first = (jerk * duration - a - sqrt(square)) / (2.0 * jerk) if square >= 0.0 else 0.0
    first = max(min(first, (acc - a) / jerk), 0.0)
    last = max(a / jerk + first, 0.0)
    out[1], out[2], out[3] = first, max(duration - first - last, 0.0), last


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _step(r: np.ndarray, target: np.ndarray, acc: np.ndarray, jerk: float, dt: float) -> None:
    """Advance the trajectory (3, 3) towards a velocity (3,) by dt."""
    plans, longest = np.empty((3, 4)), 0.0
    for i in range(3):
        _plan((r[1, i], r[2, i]), target[i], acc[i], jerk, plans[i])
        longest = max(longest, plans[i, 1] + plans[i, 2] + plans[i, 3])
    for i in range(3):
        plan = plans[i]
        if plan[1] + plan[2] + plan[3] < longest:
            _stretch(plan[0] * (target[i] - r[1, i]), plan[0] * r[2, i], longest, (acc[i], jerk), plan)
        left = dt
        for part in range(4):
            h = min(left, plan[part + 1]) if part < 3 else left
            j = plan[0] * jerk * (1.0 if part == 0 else -1.0 if part == 2 else 0.0)
            if part == 3:
                r[2, i] = 0.0
            r[0, i] += h * (r[1, i] + h * (0.5 * r[2, i] + h * j / 6.0))
            r[1, i] += h * (r[2, i] + 0.5 * h * j)
            r[2, i] += h * j
            left -= h
            if left <= 0.0:
                break


@nb.njit(cache=True, error_model="numpy", nogil=True)
def begin_trajectory(state: np.ndarray, xva: np.ndarray, par: np.ndarray) -> None:
    """Set the trajectory with whose velocity and acceleration the aircraft accelerates as it does."""
    r = state[TRAJECTORY:].reshape(3, 3)
    assign(state[TRAJECTORY:], xva[:3].ravel())
    resistance = drag(xva[1, 0], xva[1, 1], par)
    for i in range(2):
        r[2, i] -= resistance[i]
        r[0, i] += (par[VEL_D] * r[2, i] + resistance[i] - xva[3, i]) / (par[VEL_P] * par[POS_P])


@nb.njit(cache=True, error_model="numpy", nogil=True)
def follow(
    state: np.ndarray, segments: np.ndarray, xva: np.ndarray, par: np.ndarray, dt: float, out: np.ndarray
) -> None:
    """Simulate the flight along the segments, (n, N_COLUMNS), from a state of `begin_trajectory`.

    The other arguments are as of `copter_legs.follow`. A climb in place gets the place where it begins.
    """
    r, target, acc = state[TRAJECTORY:].reshape(3, 3), np.zeros(3), np.full(3, par[ACC])
    h = dt / _SUBSTEPS
    for row in range(len(out)):
        assign(out[row], xva[0])
        for _ in range(_SUBSTEPS):
            _velocity_target(state, segments, (xva[0], r), par, target)
            acc[2] = par[ACC_UP] if target[2] < 0.0 else par[ACC_DOWN]
            if _lifts_off(segments[int(state[SEGMENT])], xva[0], par):
                acc[2], r[0, 2] = min(acc[2], par[TAKEOFF_SPEED] / par[RAMP]), xva[0, 2]
            ahead_n, ahead_e = r[0, 0] - xva[0, 0], r[0, 1] - xva[0, 1]
            stretch = 1.0
            if ahead_n * r[1, 0] + ahead_e * r[1, 1] >= 0.0:
                stretch -= min(sqrt(ahead_n**2 + ahead_e**2) / par[MAX_LAG], 1.0)
            before = r.copy()
            _step(r, target, acc, par[JERK], h * stretch)
            track_reference(xva, 0.5 * (before + r), par, h)
            if segments[int(state[SEGMENT]), PHASE] == LANDING:
                xva[0, 2] = min(xva[0, 2], par[GROUND])
            _arrive(state, segments, xva, par, h)


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _arrive(state: np.ndarray, segments: np.ndarray, xva: np.ndarray, par: np.ndarray, dt: float) -> None:
    k = int(state[SEGMENT])
    segment = segments[k]
    n, e, d = segment[B_N] - xva[0, 0], segment[B_N + 1] - xva[0, 1], segment[B_N + 2] - xva[0, 2]
    near = abs(d) < par[ACCEPT_Z] and sqrt(n * n + e * e) < par[ACCEPT]
    if segment[PHASE] == TAKEOFF:
        near = d > -par[ACCEPT_Z]
    if state[WAIT] > 0.0 or near or _is_wait(segment):
        state[WAIT] += dt
        if state[WAIT] >= segment[HOLD] and k + 1 < len(segments):
            state[SEGMENT], state[WAIT] = k + 1.0, 0.0
            if segments[k + 1, PHASE] == CLIMB_IN_PLACE:
                segments[k + 1, B_N], segments[k + 1, B_N + 1] = xva[0, 0], xva[0, 1]
                assign(segments[k + 1, A_N : A_N + 3], xva[0])
