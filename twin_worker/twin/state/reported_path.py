"""Path that an onboard computer commands point by point: its course, curvature and earlier laps, from reports of L1."""

from dataclasses import dataclass
from math import copysign, pi, radians
from typing import TYPE_CHECKING

import numpy as np

from fleet.autopilots.modes import make_leg
from fleet.frames import G, Origin, to_ned, wrap
from fleet.mission import WAYPOINT, Route

if TYPE_CHECKING:
    from twin_worker.twin.state.state import Twin

_MAX_AGE_S, _MIN_ROWS = 2.0, 10  # oldest newest report [s], and fewest reports
_PATH_S, _PATH_FIT_S = 0.6, 20.0  # newest reports that give curvature and course of a path, and of its law [s]
_PATH_LAG_S = 2.0  # flight on the reported path in the replay of the law [s]
_MIN_OFF_TARGET = radians(15.0)  # a bearing that differs more from that of the target belongs to another path [rad]
_MIN_TURN_RATE = radians(3.0)  # slower turns of the reported course are rounding to degrees [rad/s]
_ARC_STEP, _ARC_STEPS, _PATH_M = radians(15.0), 12, 1e5  # of a curved path; length of its straight end [m]
_PATH_STEP_S = 0.2  # between points of the path so far [s]
_SAME_PATH_M, _SAME_COURSE = 15.0, radians(25.0)  # largest distance from an earlier pass, and difference of course
_PASS_S = 10.0  # longest stay near a point in one pass [s]
_REPEATED_S = 200.0  # a path is repeated for longer than any look-ahead [s]
_MAX_PATH_BANK_ERROR = radians(6.0)  # largest median error of the law to the commanded banks [rad]
_PATH_PERIODS, _PATH_DAMPINGS = np.arange(8.0, 31.0, 2.0), np.arange(0.6, 1.05, 0.1)  # tried values of L1 [s, -]


@dataclass(frozen=True)
class ReportedPath:
    """Path that an autopilot reports to follow, without any list of points.

    Attributes:
        route: from the point abeam the aircraft on
        since: time from which the flight is on it, as far as known [s since 1970]
        law: period and damping of L1 that match the commanded banks, by their names with ArduPlane
        repeats: the path returned to where it was before; the route repeats what followed there
        centre, spread: mean of the positions since the mode change, north and east, (2,), and the standard deviation
            of their distance from it [m]
    """

    route: Route
    since: float
    law: dict[str, float]
    repeats: bool
    centre: np.ndarray
    spread: float


def reported_path(twin: "Twin") -> ReportedPath | None:
    """Return the path that NAV_CONTROLLER_OUTPUT describes in GUIDED; None where it flies to the reported target.

    An onboard computer may command a path point by point. Its course is the reported bearing, the aircraft is left of
    it by the crosstrack error. A path that returned to where it was before is assumed to repeat what followed there:
    circuits are closed. Otherwise a course that turns continues as an arc, and what follows is not known.
    """
    history, origin, newest = twin.telemetry.history, twin.telemetry.origin, twin.telemetry.history.newest
    if twin.mode != "GUIDED" or twin.autopilot != "ardupilot" or origin is None or twin.prediction.override is not None:
        return None
    t, bearings = history.rows_since("bearing", max(newest - _PATH_FIT_S, twin.onboard.plan_changed_t))
    (t_c, commands), (t_p, positions) = (
        history.rows_since(name, t[0] - 2.0 if len(t) else 0.0) for name in ("command", "position")
    )
    t_v, velocities = history.rows_since("velocity", t[0] - 2.0 if len(t) else 0.0)
    if len(t) < _MIN_ROWS or newest - t[-1] > _MAX_AGE_S or min(len(t_p), len(t_v), len(t_c)) < 2:
        return None
    p = _at(t, t_p, to_ned(origin, *positions.T))
    bearing, crosstrack = np.unwrap(bearings[:, 0]), np.interp(t, t_c, commands[:, 2])
    if twin.onboard.target is not None:
        offset = to_ned(origin, *(np.array([x], float) for x in twin.onboard.target))[0, :2] - p[:, :2]
        off_target = np.abs(wrap(bearing - np.arctan2(offset[:, 1], offset[:, 0])))
        if np.median(off_target) < _MIN_OFF_TARGET:
            return None
    v = _at(t, t_v, velocities)
    law = _path_law(bearing, crosstrack, v, np.interp(t, t_c, commands[:, 0]))
    if law is None or not np.isfinite(crosstrack[-1]):
        return None
    path_t, path_points, courses = _path_since(twin, origin)
    points, remark = _arc(t, bearing, p[-1], v[-1], crosstrack[-1]), "the path beyond the reported course is not known"
    if earlier := _earlier_pass(path_t, path_points, courses):
        distance = law["NAVL1_DAMPING"] * law["NAVL1_PERIOD"] / pi * float(np.hypot(*v[-1, :2]))  # of L1
        known, lap = _until(points, distance), slice(earlier, None)
        rest = slice(earlier + int(np.searchsorted(_lengths(path_points[lap]), distance)), None)
        laps = int(_REPEATED_S / (path_t[-1] - path_t[earlier])) + 1
        circuit = np.tile(_corners(path_points[lap], courses[lap]), (laps, 1))
        points = [*known, *_corners(path_points[rest], courses[rest]), *circuit]
        remark = "the commanded path is assumed to repeat its circuit"
    legs = np.array([make_leg(WAYPOINT, point) for point in points[1:]])
    centre = path_points[:, :2].mean(axis=0)
    spread = float(np.sqrt(np.mean(np.sum((path_points[:, :2] - centre) ** 2, axis=1))))
    route = Route(origin, legs, points[0], (remark,))
    return ReportedPath(route, float(t[-1]) - _PATH_LAG_S, law, earlier > 0, centre, spread)


