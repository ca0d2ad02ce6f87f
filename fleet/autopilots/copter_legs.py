"""ArduCopter's waypoint navigation: legs as jerk-limited profiles of time that overlap at corners, and circles.

    s(t)            seven phases of constant jerk from rest to rest, within speed, acceleration and jerk of the leg,
                    that a jerk rising as a cosine over 2 ATC_INPUT_TC delays by half of this time
    r = sum of the present leg, the rest of the one before and the begin of the next
    t' = clip(0.05 + (v . d - P (r - x) . d) / |r'|, 0, 1), first-order lag WPNAV_ACCEL / WPNAV_JERK
    x''' = (r'' + Pv e + D e' + b - x'') / tau,   e = r' + P (r - x) - x',   b' = I e - k x''   position loop, attitude

The next leg begins when the path between both deviates from the corner by less than WPNAV_RADIUS and its acceleration
stays below the corner limit half-way to the end of the present one. A circle starts from rest with angular acceleration
max(a / R, 2 deg/s2) and has a speed of at most sqrt(a R / 2); the leg after it starts at the stopping point.

Source: ArduCopter 4.x documentation of waypoint navigation (S-curves), circle mode and position control.
"""

from math import atan2, cos, exp, radians, sin, sqrt

import numba as nb
import numpy as np

from fleet.autopilots.copter import A_N, ACC, B_N, HOLD, N_SEGMENT, SPEED

LAW = "copter: jerk-limited legs that overlap at corners, behind the position loop"

RADIUS, TURN, C_N, C_E = N_SEGMENT, N_SEGMENT + 1, N_SEGMENT + 2, N_SEGMENT + 3
"""Columns of a circle: radius [m], signed angle [rad], centre [m]; angle 0 is a straight leg."""
SPEED_BEFORE, LEG_JERK = N_SEGMENT + 4, N_SEGMENT + 5
"""Columns of a leg: speed with which it is planned before the corner [m/s], its jerk if it has its own [m/s3]; or 0."""
N_COLUMNS = N_SEGMENT + 6

# state of the navigation: segment; time on it, on the one before (-1: over) and on the next (-1: not begun) [s]; time
# waited at its end [s]; time scale [-]; angle, rate and angle flown of a circle [rad, rad/s, rad]; start of the leg [m]
# speed limit of the leg, if not that of the segment, and of the one before [m/s]
SEGMENT, T, TAIL, LEAD, WAIT, SCALE, ANGLE, RATE, TURNED, START_N, START_E, START_D, TOP, TAIL_TOP = range(14)
N_STATE = 14

# parameters: gains [1/s], lag of the attitude [s], jerk [m/s3], WPNAV_RADIUS [m], corner and horizontal limit [m/s2],
# integral and derivative of the horizontal velocity [1/s2, -], time in which the jerk rises [s], whether the derivative
# is of the error (1) or of the velocity alone (0), drag over mass and airspeed [1/s]
POS_P, VEL_P, POS_P_Z, VEL_P_Z, TAU, JERK, WP_RADIUS, ACC_CORNER, ACC_MAX, ACC_XY = range(10)
VEL_I, VEL_D, JERK_TIME, D_OF_ERROR, DRAG = range(10, 15)
N_PAR = 15

