"""A multirotor's autopilot in the large: a point that follows the route, and an airframe that lags behind it.

    v_allowed = min(v_max, fastest from which the end of the segment is reached at its speed)      one segment
    s'' -> within the acceleration, s''' within the jerk;   r = A + t s                             the reference
    x'' = wn^2 (r - x) + 2 zeta wn (r' - x')                                                        the airframe

Corners are rounded: at acceleration `a` a turn by `theta` cut by at most `radius` is flown at
v^2 = a radius / (1 / cos(theta / 2) - 1). Segments are straight; a circle is many of them.

Source: ArduCopter 4.x waypoint navigation (S-curves, corner acceleration) and PX4 multicopter position control
(jerk-limited reference), parameter names and defaults as theirs; the lag stands for their position and attitude loops.
"""

from collections.abc import Mapping
from math import isfinite, radians, sqrt
from typing import NamedTuple

import numba as nb
import numpy as np

LAW = "copter: route at limited speed, acceleration and jerk, behind a lag"

# columns of one segment
A_N, B_N = 0, 3  # where it begins and ends, NED, three each [m]
SPEED, ACC = 6, 7  # limits along it [m/s, m/s2]
END = 8  # speed at its end; 0: a stop [m/s]
HOLD = 9  # time to wait at its end; inf: for good [s]
SEQ = 10  # mission item it came from
N_SEGMENT = 11

# state of the follower
AT, S, S_DOT, S_DDOT, WAITED = range(5)  # segment, way along it [m], its rates, time waited at its end [s]
N_FOLLOW = 5

# what the kernel is told besides
JERK, WN, ZETA, V_AIR, W_N, W_E = range(6)  # [m/s3], [rad/s], [-], top airspeed [m/s], wind [m/s]
N_PAR = 6

_THERE = 0.15  # as near the end of a segment as this it is reached [m]
_STILL = 0.3  # and as slow as this [m/s]
_MOST_LEVEL, _MOST_UPRIGHT = 6.0, 4.0  # acceleration that tilt and thrust leave to the airframe [m/s2]


class Limits(NamedTuple):
    """What the autopilot allows itself, SI."""

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


class Row(NamedTuple):
    """One limit: default and the names it goes by, each with its factor to SI; the first one found counts."""

    default: float
    names: tuple[tuple[str, float], ...]


_CM = 0.01
TABLE = {
    "speed": Row(8.0, (("WP_SPD", 1), ("WPNAV_SPEED", _CM), ("WP_SPEED", _CM), ("MPC_XY_CRUISE", 1))),
    "up": Row(2.5, (("WP_SPD_UP", 1), ("WPNAV_SPEED_UP", _CM), ("WP_SPEED_UP", _CM), ("MPC_Z_V_AUTO_UP", 1))),
    "down": Row(1.5, (("WP_SPD_DN", 1), ("WPNAV_SPEED_DN", _CM), ("WP_SPEED_DN", _CM), ("MPC_Z_V_AUTO_DN", 1))),
    "acc": Row(2.5, (("WP_ACC", 1), ("WPNAV_ACCEL", _CM), ("WP_ACCEL", _CM), ("MPC_ACC_HOR", 1))),
    "acc_corner": Row(0.0, (("WP_ACC_CNR", 1), ("WPNAV_ACCEL_C", _CM))),
    "acc_z": Row(1.0, (("WP_ACC_Z", 1), ("WPNAV_ACCEL_Z", _CM), ("WP_ACCEL_Z", _CM))),
    "jerk": Row(1.0, (("WP_JERK", 1), ("WPNAV_JERK", 1), ("MPC_JERK_AUTO", 1))),
    "radius": Row(2.0, (("WP_RADIUS_M", 1), ("WPNAV_RADIUS", _CM), ("NAV_ACC_RAD", 1))),
    "land": Row(0.5, (("LAND_SPD_MS", 1), ("LAND_SPEED", _CM), ("LAND_FINAL_SPD", 1), ("MPC_LAND_SPEED", 1))),
    "tilt": Row(radians(30.0), (("ANGLE_MAX", radians(_CM)), ("MPC_TILTMAX_AIR", radians(1.0)))),
}
_LOW, _HIGH = 0.02, 60.0  # limits outside are noise


def limits(values: Mapping[str, float], prefix: str = "") -> tuple[Limits, tuple[str, ...]]:
    """Read the limits from autopilot parameters.

    Args:
        values: parameters as the autopilot names and scales them
        prefix: `Q_` for the rotors of a quadplane
    Returns:
        limits, SI; names of those that no parameter gave, at their defaults
    """
    found, absent = {}, []
    for limit, row in TABLE.items():
        given = [values[prefix + name] * factor for name, factor in row.names if prefix + name in values]
        good = [value for value in given if isfinite(value) and _LOW <= value <= _HIGH]
        found[limit] = good[0] if good else row.default
        if not good and limit != "acc_corner":
            absent.append(limit)
    if not found["acc_corner"]:
        found["acc_corner"] = 2.0 * found["acc"]  # as ArduCopter does for 0
    return Limits(**found), tuple(absent)


