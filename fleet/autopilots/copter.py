"""Multirotor autopilot model: a reference point moves along the route, the airframe follows with a lag.

    v_allowed = min(v_max, v from which braking to the end speed of the segment is possible)        one segment
    s'' and s''' limited by acceleration and jerk;   r = A + t s                                      the reference
    x'' = wn^2 (r - x) + 2 zeta wn (r' - x')                                                        the airframe

Corners are rounded: with acceleration `a` and a distance of at most `radius` to the corner, the speed in a turn
`theta` is v^2 = a radius / (1 / cos(theta / 2) - 1). Segments are straight; a circle consists of many segments.

Source: ArduCopter 4.x waypoint navigation (S-curves, corner acceleration) and PX4 multicopter position control
(jerk-limited reference), with their parameter names and defaults; the lag represents their position and attitude loops.
"""

from collections.abc import Mapping
from math import isfinite, radians, sqrt
from typing import NamedTuple

import numba as nb
import numpy as np

from fleet.compiled_frames import assign

LAW = "copter: route at limited speed, acceleration and jerk, behind a lag"

# columns of one segment
A_N, B_N = 0, 3  # start and end point, NED, three each [m]
SPEED, ACC = 6, 7  # limits along it [m/s, m/s2]
END = 8  # speed at the end; 0: stop [m/s]
HOLD = 9  # time to wait at the end; inf: unlimited [s]
SEQ = 10  # sequence number of the mission item
N_SEGMENT = 11

# state of the reference
SEGMENT, S, S_DOT, S_DDOT, WAIT_TIME = range(
    5
)  # segment, distance along it [m], its derivatives, time waited at its end [s]
N_FOLLOW = 5

# parameters of the kernel
JERK, WN, ZETA, V_AIR, W_N, W_E = range(6)  # [m/s3], [rad/s], [-], top airspeed [m/s], wind [m/s]
N_PAR = 6

_ARRIVAL_RADIUS = 0.15  # distance to the end of a segment that counts as arrived [m]
_ARRIVAL_SPEED = 0.3  # and the speed for it [m/s]
_MAX_ACC_XY, _MAX_ACC_Z = 6.0, 4.0  # horizontal and vertical acceleration limits of the airframe [m/s2]


class Limits(NamedTuple):
    """Motion limits of the autopilot, SI."""

    speed: float
    up: float
    down: float
    acc: float
    acc_corner: float
    acc_z: float
    jerk: float
    radius: float
    land: float
    tilt: float


class LimitSpec(NamedTuple):
    """One limit: default of ArduCopter and parameter names, each with its factor to SI; the first available is used."""

    default: float
    names: tuple[tuple[str, float], ...]


_CM = 0.01
TABLE = {
    "speed": LimitSpec(10.0, (("WP_SPD", 1), ("WPNAV_SPEED", _CM), ("WP_SPEED", _CM), ("MPC_XY_CRUISE", 1))),
    "up": LimitSpec(2.5, (("WP_SPD_UP", 1), ("WPNAV_SPEED_UP", _CM), ("WP_SPEED_UP", _CM), ("MPC_Z_V_AUTO_UP", 1))),
    "down": LimitSpec(1.5, (("WP_SPD_DN", 1), ("WPNAV_SPEED_DN", _CM), ("WP_SPEED_DN", _CM), ("MPC_Z_V_AUTO_DN", 1))),
    "acc": LimitSpec(2.5, (("WP_ACC", 1), ("WPNAV_ACCEL", _CM), ("WP_ACCEL", _CM), ("MPC_ACC_HOR", 1))),
    "acc_corner": LimitSpec(0.0, (("WP_ACC_CNR", 1), ("WPNAV_ACCEL_C", _CM))),
    "acc_z": LimitSpec(1.0, (("WP_ACC_Z", 1), ("WPNAV_ACCEL_Z", _CM), ("WP_ACCEL_Z", _CM))),
    "jerk": LimitSpec(1.0, (("WP_JERK", 1), ("WPNAV_JERK", 1), ("MPC_JERK_AUTO", 1))),
    "radius": LimitSpec(2.0, (("WP_RADIUS_M", 1), ("WPNAV_RADIUS", _CM), ("NAV_ACC_RAD", 1))),
    "land": LimitSpec(0.5, (("LAND_SPD_MS", 1), ("LAND_SPEED", _CM), ("LAND_FINAL_SPD", 1), ("MPC_LAND_SPEED", 1))),
    "tilt": LimitSpec(
        radians(30.0), (("ATC_ANGLE_MAX", radians(1.0)), ("ANGLE_MAX", radians(_CM)), ("MPC_TILTMAX_AIR", radians(1.0)))
    ),
}
_PX4_DEFAULTS = {"speed": 5.0, "up": 3.0, "acc": 3.0, "jerk": 4.0, "radius": 10.0, "land": 0.7, "tilt": radians(45.0)}
_MIN_LIMIT, MAX_LIMIT = 0.02, 60.0  # values outside are rejected


