"""Guidance of a PX4 multirotor: a jerk-limited velocity towards the waypoint, integrated to a position.

    top speed = speed from which braking to the corner speed is possible, at most MPC_XY_CRUISE or the commanded one
    velocity target = top speed towards the waypoint; in a turn, to the point of the line L1 = max(NAV_ACC_RAD, 5 m)
    away, not faster than before the turn; along a slope, as fast as both horizontal and vertical limits permit
    a, v, p of each axis: jerk-limited change of velocity, all three over the time of the slowest
    trajectory time runs slower while p is ahead of the aircraft, and stops at MPC_XY_ERR_MAX

The waypoint is reached within NAV_ACC_RAD and NAV_MC_ALT_RAD, a take-off within the latter. NAV_DELAY waits at the
waypoint before it. The time it takes to turn the nose is not waited for.
Source: PX4 1.16 documentation and behaviour of navigator, FlightTaskAuto and position smoothing, parameter names.
"""

from collections.abc import Callable
from math import acos, atan2, hypot, pi, sqrt, tan

import numpy as np

from fleet.simulator.multirotor import tasks
from fleet.simulator.multirotor.position import Reference
from fleet.simulator.multirotor.tasks import Task

_SLACK_S = 1.0  # time on the ground until the motors have spun up: COM_SPOOLUP_TIME [s]
_TURNING, _TURNING_SPEED, _MIN_L1 = 0.98, 0.2, 5.0  # cosine of velocity and target [-], [m/s], [m]
_SLOW = 0.5  # speed below which horizontal and vertical limits act apart [m/s]


class VelocityAxis:
    """Position, velocity and acceleration of one axis, with jerk-limited changes of velocity."""

    def __init__(self) -> None:
        self.reset(0.0, 0.0)

    def reset(self, p: float, v: float) -> None:
        """Start at a position [m] and velocity [m/s], unaccelerated."""
        self.p, self.v, self.a = p, v, 0.0
        self._change = 0.0
        self._sense, self._jerk = 1.0, 1.0
        self._times = (0.0, 0.0, 0.0)

    @property
    def duration(self) -> float:
        """Return the time of the planned change [s]."""
        return sum(self._times)

    def plan(self, target: float, acc: float, jerk: float) -> None:
        """Plan the fastest change to a velocity: jerk, constant acceleration, opposite jerk."""
        unforced = self.v + self.a * abs(self.a) / (2 * jerk)  # velocity when the acceleration has been taken back
        self._sense = 1.0 if target > unforced else -1.0 if target < unforced else (1.0 if self.a > 0 else -1.0)
        self._jerk, self._change = jerk, self._sense * (target - self.v)
        a = self._sense * self.a
        first = (sqrt(max(a * a / 2 + jerk * self._change, 0.0)) - a) / jerk
        first = max(min(first, (acc - a) / jerk), 0.0)
        last = max(a / jerk + first, 0.0)
        self._times = first, self._steady(a, first, last), last

    def _steady(self, a: float, first: float, last: float) -> float:
        """Return the time at constant acceleration [s]."""
        j, peak = self._jerk, a + self._jerk * first
        if abs(peak) < 1e-7:
            return 0.0
        gained = a * first + j * first**2 / 2 + peak * last - j * last**2 / 2
        return max((self._change - gained) / peak, 0.0)

    def stretch_to(self, duration: float, acc: float) -> None:
        """Plan the same change over a longer time, with a smaller acceleration."""
        a, j = self._sense * self.a, self._jerk
        square = (duration * j) ** 2 + 2 * duration * a * j - a * a - 4 * j * self._change
        first = (j * duration - a - sqrt(square)) / (2 * j) if square >= 0 else 0.0
        first = max(min(first, (acc - a) / j), 0.0)
        last = max(a / j + first, 0.0)
        self._times = first, max(duration - first - last, 0.0), last

    def advance(self, dt: float) -> None:
        """Advance by dt [s] along the planned change."""
        for time, jerk in zip((*self._times, dt), (1.0, 0.0, -1.0, 0.0), strict=True):
            h, j = min(dt, time), jerk * self._sense * self._jerk
            self.p += h * (self.v + h * (self.a / 2 + h * j / 6))
            self.v += h * (self.a + h * j / 2)
            self.a += h * j
            dt -= h
            if dt <= 0:
                return
            if time > 0 and jerk < 0:
                self.a = 0.0


