"""ArduCopter's waypoint navigation: legs as jerk-limited profiles of time that overlap at corners, circles, landing.

    s(t)            seven phases of constant jerk from rest to rest, within speed, acceleration and jerk of the leg,
                    that a jerk rising as a cosine over 2 ATC_INPUT_TC delays by half of this time
    r = sum of the present leg, the rest of the one before and the begin of the next
    t' = clip(0.05 + (v . d - P (r - x) . d) / |r'|, 0, 1), first-order lag WPNAV_ACCEL / WPNAV_JERK

The next leg begins in the deceleration of the present one, when it still accelerates at the end of that, the path
between both deviates from the corner by less than WPNAV_RADIUS and its acceleration stays below the corner limit
half-way. On a circle a point, from rest with angular acceleration max(a / R, 2 deg/s2) to at most sqrt(a R / 2), is the
target of `shape_position`. Circle and leg after it begin at rest at the stopping point; the integrator gets the present
tilt. The landing descends at sq(height - LAND_ALT_LOW) between LAND_SPEED and the limit.

Source: ArduCopter 4.7 documentation and behaviour of waypoint navigation (S-curves), circle mode, land mode.
"""

from math import atan2, cos, pi, radians, sin, sqrt

import numba as nb
import numpy as np

from fleet.autopilots.copter import A_N, ACC, B_N, HOLD, N_SEGMENT, SPEED
from fleet.autopilots.position_loop import (
    ACC_CORNER,
    ACC_XY,
    ACC_Z,
    JERK,
    JERK_TIME,
    POS_P,
    POS_P_Z,
    WP_RADIUS,
    drag,
    shape_position,
    square_root_control,
    stopping_time,
    track_reference,
)
from fleet.compiled_frames import assign

LAW = "copter: jerk-limited legs that overlap at corners, behind the position loop"

RADIUS, TURN, C_N, C_E = N_SEGMENT, N_SEGMENT + 1, N_SEGMENT + 2, N_SEGMENT + 3
"""Columns of a circle: radius [m], signed angle [rad], centre [m]; angle 0 is a straight leg."""
SPEED_BEFORE, LEG_JERK = N_SEGMENT + 4, N_SEGMENT + 5
"""Columns of a leg: speed with which it is planned before the corner [m/s], its jerk if it has its own [m/s3]; or 0."""
DESCENT, LOW = N_SEGMENT + 6, N_SEGMENT + 7
"""Columns of a landing: its speed limit [m/s], 0 for a leg; height over its end from which on it is slow [m]."""
N_COLUMNS = N_SEGMENT + 8

# state of the navigation: segment; time on it, on the one before (-1: over) and on the next (-1: not begun) [s]; time
# waited at its end [s]; time scale [-]; angle, rate and angle flown of a circle [rad, rad/s, rad]; start of the leg [m]
# speed limit of the leg, if not that of the segment, and of the one before [m/s]; shaped position, velocity and
# acceleration of a circle, two each, or of a landing, one each
SEGMENT, T, TAIL, LEAD, WAIT, SCALE, ANGLE, RATE, TURNED, START_N, START_E, START_D, TOP, TAIL_TOP = range(14)
SHAPED = 14
N_STATE = 20

_SUBSTEPS = 2
_SHAPING_STEPS = 4  # of the target of a circle in one step of the navigation
_MIN_CIRCLE_ACC = radians(2.0)  # angular [rad/s2]