def limits(values: Mapping[str, float], prefix: str = "", *, px4: bool = False) -> tuple[Limits, tuple[str, ...]]:
    """Read the limits from autopilot parameters.

    Args:
        values: parameters in the names and units of the autopilot
        prefix: `Q_` for the rotors of a quadplane
        px4: a limit without a parameter has the default of PX4, else that of ArduCopter
    Returns:
        limits, SI; names of the limits at their defaults for lack of a parameter
    """
    resolved, defaulted = {}, []
    for limit, spec in TABLE.items():
        candidates = [values[prefix + name] * factor for name, factor in spec.names if prefix + name in values]
        valid = [value for value in candidates if isfinite(value) and _MIN_LIMIT <= value <= MAX_LIMIT]
        default = _PX4_DEFAULTS.get(limit, spec.default) if px4 else spec.default
        resolved[limit] = valid[0] if valid else default
        if not valid and limit != "acc_corner":
            defaulted.append(limit)
    if not resolved["acc_corner"]:
        resolved["acc_corner"] = 2.0 * resolved["acc"]  # ArduCopter: 0 means twice the acceleration
    return Limits(**resolved), tuple(defaulted)


def limit_along(limit: float, limit_up: float, limit_down: float, t: np.ndarray) -> float:
    """Return the limit along a direction from the horizontal, upward and downward limits [same unit].

    Args:
        limit, limit_up, limit_down: horizontal, upward, downward
        t: direction, NED, (3,)
    """
    horizontal, rise = float(np.hypot(t[0], t[1])), float(-t[2])
    vertical = limit_up if rise > 0 else limit_down
    return min(
        limit / horizontal if horizontal > 1e-6 else np.inf, vertical / abs(rise) if abs(rise) > 1e-6 else np.inf
    )


def corner_speed(direction_in: np.ndarray, direction_out: np.ndarray, limit: Limits) -> float:
    """Return the speed in a corner between two directions (3,), rounded within the radius [m/s]."""
    cos_half = sqrt(max((1.0 + float(direction_in @ direction_out)) / 2.0, 0.0))  # cos(theta / 2)
    if cos_half < 0.1:
        return 0.0
    return sqrt(limit.acc_corner * limit.radius / max(1.0 / cos_half - 1.0, 1e-6))


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _braking_speed(to_go: float, end: float, acc: float, jerk: float) -> float:
    """Return the speed from which braking to the end speed is possible: d = v^2 / 2a + v a / 2j [m/s]."""
    distance = max(to_go, 0.0) + end * end / (2.0 * acc) + end * acc / (2.0 * jerk)
    b = acc / (2.0 * jerk)
    return acc * (sqrt(b * b + 2.0 * distance / acc) - b)


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _max_ground_speed(n: float, e: float, limit: float, par: np.ndarray) -> float:
    """Return the ground speed along the horizontal direction (n, e) at maximum airspeed [m/s]."""
    norm = sqrt(n * n + e * e)
    if not par[V_AIR] > 0.0 or norm < 0.3:
        return limit
    tail = (par[W_N] * n + par[W_E] * e) / norm
    cross = (par[W_N] * e - par[W_E] * n) / norm
    ground_speed = sqrt(max(par[V_AIR] ** 2 - cross * cross, 0.0)) + tail
    return min(limit, max(ground_speed, 0.5) / norm)