_SUBSTEPS = 2
_MIN_CIRCLE_ACC = radians(2.0)  # angular [rad/s2]
_LOOK_S = 12.0  # time before the end of a leg within which the next may begin [s]
_TAU_Z = 0.1  # lag of the thrust [s]


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _plan(segment: np.ndarray, top: float, start: np.ndarray, par: np.ndarray, out: np.ndarray) -> None:
    """Plan a leg: direction (3), length, jerk time, constant acceleration time, cruise time, duration, delay, jerk."""
    jerk, rise = segment[LEG_JERK] if segment[LEG_JERK] > 0.0 else par[JERK], par[JERK_TIME]
    out[9] = jerk
    length = 0.0
    for i in range(3):
        out[i] = segment[B_N + i] - start[i]
        length += out[i] ** 2
    length = sqrt(length)
    for i in range(3):
        out[i] = out[i] / length if length > 1e-6 else 0.0
    acc, speed = segment[ACC], top if top > 0.0 else segment[SPEED]
    if length >= 2.0 * acc**3 / jerk**2:
        ramps = acc / jerk + rise
        peak = 0.5 * acc * (sqrt(ramps**2 + 4.0 * length / acc) - ramps)
    else:
        peak = jerk * (0.5 * length / jerk) ** (2.0 / 3.0)
    speed = max(min(speed, peak), 1e-6)
    ramp = min(acc / jerk, sqrt(speed / jerk))
    steady = max(speed / (ramp * jerk) - ramp, 0.0)
    cruise = max(length - speed * (2.0 * ramp + steady), 0.0) / speed
    out[3], out[4], out[5], out[6], out[8] = length, ramp, steady, cruise, 0.5 * rise
    out[7] = 4.0 * ramp + 2.0 * steady + cruise + rise


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _at(plan: np.ndarray, t: float) -> tuple[float, float, float]:
    """Return distance, speed and acceleration of a planned leg at a time."""
    jerk = plan[9]
    if t >= plan[7]:
        return plan[3], 0.0, 0.0
    backward = t > 0.5 * plan[7]  # the profile is symmetric
    left = max((plan[7] - t if backward else t) - plan[8], 0.0)
    s, v, a = 0.0, 0.0, 0.0
    for phase in range(4):
        h = min(left, plan[4] if phase % 2 == 0 else plan[5] if phase == 1 else plan[6])
        j = jerk if phase == 0 else -jerk if phase == 2 else 0.0
        s += h * (v + h * (0.5 * a + h * j / 6.0))
        v += h * (a + 0.5 * h * j)
        a += h * j
        left -= h
        if left <= 0.0:
            break
    return (plan[3] - s, v, -a) if backward else (s, v, a)


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _may_begin(plan: np.ndarray, t: float, following: np.ndarray, par: np.ndarray) -> bool:
    """Return whether the next leg may begin now."""
    left = plan[7] - t
    if left < 0.0 or left > _LOOK_S or left >= 0.5 * following[7]:
        return False
    s0, v0, a0 = _at(plan, t + 0.5 * left)
    s1, v1, a1 = _at(following, 0.5 * left)
    deviation, speed, acceleration = 0.0, 0.0, 0.0
    for i in range(3):
        deviation += (plan[i] * (s0 - plan[3]) + following[i] * s1) ** 2
        if i < 2:
            speed += (plan[i] * v0 + following[i] * v1) ** 2
            acceleration += (plan[i] * a0 + following[i] * a1) ** 2
    top = min(plan[9] * plan[4] * (plan[4] + plan[5]), following[9] * following[4] * (following[4] + following[5]))
    return deviation < par[WP_RADIUS] ** 2 and speed < top**2 and acceleration < par[ACC_CORNER] ** 2


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _speed_after_change(segment: np.ndarray, v: float, a: float, par: np.ndarray) -> float:
    """Return the speed limit of a leg that has begun when the commanded speed changes; 0: that of the segment.

    Acceleration ends as soon as its jerk permits; a leg that already decelerates is flown as planned.
    """
    before = segment[SPEED_BEFORE]
    if not before > segment[SPEED]:
        return 0.0
    if a < 0.0:
        return before
    return min(max(segment[SPEED], v + 0.5 * a * (a / par[JERK] + par[JERK_TIME])), before)


@nb.njit(cache=True, error_model="numpy", nogil=True)
def stopping_time(speed: float, gain: float, acc: float) -> float:
    """Return the distance in which the position loop stops, over the speed [s]."""
    return 1.0 / gain if speed <= acc / gain else 0.5 * (speed / acc + acc / (gain * gain * speed))