# plan of a leg: direction (3), length, duration, delay, jerk, speed limit; then of acceleration, change of speed and
# deceleration the time of each jerk and of constant acceleration, sense of the change, cruise time
_LENGTH, _END, _DELAY, _JERK, _LIMIT, _UP, _CHANGE, _DOWN, _SENSE, _CRUISE = 3, 4, 5, 6, 7, 8, 10, 12, 14, 15
_N_PLAN = 16
_PLACE_M = 0.01  # rounding of a place: 1e-7 deg, 1 cm [m]
_CHANGE_RISES = 12.0  # of the jerk that a change of speed within a leg needs at least


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _ramp(change: float, acc: float, jerk: float, out: np.ndarray) -> float:
    """Plan a change of speed: time of each jerk and of constant acceleration, (2,); return the mean time."""
    out[0] = min(acc / jerk, sqrt(change / jerk))
    out[1] = max(change / max(out[0] * jerk, 1e-9) - out[0], 0.0)
    return out[0] + 0.5 * out[1]


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _plan(segment: np.ndarray, top: float, start: np.ndarray, par: np.ndarray, out: np.ndarray) -> None:
    """Plan a leg, (_N_PLAN,): to the speed `top` if it is not 0, and from there to that of the segment."""
    jerk, rise = segment[LEG_JERK] if segment[LEG_JERK] > 0.0 else par[JERK], par[JERK_TIME]
    out[:] = 0.0
    length = 0.0
    for i in range(3):
        out[i] = segment[B_N + i] - start[i]
        length += out[i] ** 2
    length = sqrt(length)
    for i in range(3):
        out[i] = out[i] / length if length > 1e-6 else 0.0
    acc, speed = segment[ACC], top if top > 0.0 else segment[SPEED]
    out[_LENGTH], out[_LIMIT], out[_JERK] = length, segment[SPEED], jerk
    if length < 8.0 * jerk * rise**3:  # the jerk is not reached: four pulses of twice the rise
        snap = 0.5 * pi * jerk / rise
        rise = (pi * length / (16.0 * snap)) ** 0.25
        out[_UP : _UP + 2] = out[_DOWN : _DOWN + 2] = rise
        out[_CRUISE], out[_DELAY], out[_END], out[_JERK] = rise, 0.5 * rise, 8.0 * rise, 2.0 * snap * rise / pi
        return
    if length >= 2.0 * acc**3 / jerk**2:
        ramps = acc / jerk + rise
        peak = 0.5 * acc * (sqrt(ramps**2 + 4.0 * length / acc) - ramps)
    else:
        peak = jerk * (0.5 * length / jerk) ** (2.0 / 3.0)
    speed = max(min(speed, peak), 1e-6)
    time = _ramp(speed, acc, jerk, out[_UP : _UP + 2])
    last, distance = speed, 2.0 * speed * time
    change = segment[SPEED] - speed
    if top > 0.0 and abs(change) > 1e-3 and length - distance > _CHANGE_RISES * rise * speed:
        longest = (length - distance) / (_CHANGE_RISES * rise)
        last = min(segment[SPEED], longest) if change > 0.0 else segment[SPEED]
        out[_SENSE] = 1.0 if change > 0.0 else -1.0
        over = _ramp(abs(last - speed), acc, jerk, out[_CHANGE : _CHANGE + 2])
        distance = speed * time + (speed + last) * over
        distance += last * _ramp(last, acc, jerk, out[_DOWN : _DOWN + 2])
    else:
        assign(out[_DOWN : _DOWN + 2], out[_UP : _UP + 2])
    out[_CRUISE], out[_DELAY] = max(length - distance, 0.0) / last, 0.5 * rise
    out[_END] = rise + out[_CRUISE]
    for part in (_UP, _CHANGE, _DOWN):
        out[_END] += 2.0 * out[part] + out[part + 1]


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _at(plan: np.ndarray, t: float) -> tuple[float, float, float]:
    """Return distance, speed and acceleration of a planned leg at a time."""
    if t >= plan[_END]:
        return plan[_LENGTH], 0.0, 0.0
    left = max(t - plan[_DELAY], 0.0)
    s, v, a = 0.0, 0.0, 0.0
    for phase in range(10):
        h, sense = plan[_CRUISE], 0.0
        if phase != 6:
            part = _UP if phase < 3 else _CHANGE if phase < 6 else _DOWN
            step = phase % 3 if phase < 6 else phase - 7
            h = plan[part + step % 2]
            sense = (1.0 if part == _UP else plan[_SENSE] if part == _CHANGE else -1.0) * (1.0 - step)
        h = min(left, h)
        j = sense * plan[_JERK]
        s += h * (v + h * (0.5 * a + h * j / 6.0))
        v += h * (a + 0.5 * h * j)
        a += h * j
        left -= h
        if left <= 0.0:
            break
    return min(s, plan[_LENGTH]), max(v, 0.0), a


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _may_begin(plan: np.ndarray, t: float, following: np.ndarray, par: np.ndarray) -> bool:
    """Return whether the next leg may begin now."""
    left = plan[_END] - t
    braking = 2.0 * plan[_DOWN] + plan[_DOWN + 1] + 2.0 * plan[_DELAY]
    accelerating = 2.0 * following[_UP] + following[_UP + 1] + 2.0 * following[_DELAY]
    if left < 0.0 or left > min(braking, accelerating):
        return False
    s0, v0, a0 = _at(plan, t + 0.5 * left)
    s1, v1, a1 = _at(following, 0.5 * left)
    deviation, speed, acceleration = 0.0, 0.0, 0.0
    for i in range(3):
        deviation += (plan[i] * (s0 - plan[_LENGTH]) + following[i] * s1) ** 2
        speed += (plan[i] * v0 + following[i] * v1) ** 2
        if i < 2:
            acceleration += (plan[i] * a0 + following[i] * a1) ** 2
    level = abs(plan[2] * a0 + following[2] * a1) < par[ACC_Z]
    slow = speed < min(plan[_LIMIT], following[_LIMIT]) ** 2
    return level and slow and deviation < par[WP_RADIUS] ** 2 and acceleration < par[ACC_CORNER] ** 2


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _speed_after_change(segment: np.ndarray, v: float, a: float, par: np.ndarray) -> float:
    """Return the speed that a leg begun before a commanded change reaches, before it changes; 0: as planned.

    The acceleration reaches its limit in any case, and ends then as soon as its jerk permits.
    """
    before, acc = segment[SPEED_BEFORE], segment[ACC]
    if not before > 0.0:
        return 0.0
    if a < 0.0 or before <= segment[SPEED]:
        return before
    if a < 0.999 * acc:
        v, a = max(v - 0.5 * a * a / par[JERK], 0.0), acc
        v += 0.5 * a * (a / par[JERK] + par[JERK_TIME])
    return min(max(segment[SPEED], v + 0.5 * a * (a / par[JERK] + par[JERK_TIME])), before)