def _arc(t: np.ndarray, bearing: np.ndarray, p: np.ndarray, v: np.ndarray, crosstrack: float) -> list[np.ndarray]:
    """Return points of the reported course abeam the aircraft: an arc while it turns, then straight."""
    recent = t > t[-1] - _PATH_S
    rate = float(np.polyfit(t[recent] - t[-1], bearing[recent], 1)[0]) if recent.sum() > 3 else 0.0
    course, speed = float(bearing[-1]), max(float(np.hypot(*v[:2])), 1.0)
    points = [p + crosstrack * np.array([-np.sin(course), np.cos(course), 0.0])]
    if abs(rate) > _MIN_TURN_RATE:
        step = copysign(_ARC_STEP, rate)
        for _ in range(_ARC_STEPS):
            chord, course = 2.0 * speed / rate * np.sin(0.5 * step), course + step
            points.append(
                points[-1] + chord * np.array([np.cos(course - 0.5 * step), np.sin(course - 0.5 * step), 0.0])
            )
    points.append(points[-1] + _PATH_M * np.array([np.cos(course), np.sin(course), 0.0]))
    return points


def _path_since(twin: "Twin", origin: Origin) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times (n,), points abeam the aircraft (n, 3) and courses (n,) of the path since the mode change."""
    history, entry = twin.telemetry.history, twin.onboard.entry
    since = -np.inf if entry is None else entry.t
    t_b, bearings = history.rows_since("bearing", since)
    (t_c, commands), (t_p, positions) = (history.rows_since(name) for name in ("command", "position"))
    t = np.arange(t_b[-1], max(t_b[0], t_p[0]) - 0.5 * _PATH_STEP_S, -_PATH_STEP_S)[::-1]
    course = np.interp(t, t_b, np.unwrap(bearings[:, 0]))
    crosstrack = np.interp(t, t_c, np.nan_to_num(commands[:, 2]))
    abeam = np.column_stack([-np.sin(course), np.cos(course), np.zeros(len(t))])
    return t, _at(t, t_p, to_ned(origin, *positions.T)) + crosstrack[:, None] * abeam, course


def _earlier_pass(t: np.ndarray, path: np.ndarray, course: np.ndarray) -> int:
    """Return the row of the last earlier pass through the newest point in the same direction; 0: there was none.

    In between the path must have been away from it.
    """
    distance = np.linalg.norm(path[:, :2] - path[-1, :2], axis=1)
    close = (distance < _SAME_PATH_M) & (np.abs(wrap(course - course[-1])) < _SAME_COURSE)
    away = np.flatnonzero(distance > 2.0 * _SAME_PATH_M)
    before = np.flatnonzero(close[: away[-1]]) if len(away) else away
    if not len(before):
        return 0
    last_pass = before[t[before] > t[before[-1]] - _PASS_S]
    return int(last_pass[np.argmin(distance[last_pass])])


def _lengths(path: np.ndarray) -> np.ndarray:
    """Return the horizontal distance from the first point along a path to each of its points, (n,) [m]."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1))])


def _until(points: list[np.ndarray], distance: float) -> list[np.ndarray]:
    """Return the points of a path up to a distance [m], with one there."""
    path = np.array(points)
    length = _lengths(path)
    return [*path[length < distance], np.array([np.interp(distance, length, column) for column in path.T])]


def _corners(path: np.ndarray, course: np.ndarray) -> np.ndarray:
    """Return the first point of a path and those between which its course turned by `_ARC_STEP`, (k, 3)."""
    sector = np.floor(course / _ARC_STEP)
    return path[np.flatnonzero(np.diff(sector, prepend=np.nan))]


def _at(t: np.ndarray, sample_t: np.ndarray, rows: np.ndarray) -> np.ndarray:
    return np.column_stack([np.interp(t, sample_t, column) for column in rows.T])


def _path_law(bearing: np.ndarray, crosstrack: np.ndarray, v: np.ndarray, banks: np.ndarray) -> dict[str, float] | None:
    """Return period and damping of L1 that match the commanded banks; None where L1 does not.

    phi = atan(4 zeta pi v sin(nu) / (T g)),  nu = asin(e / L1) + bearing - course,  L1 = zeta T v / pi
    """
    speed = np.maximum(np.hypot(v[:, 0], v[:, 1]), 1.0)
    nu2 = wrap(bearing - np.arctan2(v[:, 1], v[:, 0]))
    best, law = _MAX_PATH_BANK_ERROR, None
    for T in _PATH_PERIODS:
        for zeta in _PATH_DAMPINGS:
            nu = nu2 + np.arcsin(np.clip(crosstrack * pi / (zeta * T * speed), -0.7071, 0.7071))
            phi = np.arctan(4.0 * zeta * pi * speed / (T * G) * np.sin(np.clip(nu, -pi / 2, pi / 2)))
            error = float(np.median(np.abs(np.clip(phi, banks.min(), banks.max()) - banks)))
            if error < best:
                best, law = error, {"NAVL1_PERIOD": float(T), "NAVL1_DAMPING": float(zeta)}
    return law