class Px4Guidance:
    """Guidance of one PX4 multirotor; `start` begins a task, `step` returns the reference."""

    def __init__(self, params: dict[str, float]):
        self._params = params
        self.finished = False
        self.touches_down = False
        self._axes = (VelocityAxis(), VelocityAxis(), VelocityAxis())
        self._task: Task | None = None
        self._previous, self._target = np.zeros(3), np.zeros(3)
        self._speed_before_turn = 0.0

    @property
    def _p(self) -> np.ndarray:
        return np.array([axis.p for axis in self._axes])

    @property
    def _v(self) -> np.ndarray:
        return np.array([axis.v for axis in self._axes])

    def start(self, task: Task, p: np.ndarray, v: np.ndarray) -> None:
        """Begin a task at a position and velocity, NED; the trajectory goes on from where it is."""
        first = self._task is None
        if first or np.linalg.norm(self._p - p) > 4.0:
            for k, axis in enumerate(self._axes):
                axis.reset(float(p[k]), float(v[k]))
        self._task, self.finished, self._waited = task, False, 0.0
        self._steps: list[Task] = []
        self._landing = False
        target = task.target
        if task.kind == tasks.DELAY and not first:
            return  # the waypoint before stays the target
        if task.kind in (tasks.DELAY, tasks.HOLD):
            target = self._p + self._v * float(np.linalg.norm(self._v)) / (2 * self._params["MPC_ACC_HOR"])
        elif task.kind == tasks.TAKEOFF:
            target, self._waited = np.array([*p[:2], min(task.target[2], p[2])]), -_SLACK_S
        elif task.kind == tasks.RETURN:
            top = min(-self._params["RTL_RETURN_ALT"], float(p[2]))
            over_home = Task(tasks.WAYPOINT, -1, np.array([0.0, 0.0, top]), self._params["RTL_LAND_DELAY"])
            self._steps = [over_home, Task(tasks.LAND, -1, np.array([1e-9, 0.0, top]))]
            target = np.array([*p[:2], top])
        elif task.kind == tasks.LAND:
            target = np.array([*(task.target[:2] if np.any(task.target[:2]) else p[:2]), p[2]])
        self._set_target(np.array(target, float), p if first else self._target)

    def _set_target(self, target: np.ndarray, previous: np.ndarray) -> None:
        if not np.allclose(target, self._target):
            self._previous = np.array(previous, float)
        self._target = target

    def step(self, dt: float, p: np.ndarray, v: np.ndarray, following: Callable[[], Task | None]) -> Reference:
        """Advance by dt [s] and return the reference; `following` returns the next task with a position."""
        assert self._task is not None
        if self._waited < 0:
            self._waited = min(self._waited + dt, 0.0)
            for k, axis in enumerate(self._axes):
                axis.reset(float(p[k]), 0.0)
            return Reference(p.copy(), np.zeros(3), np.zeros(3))
        self._advance(dt, p, self._velocity_target(p, following))
        self._arrive(dt, p)
        return Reference(self._p, self._v, np.array([axis.a for axis in self._axes]))

    def _advance(self, dt: float, p: np.ndarray, target: np.ndarray) -> None:
        """Advance the trajectory towards a velocity, slower while the aircraft is behind it."""
        get, ahead = self._params.__getitem__, (self._p - p)[:2]
        stretch = 1.0
        if float(ahead @ self._v[:2]) >= 0:
            stretch = 1.0 - min(hypot(*ahead) / get("MPC_XY_ERR_MAX"), 1.0)
        vertical = get("MPC_ACC_UP_MAX" if target[2] < 0 else "MPC_ACC_DOWN_MAX")
        if self._lifts_off(p):
            vertical, self._axes[2].p = min(vertical, get("MPC_TKO_SPEED") / get("MPC_TKO_RAMP_T")), float(p[2])
        limits = (get("MPC_ACC_HOR"), get("MPC_ACC_HOR"), vertical)
        for axis, speed, acc in zip(self._axes, target, limits, strict=True):
            axis.plan(float(speed), acc, get("MPC_JERK_AUTO"))
        longest = max(axis.duration for axis in self._axes)
        for axis, acc in zip(self._axes, limits, strict=True):
            if axis.duration < longest:
                axis.stretch_to(longest, acc)
            axis.advance(dt * stretch)

    def _velocity_target(self, p: np.ndarray, following: Callable[[], Task | None]) -> np.ndarray:
        """Return the velocity that the trajectory tends to, (3,)."""
        task = self._task
        assert task is not None
        after = following() if task.passes and not self._steps and not self._landing else None
        previous, target, beyond = self._waypoints(p, self._target if after is None else after.target)
        trajectory, get = self._p, self._params.__getitem__
        offset, v = (target - trajectory)[:2], self._v[:2]
        turning = (
            hypot(*v) > _TURNING_SPEED
            and float(v @ offset) < _TURNING * hypot(*v) * hypot(*offset)
            and hypot(*offset) > get("NAV_ACC_RAD")
        )
        cruise = task.speed or get("MPC_XY_CRUISE")
        speed = self._top_speed((trajectory, target, beyond), cruise)
        if turning:
            speed = min(speed, self._speed_before_turn)
            target = self._on_line(previous, target)
        else:
            self._speed_before_turn = speed
        if self._landing:
            aim = target[:2] - trajectory[:2]
            return np.array([*(speed * aim / max(hypot(*aim), 1e-6)), self._landing_speed(p)])
        return _within(target - trajectory, speed, self._climb_speed(float(target[2]), p))

    def _waypoints(self, p: np.ndarray, beyond: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the point before, the target and the point after it, different ones for an aircraft off the line."""
        a, b, radius = self._previous, self._target, self._params["NAV_ACC_RAD"]
        line = (b - a)[:2]
        length = hypot(*line)
        if length < 1e-6:
            return a, b, beyond
        direction = line / length
        along = float((p - a)[:2] @ direction)
        if along > length:  # the target is behind
            return p, b, beyond
        if along < 0 and hypot(*(p - a)[:2]) > radius:  # the point before is in front
            return p, a, b
        nearest = np.array([*(a[:2] + along * direction), b[2]])
        return (p, nearest, b) if hypot(*(p - nearest)[:2]) > radius else (a, b, beyond)

    def _on_line(self, previous: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Return the point of the line at the distance L1 from the trajectory, at the height of the target."""
        line = (target - previous)[:2]
        direction = line / max(hypot(*line), 1e-6)
        nearest = previous[:2] + direction * float((self._p - previous)[:2] @ direction)
        across = hypot(*(nearest - self._p[:2]))
        reach = max(self._params["NAV_ACC_RAD"], _MIN_L1)
        return np.array([*(nearest + direction * sqrt(max(reach**2 - across**2, 0.0))), target[2]])

    def _top_speed(self, points: tuple[np.ndarray, ...], cruise: float) -> float:
        """Return the speed at the first of three points from which the second can be passed and the last stopped at."""
        get = self._params.__getitem__
        acc, jerk, radius = get("MPC_ACC_HOR"), get("MPC_JERK_AUTO"), get("NAV_ACC_RAD")
        here, corner, end = (point[:2] for point in points)
        after = hypot(*(end - corner))
        at_corner = 0.0
        if after > 1e-3 and after >= radius:
            before = hypot(*(corner - here))
            cosine = float((corner - here) @ (corner - end)) / max(before * after, 1e-9)
            half = min(acos(min(max(cosine, -1.0), 1.0)), pi - 1e-7) / 2
            in_turn = sqrt(get("MPC_XY_TRAJ_P") * acc * radius * tan(half))
            at_corner = min(in_turn, cruise, _speed_from_distance(after, 0.0, acc, jerk))
        return min(cruise, _speed_from_distance(hypot(*(corner - here)), at_corner, acc, jerk))

    def _climb_speed(self, height: float, p: np.ndarray) -> float:
        """Return the highest vertical speed on the way to a height [m/s]."""
        get = self._params.__getitem__
        to_go = height - self._axes[2].p
        top, acc = get("MPC_Z_V_AUTO_DN"), get("MPC_ACC_DOWN_MAX")
        if to_go < 0:
            top, acc = get("MPC_Z_V_AUTO_UP"), get("MPC_ACC_UP_MAX")
            if self._lifts_off(p):
                top = get("MPC_TKO_SPEED")
        return min(top, _speed_from_distance(abs(to_go), 0.0, acc, get("MPC_JERK_AUTO")))

    def _lifts_off(self, p: np.ndarray) -> bool:
        takes_off = self._task is not None and self._task.kind == tasks.TAKEOFF
        return takes_off and -float(p[2]) < self._params["MPC_LAND_ALT1"]

    def _landing_speed(self, p: np.ndarray) -> float:
        get = self._params.__getitem__
        high, low = get("MPC_LAND_ALT1"), get("MPC_LAND_ALT2")
        share = min(max((-float(p[2]) - low) / (high - low), 0.0), 1.0)
        return get("MPC_LAND_SPEED") + share * (get("MPC_Z_V_AUTO_DN") - get("MPC_LAND_SPEED"))

    def _arrive(self, dt: float, p: np.ndarray) -> None:
        task, get = self._task, self._params.__getitem__
        assert task is not None
        self.touches_down = self._landing
        if self._landing or task.kind == tasks.HOLD:
            return
        offset = self._target - p
        near = abs(offset[2]) < get("NAV_MC_ALT_RAD") and hypot(*offset[:2]) < get("NAV_ACC_RAD")
        if task.kind == tasks.TAKEOFF and not self._steps:
            near = -p[2] > -self._target[2] - get("NAV_MC_ALT_RAD")
        if self._waited > 0 or near or task.kind == tasks.DELAY:
            self._waited += dt
            if self._waited < task.hold_s:
                return
            self._waited = 0.0
            if self._steps:
                self._task = self._steps.pop(0)
                self._set_target(np.array(self._task.target, float), self._target)
            elif task.kind == tasks.LAND:
                self._landing = True
            else:
                self.finished = True

    def heading(self, p: np.ndarray, ref: Reference) -> float | None:
        """Return the heading to fly, towards the waypoint; None: keep it."""
        offset = self._target - p
        return atan2(offset[1], offset[0]) if hypot(*offset[:2]) > self._params["NAV_ACC_RAD"] else None


def _within(offset: np.ndarray, horizontal: float, vertical: float) -> np.ndarray:
    """Return the velocity along an offset within both limits [m/s]; slow components are limited apart."""
    v = offset / max(float(np.linalg.norm(offset)), 1e-9) * hypot(horizontal, vertical)
    for part, limit in ((slice(0, 2), horizontal), (slice(2, 3), vertical)):
        size = float(np.linalg.norm(v[part]))
        if size > limit:
            slow = limit < _SLOW and size < _SLOW
            v[part if slow else slice(0, 3)] *= limit / size
    return v


def _speed_from_distance(distance: float, final: float, acc: float, jerk: float) -> float:
    """Return the speed from which braking to `final` is possible with a ramp of acceleration [m/s]."""
    b = 4 * acc * acc / jerk
    return max(0.5 * (sqrt(b * b + 8 * acc * distance + 4 * final * final) - b), final)