@nb.njit(cache=True, error_model="numpy", nogil=True)
def navigate(
    state: np.ndarray, segments: np.ndarray, xva: np.ndarray, par: np.ndarray, dt: float, r: np.ndarray
) -> None:
    """Advance the navigation by dt.

    Args:
        state: changed in place, (N_STATE,)
        segments: (n, N_COLUMNS), n > 0
        xva: as of `track_reference`, (4, 3); the integrator is set at the begin of a circle and of the leg after it
        par: (N_PAR,)
        dt: step [s]
        r: reference position, velocity, acceleration, filled in, (3, 3)
    """
    k = int(state[SEGMENT])
    segment = segments[k]
    if segment[TURN] != 0.0:
        _circle(state, segments, xva, par, dt, r)
        return
    if segment[DESCENT] > 0.0:
        _descend(state, segment, xva, par, dt, r)
        return
    plan, other = np.empty(_N_PLAN), np.empty(_N_PLAN)
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
            r[0, i] += other[i] * (s - other[_LENGTH])
            r[1, i] += other[i] * v
            r[2, i] += other[i] * a
        if state[TAIL] >= other[_END]:
            state[TAIL] = -1.0
    more = k + 1 < len(segments)
    if segment[HOLD] <= 0.0 and more and segments[k + 1, TURN] == 0.0 and segments[k + 1, DESCENT] == 0.0:
        _plan(segments[k + 1], segments[k + 1, SPEED_BEFORE], segments[k + 1, A_N : A_N + 3], par, other)
        other[_LIMIT] = max(other[_LIMIT], segments[k + 1, SPEED_BEFORE])
        if state[LEAD] < 0.0 and _may_begin(plan, state[T], other, par):
            state[LEAD] = 0.0
        if state[LEAD] >= 0.0:
            state[LEAD] += step
            s, v, a = _at(other, state[LEAD])
            for i in range(3):
                r[0, i] += other[i] * s
                r[1, i] += other[i] * v
                r[2, i] += other[i] * a
            if state[LEAD] >= plan[_END] - state[T]:
                state[SEGMENT] += 1.0
                state[TAIL], state[T], state[LEAD], state[WAIT] = state[T], state[LEAD], -1.0, 0.0
                state[TAIL_TOP], state[TOP] = state[TOP], _speed_after_change(segments[k + 1], v, a, par)
                assign(state[START_N : START_D + 1], segments[k + 1, A_N : A_N + 3])
                return
    if segment[LEG_JERK] == 0.0:  # a take-off does not wait for the aircraft
        _scale(state, xva, par, dt, r)
    if state[T] < plan[_END] or state[LEAD] >= 0.0:
        return
    distance = 0.0
    for i in range(3):
        distance += (xva[0, i] - segment[B_N + i]) ** 2
    if state[WAIT] > 0.0 or distance < par[WP_RADIUS] ** 2:
        state[WAIT] += dt
        if state[WAIT] >= segment[HOLD] and more:
            _begin_segment(state, segments, xva, par)


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _begin_segment(state: np.ndarray, segments: np.ndarray, xva: np.ndarray, par: np.ndarray) -> None:
    """Begin the next segment from rest at the end of the last one, a circle and a landing at the aircraft."""
    k = int(state[SEGMENT]) + 1
    state[SEGMENT] = k
    state[T], state[TAIL], state[LEAD], state[WAIT], state[TOP] = 0.0, -1.0, -1.0, 0.0, 0.0
    assign(state[START_N : START_D + 1], segments[k, A_N : A_N + 3])
    if segments[k, HOLD] == 0.0 and abs(segments[k, B_N + 2] - segments[k, A_N + 2]) < _PLACE_M:
        # a return first climbs from the stopping point to the present height, if no further
        state[START_D] = segments[k, B_N + 2] + max(_PLACE_M, abs(xva[1, 2]) / par[POS_P_Z])
    if segments[k, TURN] != 0.0:
        begin_circle(state, segments[k], xva, par)
    elif segments[k, DESCENT] > 0.0:
        state[SHAPED], state[SHAPED + 1], state[SHAPED + 2] = segments[k, A_N + 2], 0.0, 0.0