@nb.njit(cache=True, error_model="numpy", nogil=True)
def follow(
    ref: np.ndarray, segments: np.ndarray, x: np.ndarray, v: np.ndarray, par: np.ndarray, dt: float, out: np.ndarray
) -> None:
    """Simulate the flight along the segments.

    Args:
        ref: state of the reference, changed in place, (N_FOLLOW,)
        segments: (n, N_SEGMENT), n > 0
        x, v: position and ground velocity at the start, NED, changed in place, (3,) [m, m/s]
        par: (N_PAR,)
        dt: step [s]
        out: positions, filled in, NED, (k, 3) [m]; out[0] is the start
    """
    t, r, a = np.empty(3), np.empty(3), np.empty(3)
    wn, zeta = par[WN], par[ZETA]
    for k in range(len(out)):
        assign(out[k], x)
        segment = segments[int(ref[SEGMENT])]
        for i in range(3):
            t[i] = segment[B_N + i] - segment[A_N + i]
        length = sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2)
        for i in range(3):
            t[i] = t[i] / length if length > 1e-6 else 0.0
        _advance_reference(ref, segments, length, _max_ground_speed(t[0], t[1], segment[SPEED], par), par[JERK], dt)
        for i in range(3):
            r[i] = segment[A_N + i] + t[i] * min(ref[S], length)
        if ref[S] >= length and _wait_finished(ref, segment, dt) and int(ref[SEGMENT]) + 1 < len(segments):
            ref[SEGMENT] += 1.0
            ref[S] = max(ref[S] - length, 0.0) if segment[END] > 0.0 else 0.0
            ref[WAIT_TIME] = 0.0
        for i in range(3):
            a[i] = wn * wn * (r[i] - x[i]) + 2.0 * zeta * wn * (t[i] * ref[S_DOT] - v[i])
        saturation = max(sqrt(a[0] ** 2 + a[1] ** 2) / _MAX_ACC_XY, abs(a[2]) / _MAX_ACC_Z, 1.0)
        for i in range(3):
            v[i] += dt * a[i] / saturation
            x[i] += dt * v[i]


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _advance_reference(
    ref: np.ndarray, segments: np.ndarray, length: float, top: float, jerk: float, dt: float
) -> None:
    """Advance the reference one step along its segment."""
    segment = segments[int(ref[SEGMENT])]
    acc = segment[ACC]
    speed_error = min(top, _braking_speed(length - ref[S], segment[END], acc, jerk)) - ref[S_DOT]
    acc_c = min(sqrt(2.0 * jerk * abs(speed_error)), acc)  # the acceleration reaches zero when the speed is reached
    acc_c = acc_c if speed_error > 0.0 else -acc_c
    ref[S_DDOT] += min(max(acc_c - ref[S_DDOT], -2.0 * jerk * dt), 2.0 * jerk * dt)
    ref[S_DOT] += ref[S_DDOT] * dt
    if ref[S_DOT] <= 0.0:
        ref[S_DOT], ref[S_DDOT] = 0.0, max(ref[S_DDOT], 0.0)
    ref[S] += ref[S_DOT] * dt
    arrived = ref[S] >= length or (length - ref[S] < _ARRIVAL_RADIUS and ref[S_DOT] < _ARRIVAL_SPEED)
    if segment[END] <= 0.0 and arrived:
        ref[S], ref[S_DOT], ref[S_DDOT] = length, 0.0, 0.0


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _wait_finished(ref: np.ndarray, segment: np.ndarray, dt: float) -> bool:
    """Advance the wait timer at the end of a segment; return whether the wait is over."""
    if segment[END] > 0.0:
        return True
    ref[WAIT_TIME] += dt
    return ref[WAIT_TIME] >= segment[HOLD]