def along(limit: float, limit_up: float, limit_down: float, t: np.ndarray) -> float:
    """Return the limit along a direction, from those along the horizontal, up and down [same unit].

    Args:
        limit, limit_up, limit_down: along each of the three
        t: direction, NED, (3,)
    """
    level, rise = float(np.hypot(t[0], t[1])), float(-t[2])
    vertical = limit_up if rise > 0 else limit_down
    return min(limit / level if level > 1e-6 else np.inf, vertical / abs(rise) if abs(rise) > 1e-6 else np.inf)


def corner_speed(before: np.ndarray, after: np.ndarray, limit: Limits) -> float:
    """Return the speed of a corner between two directions (3,) rounded within the radius [m/s]."""
    half = sqrt(max((1.0 + float(before @ after)) / 2.0, 0.0))  # cos(theta / 2)
    if half < 0.1:
        return 0.0
    return sqrt(limit.acc_corner * limit.radius / max(1.0 / half - 1.0, 1e-6))


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _fastest(to_go: float, end: float, acc: float, jerk: float) -> float:
    """Return the speed from which the end is reached at its speed: d = v^2 / 2a + v a / 2j [m/s]."""
    way = max(to_go, 0.0) + end * end / (2.0 * acc) + end * acc / (2.0 * jerk)
    b = acc / (2.0 * jerk)
    return acc * (sqrt(b * b + 2.0 * way / acc) - b)


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _top(n: float, e: float, limit: float, par: np.ndarray) -> float:
    """Return the ground speed along the horizontal direction (n, e) that the top airspeed leaves [m/s]."""
    level = sqrt(n * n + e * e)
    if not par[V_AIR] > 0.0 or level < 0.3:
        return limit
    tail = (par[W_N] * n + par[W_E] * e) / level
    cross = (par[W_N] * e - par[W_E] * n) / level
    left = sqrt(max(par[V_AIR] ** 2 - cross * cross, 0.0)) + tail
    return min(limit, max(left, 0.5) / level)


@nb.njit(cache=True, error_model="numpy", nogil=True)
def follow(
    ref: np.ndarray, segments: np.ndarray, x: np.ndarray, v: np.ndarray, par: np.ndarray, dt: float, out: np.ndarray
) -> None:
    """Fly the segments ahead.

    Args:
        ref: state of the follower, changed in place, (N_FOLLOW,)
        segments: (n, N_SEGMENT), n > 0
        x, v: position and ground velocity at the start, NED, changed in place, (3,) [m, m/s]
        par: (N_PAR,)
        dt: step [s]
        out: positions, filled in, NED, (k, 3) [m]; out[0] is the start
    """
    t, r, a = np.empty(3), np.empty(3), np.empty(3)
    wn, zeta = par[WN], par[ZETA]
    for k in range(len(out)):
        out[k] = x
        row = segments[int(ref[AT])]
        for i in range(3):
            t[i] = row[B_N + i] - row[A_N + i]
        length = sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2)
        for i in range(3):
            t[i] = t[i] / length if length > 1e-6 else 0.0
        _advance(ref, segments, length, _top(t[0], t[1], row[SPEED], par), par[JERK], dt)
        for i in range(3):
            r[i] = row[A_N + i] + t[i] * min(ref[S], length)
        if ref[S] >= length and _over(ref, row, dt) and int(ref[AT]) + 1 < len(segments):
            ref[AT] += 1.0
            ref[S] = max(ref[S] - length, 0.0) if row[END] > 0.0 else 0.0
            ref[WAITED] = 0.0
        for i in range(3):
            a[i] = wn * wn * (r[i] - x[i]) + 2.0 * zeta * wn * (t[i] * ref[S_DOT] - v[i])
        over = max(sqrt(a[0] ** 2 + a[1] ** 2) / _MOST_LEVEL, abs(a[2]) / _MOST_UPRIGHT, 1.0)
        for i in range(3):
            v[i] += dt * a[i] / over
            x[i] += dt * v[i]


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _advance(ref: np.ndarray, segments: np.ndarray, length: float, top: float, jerk: float, dt: float) -> None:
    """Move the reference one step along its segment."""
    row = segments[int(ref[AT])]
    acc = row[ACC]
    miss = min(top, _fastest(length - ref[S], row[END], acc, jerk)) - ref[S_DOT]
    wanted = min(sqrt(2.0 * jerk * abs(miss)), acc)  # so that the acceleration is gone when the speed is met
    wanted = wanted if miss > 0.0 else -wanted
    ref[S_DDOT] += min(max(wanted - ref[S_DDOT], -2.0 * jerk * dt), 2.0 * jerk * dt)
    ref[S_DOT] += ref[S_DDOT] * dt
    if ref[S_DOT] <= 0.0:
        ref[S_DOT], ref[S_DDOT] = 0.0, max(ref[S_DDOT], 0.0)
    ref[S] += ref[S_DOT] * dt
    arrived = ref[S] >= length or (length - ref[S] < _THERE and ref[S_DOT] < _STILL)
    if row[END] <= 0.0 and arrived:
        ref[S], ref[S_DOT], ref[S_DDOT] = length, 0.0, 0.0


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _over(ref: np.ndarray, row: np.ndarray, dt: float) -> bool:
    """Count the wait at the end of a segment; tell whether it is over."""
    if row[END] > 0.0:
        return True
    ref[WAITED] += dt
    return ref[WAITED] >= row[HOLD]
