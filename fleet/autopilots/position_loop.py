"""Position loop of a multirotor, drag of its airframe, and ArduCopter's shaping of a position target.

    e = r' + sq(r - x) - x',   c = r'' + P e + I + D e',   I' = K e,   |c| <= g tan(tilt limit)      position loop
    f' = (c - f) / tau,   x'' = f - k1 u - k2 |u| u,   u = x' - w                                    tilt, drag, wind w
    s'' -> k (sq(q - s) n (1 - a n . s' / (k sq^2)) - s') with limited jerk,   k = jerk / a           target q, shaped s

sq is linear in a small distance and sqrt(2 a distance) in a large one; n is the direction to the target.
Source: ArduCopter 4.x documentation and behaviour of the position controller and of kinematic shaping; drag of
multirotors as in Faessler, Franchi & Scaramuzza 2018 (linear), with the quadratic part of the airframe.
"""

from math import exp, sqrt

import numba as nb
import numpy as np

from fleet.compiled_frames import assign

# parameters: gains [1/s], lag of the attitude [s], jerk [m/s3], WPNAV_RADIUS [m], corner and horizontal limit [m/s2],
# integral and derivative of the horizontal velocity [1/s2, -], time in which the jerk rises [s], whether the law is
# ArduCopter's (1) or PX4's (0), linear and quadratic drag over mass [1/s, 1/m], wind [m/s], jerk of shaping [m/s3],
# vertical acceleration [m/s2]
POS_P, VEL_P, POS_P_Z, VEL_P_Z, TAU, JERK, WP_RADIUS, ACC_CORNER, ACC_MAX, ACC_XY = range(10)
VEL_I, VEL_D, JERK_TIME, ARDUCOPTER, DRAG, DRAG_2, W_N, W_E, SHAPING_JERK, ACC_Z = range(10, 20)
N_PAR = 20

_TAU_Z = 0.1  # lag of the thrust [s]
_MAX_ACC_Z = 5.0  # [m/s2]


@nb.njit(cache=True, error_model="numpy", nogil=True)
def square_root_control(error: float, gain: float, limit: float) -> float:
    """Return the rate towards an error >= 0 that a deceleration `limit` can bring to zero."""
    linear = limit / (gain * gain)
    return error * gain if error <= linear else sqrt(2.0 * limit * (error - 0.5 * linear))


@nb.njit(cache=True, error_model="numpy", nogil=True)
def stopping_time(speed: float, gain: float, acc: float) -> float:
    """Return the distance in which the position loop stops, over the speed [s]."""
    return 1.0 / gain if speed <= acc / gain else 0.5 * (speed / acc + acc / (gain * gain * speed))


@nb.njit(cache=True, error_model="numpy", nogil=True)
def drag(v_n: float, v_e: float, par: np.ndarray) -> tuple[float, float]:
    """Return the deceleration by drag at a ground velocity, north and east [m/s2]."""
    u_n, u_e = v_n - par[W_N], v_e - par[W_E]
    factor = par[DRAG] + par[DRAG_2] * sqrt(u_n * u_n + u_e * u_e)
    return factor * u_n, factor * u_e


@nb.njit(cache=True, error_model="numpy", nogil=True)
def drag_integrator(v: np.ndarray, tilt: np.ndarray, par: np.ndarray, step: float, largest: float) -> np.ndarray:
    """Return drag at the last row and the velocity integrator after all rows, north and east, (2, 2) [m/s2].

    In slow motion the velocity error is what the integrator lacks of the drag, over P: I' = K (drag - I) / P. At the
    largest tilt it stays.

    Args:
        v: ground velocities, (n, 2) [m/s]; tilt: accelerations by tilt, nan unknown, (n, 2) [m/s2]
        par: of the loop
        step: between rows [s]
        largest: acceleration by tilt from which it stays [m/s2]
    """
    out = np.empty((2, 2))
    recovery = par[VEL_I] / par[VEL_P] * step
    for k in range(len(v)):
        out[0, 0], out[0, 1] = drag(v[k, 0], v[k, 1], par)
        if k == 0:
            assign(out[1], out[0])
        if not sqrt(tilt[k, 0] ** 2 + tilt[k, 1] ** 2) > largest:
            for i in range(2):
                out[1, i] += recovery * (out[0, i] - out[1, i])
    return out


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _limit(c: np.ndarray, v: np.ndarray, par: np.ndarray) -> float:
    """Limit the horizontal command (3,) in place; return the command over the limit, at least 1.

    ArduCopter keeps the part across the reference velocity; PX4 keeps the direction.
    """
    limit, size = par[ACC_MAX], sqrt(c[0] ** 2 + c[1] ** 2)
    if size <= limit:
        return 1.0
    speed = sqrt(v[0] ** 2 + v[1] ** 2)
    if par[ARDUCOPTER] == 0.0 or speed < 1e-3:
        c[0], c[1] = c[0] * limit / size, c[1] * limit / size
        return size / limit
    n, e = v[0] / speed, v[1] / speed
    along, across = c[0] * n + c[1] * e, c[1] * n - c[0] * e
    across = min(max(across, -limit), limit)
    rest = sqrt(max(limit * limit - across * across, 0.0))
    along = min(max(along, -rest), rest)
    c[0], c[1] = along * n - across * e, along * e + across * n
    return size / limit


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _integrate(integrator: np.ndarray, error: np.ndarray, limited: bool, par: np.ndarray, dt: float) -> None:
    """Integrate the velocity error; at the limit ArduCopter's integrator turns but does not grow, PX4's stays."""
    if limited and par[ARDUCOPTER] == 0.0:
        return
    before = sqrt(integrator[0] ** 2 + integrator[1] ** 2)
    for i in range(2):
        integrator[i] += dt * par[VEL_I] * error[i]
    after = sqrt(integrator[0] ** 2 + integrator[1] ** 2)
    if limited and after > before:
        integrator[0], integrator[1] = integrator[0] * before / after, integrator[1] * before / after