@nb.njit(cache=True, error_model="numpy", nogil=True)
def navigate(
    state: np.ndarray, segments: np.ndarray, xv: np.ndarray, par: np.ndarray, dt: float, r: np.ndarray
) -> None:
    """Advance the navigation by dt.

    Args:
        state: changed in place, (N_STATE,)
        segments: (n, N_COLUMNS), n > 0
        xv: position and velocity of the aircraft, (2, 3) [m, m/s]
        par: (N_PAR,)
        dt: step [s]
        r: reference position, velocity, acceleration, filled in, (3, 3)
    """
    k = int(state[SEGMENT])
    segment = segments[k]
    if segment[TURN] != 0.0:
        _circle(state, segments, xv, par, dt, r)
        return
    plan, other = np.empty(10), np.empty(10)
    _plan(segment, state[TOP], state[START_N : START_D + 1], par, plan)
    step = dt * state[SCALE]
    state[T] += step
    s, v, a = _at(plan, state[T])
    for i in range(3):
        r[0, i], r[1, i], r[2, i] = state[START_N + i] + plan[i] * s, plan[i] * v, plan[i] * a
    if state[TAIL] >= 0.0 and k > 0:
        _plan(segments[k - 1], state[TAIL_TOP], segments[k - 1, A_N : A_N + 3], par, other)
        state[TAIL] += step
        s, v, a = _at(other, state[TAIL])
        for i in range(3):
            r[0, i] += other[i] * (s - other[3])
            r[1, i] += other[i] * v
            r[2, i] += other[i] * a
        if state[TAIL] >= other[7]:
            state[TAIL] = -1.0
    more = k + 1 < len(segments)
    if segment[HOLD] <= 0.0 and more and segments[k + 1, TURN] == 0.0:
        _plan(segments[k + 1], segments[k + 1, SPEED_BEFORE], segments[k + 1, A_N : A_N + 3], par, other)
        if state[LEAD] < 0.0 and _may_begin(plan, state[T], other, par):
            state[LEAD] = 0.0
        if state[LEAD] >= 0.0:
            state[LEAD] += step
            s, v, a = _at(other, state[LEAD])
            for i in range(3):
                r[0, i] += other[i] * s
                r[1, i] += other[i] * v
                r[2, i] += other[i] * a
            if state[LEAD] >= plan[7] - state[T]:
                state[SEGMENT] += 1.0
                state[TAIL], state[T], state[LEAD], state[WAIT] = state[T], state[LEAD], -1.0, 0.0
                state[TAIL_TOP], state[TOP] = state[TOP], _speed_after_change(segments[k + 1], v, a, par)
                state[START_N : START_D + 1] = segments[k + 1, A_N : A_N + 3]
                return
    _scale(state, xv, par, dt, r)
    if state[T] < plan[7] or state[LEAD] >= 0.0:
        return
    distance = 0.0
    for i in range(3):
        distance += (xv[0, i] - segment[B_N + i]) ** 2
    if state[WAIT] > 0.0 or distance < par[WP_RADIUS] ** 2:
        state[WAIT] += dt
        if state[WAIT] >= segment[HOLD] and more:
            state[SEGMENT] += 1.0
            state[T], state[TAIL], state[LEAD], state[WAIT], state[TOP] = 0.0, -1.0, -1.0, 0.0, 0.0
            state[START_N : START_D + 1] = segments[k + 1, A_N : A_N + 3]
            if segments[k + 1, TURN] != 0.0:
                begin_circle(state, segments[k + 1], xv[0], 0.0)


@nb.njit(cache=True, error_model="numpy", nogil=True)
def begin_circle(state: np.ndarray, segment: np.ndarray, x: np.ndarray, rate: float) -> None:
    """Set the state at the begin of a circle, or within it with an angular rate [rad/s]."""
    state[ANGLE] = atan2(x[1] - segment[C_E], x[0] - segment[C_N])
    state[RATE], state[TURNED] = rate, 0.0


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _circle(state: np.ndarray, segments: np.ndarray, xv: np.ndarray, par: np.ndarray, dt: float, r: np.ndarray) -> None:
    k = int(state[SEGMENT])
    segment = segments[k]
    radius, sense = segment[RADIUS], 1.0 if segment[TURN] > 0.0 else -1.0
    top = min(segment[SPEED], sqrt(0.5 * par[ACC_XY] * radius)) / radius
    state[RATE] = min(state[RATE] + max(par[ACC_XY] / radius, _MIN_CIRCLE_ACC) * dt, top)
    state[ANGLE] += sense * state[RATE] * dt
    state[TURNED] += state[RATE] * dt
    c, s = cos(state[ANGLE]), sin(state[ANGLE])
    r[0, 0], r[0, 1], r[0, 2] = segment[C_N] + radius * c, segment[C_E] + radius * s, segment[B_N + 2]
    r[1, 0], r[1, 1], r[1, 2] = -sense * state[RATE] * radius * s, sense * state[RATE] * radius * c, 0.0
    r[2, 0], r[2, 1], r[2, 2] = -(state[RATE] ** 2) * radius * c, -(state[RATE] ** 2) * radius * s, 0.0
    if state[TURNED] >= abs(segment[TURN]) and k + 1 < len(segments):
        state[SEGMENT] += 1.0
        state[T], state[TAIL], state[LEAD], state[WAIT], state[TOP] = 0.0, -1.0, -1.0, 0.0, 0.0
        stop_s = stopping_time(sqrt(xv[1, 0] ** 2 + xv[1, 1] ** 2 + xv[1, 2] ** 2), par[POS_P], par[ACC_XY])
        for i in range(3):
            state[START_N + i] = xv[0, i] + xv[1, i] * stop_s
        if segments[k + 1, TURN] != 0.0:
            begin_circle(state, segments[k + 1], xv[0], 0.0)


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _scale(state: np.ndarray, xv: np.ndarray, par: np.ndarray, dt: float, r: np.ndarray) -> None:
    speed = sqrt(r[1, 0] ** 2 + r[1, 1] ** 2 + r[1, 2] ** 2)
    scale_c = 1.0
    if speed > 0.1:
        behind, along = 0.0, 0.0
        for i in range(3):
            behind += (r[0, i] - xv[0, i]) * r[1, i] / speed
            along += xv[1, i] * r[1, i] / speed
        scale_c = min(max(0.05 + (along - par[POS_P] * behind) / speed, 0.0), 1.0)
    state[SCALE] += (scale_c - state[SCALE]) * min(dt * par[JERK] / par[ACC_XY], 1.0)