@nb.njit(cache=True, error_model="numpy", nogil=True)
def begin_circle(state: np.ndarray, segment: np.ndarray, xva: np.ndarray, par: np.ndarray) -> None:
    """Set the state at the begin of a circle: at rest at the stopping point, with the present tilt integrated."""
    stop_s = stopping_time(sqrt(xva[1, 0] ** 2 + xva[1, 1] ** 2), par[POS_P], par[ACC_XY])
    for i in range(2):
        state[SHAPED + i] = xva[0, i] + xva[1, i] * stop_s
        state[SHAPED + 2 + i] = state[SHAPED + 4 + i] = 0.0
        xva[3, i] = xva[2, i]
    state[ANGLE] = atan2(state[SHAPED + 1] - segment[C_E], state[SHAPED] - segment[C_N])
    state[RATE], state[TURNED] = 0.0, 0.0


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _circle(
    state: np.ndarray, segments: np.ndarray, xva: np.ndarray, par: np.ndarray, dt: float, r: np.ndarray
) -> None:
    k = int(state[SEGMENT])
    segment, shaped = segments[k], state[SHAPED : SHAPED + 6]
    radius, sense = segment[RADIUS], 1.0 if segment[TURN] > 0.0 else -1.0
    top = min(segment[SPEED], sqrt(0.5 * par[ACC_XY] * radius)) / radius
    h = dt / _SHAPING_STEPS
    for _ in range(_SHAPING_STEPS if dt > 0.0 else 0):
        state[RATE] = min(state[RATE] + max(par[ACC_XY] / radius, _MIN_CIRCLE_ACC) * h, top)
        state[ANGLE] += sense * state[RATE] * h
        state[TURNED] += state[RATE] * h
        target = (segment[C_N] + radius * cos(state[ANGLE]), segment[C_E] + radius * sin(state[ANGLE]))
        shape_position(shaped, target, segment[SPEED_BEFORE], par, h)
    for i in range(2):
        r[0, i], r[1, i], r[2, i] = shaped[i], shaped[2 + i], shaped[4 + i]
    r[0, 2], r[1, 2], r[2, 2] = segment[B_N + 2], 0.0, 0.0
    if state[TURNED] >= abs(segment[TURN]) and k + 1 < len(segments):
        _begin_segment(state, segments, xva, par)
        if segments[k + 1, TURN] != 0.0:
            return
        stop_s = stopping_time(sqrt(xva[1, 0] ** 2 + xva[1, 1] ** 2), par[POS_P], par[ACC_XY])
        for i in range(2):
            state[START_N + i] = xva[0, i] + xva[1, i] * stop_s
            xva[3, i] = xva[2, i]
        state[START_D], state[SCALE] = xva[0, 2], 1.0


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _descend(
    state: np.ndarray, segment: np.ndarray, xva: np.ndarray, par: np.ndarray, dt: float, r: np.ndarray
) -> None:
    low = segment[B_N + 2] - segment[LOW] - xva[0, 2]  # above the slow part [m]
    speed = square_root_control(max(low, 0.0), par[POS_P_Z], par[ACC_Z])
    speed = min(max(speed, segment[SPEED]), segment[DESCENT])
    change = min(max(speed - state[SHAPED + 1], -par[ACC_Z] * dt), par[ACC_Z] * dt)
    state[SHAPED + 1] += change
    state[SHAPED] = min(state[SHAPED] + dt * state[SHAPED + 1], segment[B_N + 2])
    r[:] = 0.0
    r[0, 0], r[0, 1], r[0, 2] = segment[B_N], segment[B_N + 1], state[SHAPED]
    r[1, 2] = state[SHAPED + 1] if state[SHAPED] < segment[B_N + 2] else 0.0
    state[T] += dt


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _scale(state: np.ndarray, xva: np.ndarray, par: np.ndarray, dt: float, r: np.ndarray) -> None:
    speed = sqrt(r[1, 0] ** 2 + r[1, 1] ** 2 + r[1, 2] ** 2)
    scale_c = 1.0
    if speed > 1e-3:
        behind, along = 0.0, 0.0
        for i in range(3):
            behind += (r[0, i] - xva[0, i]) * r[1, i] / speed
            along += xva[1, i] * r[1, i] / speed
        scale_c = min(max(0.05 + (along - par[POS_P] * behind) / speed, 0.0), 1.0)
    state[SCALE] += (scale_c - state[SCALE]) * min(dt * par[JERK] / par[ACC_XY], 1.0)


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
    navigate(state, segments, xva, par, 0.0, r)
    for k in range(len(out)):
        assign(out[k], xva[0])
        for _ in range(_SUBSTEPS):
            _step(state, segments, xva, r, par, dt / _SUBSTEPS)


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _step(state: np.ndarray, segments: np.ndarray, xva: np.ndarray, r: np.ndarray, par: np.ndarray, dt: float) -> None:
    before = r.copy()
    navigate(state, segments, xva, par, dt, r)
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
        simulated: as `xva` of `track_reference` after each step, filled in, (n, 4, 3)
    """
    state, r, xva = np.zeros(N_STATE), np.zeros((3, 3)), np.zeros((4, 3))
    state[TAIL], state[LEAD], state[SCALE] = -1.0, -1.0, 1.0
    assign(state[START_N : START_D + 1], segments[0, A_N : A_N + 3])
    assign(xva[0], segments[0, A_N : A_N + 3])
    xva[2:, 0], xva[2:, 1] = drag(0.0, 0.0, par)
    if segments[0, TURN] != 0.0:
        begin_circle(state, segments[0], xva, par)
    elif segments[0, DESCENT] > 0.0:
        state[SHAPED] = segments[0, A_N + 2]
    assign(r[0], xva[0])
    for k in range(len(states)):
        for _ in range(_SUBSTEPS):
            _step(state, segments, xva, r, par, dt / _SUBSTEPS)
        assign(states[k], state)
        assign(simulated[k].ravel(), xva.ravel())
        if state[SEGMENT] > last or (state[WAIT] > 0.0 and segments[int(state[SEGMENT]), HOLD] > 1e6):
            return k + 1
    return len(states)