@nb.njit(cache=True, error_model="numpy", nogil=True)
def track_reference(xva: np.ndarray, r: np.ndarray, par: np.ndarray, dt: float) -> None:
    """Advance the aircraft behind a reference (3, 3), that in the middle of the step, by dt.

    `xva` (4, 3) has position, velocity, horizontal acceleration by tilt and vertical acceleration, and the integrator.
    """
    c, error, v_c = np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        v_c[i] = r[0, i] - xva[0, i]
    distance = sqrt(v_c[0] ** 2 + v_c[1] ** 2)
    gain = par[POS_P]
    if par[ARDUCOPTER] == 1.0 and distance > 1e-6:
        gain = square_root_control(distance, gain, par[ACC_XY]) / distance
    drag_n, drag_e = drag(xva[1, 0], xva[1, 1], par)
    for i in range(3):
        p = gain if i < 2 else par[POS_P_Z]
        error[i] = r[1, i] + p * v_c[i] - xva[1, i]
        c[i] = r[2, i] + (par[VEL_P] if i < 2 else par[VEL_P_Z]) * error[i]
        if i < 2:
            acceleration = xva[2, i] - (drag_n if i == 0 else drag_e)
            target = par[ARDUCOPTER] * (r[2, i] + p * (r[1, i] - xva[1, i]))
            c[i] += xva[3, i] + par[VEL_D] * (target - acceleration)
    wanted_n, wanted_e = c[0], c[1]
    excess = _limit(c, r[1], par)
    _integrate(xva[3], error, excess > 1.0 and error[0] * wanted_n + error[1] * wanted_e > 0.0, par, dt)
    for i in range(3):
        limited = c[i] if i < 2 else min(max(c[2], -_MAX_ACC_Z), _MAX_ACC_Z)
        change = (limited - xva[2, i]) * (1.0 - exp(-dt / (par[TAU] if i < 2 else _TAU_Z)))
        resistance = drag_n if i == 0 else drag_e if i == 1 else 0.0
        xva[0, i] += dt * (xva[1, i] + dt * (0.5 * (xva[2, i] - resistance) + change / 6.0))
        xva[1, i] += dt * (xva[2, i] + 0.5 * change - resistance)
        xva[2, i] += change


@nb.njit(cache=True, error_model="numpy", nogil=True)
def shape_position(s: np.ndarray, target: tuple[float, float], top: float, par: np.ndarray, dt: float) -> None:
    """Advance a shaped horizontal position towards a target at rest by dt.

    Args:
        s: position, velocity, acceleration, changed in place, (6,) [m, m/s, m/s2]
        target: north and east [m]
        top: speed limit [m/s]
        par: (N_PAR,)
        dt: step [s]
    """
    acc, jerk = par[ACC_XY], par[SHAPING_JERK]
    k = jerk / acc
    s[0] += dt * (s[2] + 0.5 * dt * s[4])
    s[1] += dt * (s[3] + 0.5 * dt * s[5])
    s[2] += dt * s[4]
    s[3] += dt * s[5]
    n, e = target[0] - s[0], target[1] - s[1]
    distance = sqrt(n * n + e * e)
    v_n = v_e = 0.0
    if distance > 1e-9:
        n, e = n / distance, e / distance
        speed = min(square_root_control(distance, k, acc), distance / dt)
        closing = s[2] * n + s[3] * e
        if closing > 0.0:
            slope = k if distance <= acc / (k * k) else acc / max(speed, 1e-9)
            speed -= slope * closing / k
        speed = min(max(speed, -top), top)
        v_n, v_e = speed * n, speed * e
    a_n, a_e = _corner_limit(k * (v_n - s[2]), k * (v_e - s[3]), s, acc)
    change_n, change_e = a_n - s[4], a_e - s[5]
    size = sqrt(change_n * change_n + change_e * change_e)
    share = min(jerk * dt / size, 1.0) if size > 0.0 else 1.0
    s[4] += share * change_n
    s[5] += share * change_e


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _corner_limit(a_n: float, a_e: float, s: np.ndarray, limit: float) -> tuple[float, float]:
    """Limit an acceleration: deceleration before acceleration across the velocity, before acceleration along it."""
    speed, size = sqrt(s[2] ** 2 + s[3] ** 2), sqrt(a_n * a_n + a_e * a_e)
    share = min((limit if speed < 1e-6 else 2.0 * limit) / max(size, 1e-9), 1.0)
    a_n, a_e = share * a_n, share * a_e
    if speed < 1e-6:
        return a_n, a_e
    n, e = s[2] / speed, s[3] / speed
    along, across = a_n * n + a_e * e, a_e * n - a_n * e
    if along > 0.0:
        across = min(max(across, -limit), limit)
        along = min(along, sqrt(limit * limit - across * across))
    else:
        along = max(along, -limit)
        rest = sqrt(limit * limit - along * along)
        across = min(max(across, -rest), rest)
    return along * n - across * e, along * e + across * n