@nb.njit(cache=True, error_model="numpy", nogil=True)
def track_reference(xva: np.ndarray, r: np.ndarray, par: np.ndarray, dt: float) -> None:
    """Advance the aircraft behind a reference (3, 3), that in the middle of the step, by dt.

    `xva` (4, 3) has position, velocity, acceleration, and the integrator less the drag that it has to balance [m/s2].
    """
    a, error = np.empty(3), np.empty(3)
    for i in range(3):
        pos_p, vel_p = (par[POS_P], par[VEL_P]) if i < 2 else (par[POS_P_Z], par[VEL_P_Z])
        error[i] = r[1, i] + pos_p * (r[0, i] - xva[0, i]) - xva[1, i]
        a[i] = r[2, i] + vel_p * error[i]
        if i < 2:
            target = par[D_OF_ERROR] * (r[2, i] + pos_p * (r[1, i] - xva[1, i]))
            a[i] += xva[3, i] + par[VEL_D] * (target - xva[2, i])
    excess = max(sqrt(a[0] ** 2 + a[1] ** 2) / par[ACC_MAX], 1.0)
    # beyond the limit the integrator only decreases
    integrates = excess == 1.0 or error[0] * a[0] + error[1] * a[1] < 0.0
    for i in range(2):
        xva[3, i] += dt * (par[VEL_I] * error[i] * integrates - par[DRAG] * xva[2, i])
    for i in range(3):
        limited = a[i] / excess if i < 2 else min(max(a[2], -5.0), 5.0)
        change = (limited - xva[2, i]) * (1.0 - exp(-dt / (par[TAU] if i < 2 else _TAU_Z)))
        xva[0, i] += dt * (xva[1, i] + dt * (0.5 * xva[2, i] + change / 6.0))
        xva[1, i] += dt * (xva[2, i] + 0.5 * change)
        xva[2, i] += change


@nb.njit(cache=True, error_model="numpy", nogil=True)
def follow(
    state: np.ndarray, segments: np.ndarray, xva: np.ndarray, par: np.ndarray, dt: float, out: np.ndarray
) -> None:
    """Simulate the flight along the segments.

    Args:
        state: of the navigation, changed in place, (N_STATE,)
        segments: (n, N_COLUMNS), n > 0
        xva: as of `track_reference` at the start, changed in place, (4, 3)
        par: (N_PAR,)
        dt: step [s]
        out: positions, filled in, NED, (k, 3) [m]; out[0] is the start
    """
    r = np.zeros((3, 3))
    navigate(state, segments, xva[:2], par, 0.0, r)
    for k in range(len(out)):
        out[k] = xva[0]
        for _ in range(_SUBSTEPS):
            _step(state, segments, xva, r, (par, dt / _SUBSTEPS))


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _step(
    state: np.ndarray, segments: np.ndarray, xva: np.ndarray, r: np.ndarray, par_dt: tuple[np.ndarray, float]
) -> None:
    par, dt = par_dt
    before = r.copy()
    navigate(state, segments, xva[:2], par, dt, r)
    track_reference(xva, 0.5 * (before + r), par, dt)


@nb.njit(cache=True, error_model="numpy", nogil=True)
def simulated_states(
    segments: np.ndarray, last: int, par: np.ndarray, dt: float, states: np.ndarray, simulated: np.ndarray
) -> int:
    """Simulate the flight from rest at the first segment; return the number of rows.

    Args:
        segments, par, dt: as of `follow`
        last: segment after whose end the run stops
        states: state of the navigation after each step, filled in, (n, N_STATE)
        simulated: position, velocity, acceleration of the aircraft after each step, filled in, (n, 3, 3)
    """
    state, r, xva = np.zeros(N_STATE), np.zeros((3, 3)), np.zeros((4, 3))
    state[TAIL], state[LEAD], state[SCALE] = -1.0, -1.0, 1.0
    state[START_N : START_D + 1] = segments[0, A_N : A_N + 3]
    xva[0] = segments[0, A_N : A_N + 3]
    if segments[0, TURN] != 0.0:
        begin_circle(state, segments[0], xva[0], 0.0)
    r[0] = xva[0]
    for k in range(len(states)):
        for _ in range(_SUBSTEPS):
            _step(state, segments, xva, r, (par, dt / _SUBSTEPS))
        states[k], simulated[k] = state, xva[:3]
        if state[SEGMENT] > last or (state[WAIT] > 0.0 and segments[int(state[SEGMENT]), HOLD] > 1e6):
            return k + 1
    return len(states)
