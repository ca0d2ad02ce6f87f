"""Guidance of a PX4 multirotor: a jerk-limited velocity follows the line to the waypoint, integrated to a position.

    speed = speed from which braking to the corner speed is possible, at most MPC_XY_CRUISE or the commanded one
    velocity target = speed towards a point of the line ahead;   a, v, p by jerk-limited steps, each axis alone
    trajectory time runs slower while p is ahead of the aircraft, and stops at MPC_XY_ERR_MAX

The waypoint is reached within NAV_ACC_RAD and NAV_MC_ALT_RAD. The time it takes to turn the nose is not waited for.
Source: PX4 documentation of the multicopter trajectory and position control, parameter names and defaults.
"""

from collections.abc import Callable
from math import atan2, hypot, pi, sqrt, tan

import numpy as np

from fleet.simulator.multirotor import tasks
from fleet.simulator.multirotor.position import Reference
from fleet.simulator.multirotor.tasks import Task

_SLACK_S = 1.0  # time on the ground until the motors have spun up: COM_SPOOLUP_TIME [s]
_MIN_SPEED = 0.1  # corner speed of a full turn [m/s]


class Px4Guidance:
    """Guidance of one PX4 multirotor; `start` begins a task, `step` returns the reference."""

    def __init__(self, params: dict[str, float]):
        self._params = params
        self.finished = False
        self.touches_down = False
        self._p, self._v, self._a = (np.zeros(3) for _ in range(3))
        self._task: Task | None = None
        self._b = np.zeros(3)

    def start(self, task: Task, p: np.ndarray, v: np.ndarray) -> None:
        """Begin a task at a position and velocity, NED; the trajectory goes on from where it is."""
        if self._task is None or np.linalg.norm(self._p - p) > 4.0:
            self._p, self._v, self._a = p.copy(), v.copy(), np.zeros(3)
        previous = self._b if self._task is not None else p
        self._task, self.finished, self._waited = task, False, 0.0
        self._steps: list[Task] = []
        self._prev = np.array(previous, float)
        self._landing = False
        target = task.target
        if task.kind in (tasks.DELAY, tasks.HOLD):
            target = self._p + self._v * float(np.linalg.norm(self._v)) / (2 * self._params["MPC_ACC_HOR"])
        elif task.kind == tasks.TAKEOFF:
            target, self._waited = np.array([*p[:2], min(task.target[2], p[2])]), -_SLACK_S
        elif task.kind == tasks.RETURN:
            top = min(-self._params["RTL_RETURN_ALT"], float(p[2]))
            over_home = Task(tasks.WAYPOINT, -1, np.array([0.0, 0.0, top]), self._params["RTL_LAND_DELAY"] + 0.5)
            self._steps = [over_home, Task(tasks.LAND, -1, np.array([1e-9, 0.0, top]))]
            target = np.array([*p[:2], top])
        elif task.kind == tasks.LAND:
            target = np.array([*(task.target[:2] if np.any(task.target[:2]) else p[:2]), p[2]])
        self._b = np.array(target, float)

    def step(self, dt: float, p: np.ndarray, v: np.ndarray, following: Callable[[], Task | None]) -> Reference:
        """Advance by dt [s] and return the reference; `following` returns the task after this one."""
        task = self._task
        assert task is not None
        if self._waited < 0:
            self._waited = min(self._waited + dt, 0.0)
            self._p = p.copy()
            return Reference(self._p, np.zeros(3), np.zeros(3))
        get = self._params.__getitem__
        target = self._velocity_target(p, following)
        behind = float((self._p - p)[:2] @ self._v[:2]) / max(hypot(*self._v[:2]), 1e-3)
        stretch = min(max(1.0 - behind / get("MPC_XY_ERR_MAX"), 0.0), 1.0)  # trajectory time over time
        for axis in range(3):
            vertical = get("MPC_ACC_UP_MAX" if target[2] < 0 else "MPC_ACC_DOWN_MAX")
            limit, step = (get("MPC_ACC_HOR"), dt * stretch) if axis < 2 else (vertical, dt)
            self._step_axis(axis, float(target[axis]), limit, step)
            self._p[axis] += self._v[axis] * step
        self._arrive(dt, p)
        return Reference(self._p.copy(), self._v.copy(), self._a.copy())

    def _step_axis(self, axis: int, target: float, limit: float, dt: float) -> None:
        """Advance acceleration and velocity of one axis towards a velocity, limited in jerk."""
        jerk = self._params["MPC_JERK_AUTO"]
        error = target - self._v[axis]
        a_c = min(sqrt(2 * jerk * abs(error)), limit) * (1 if error > 0 else -1)
        self._a[axis] += min(max(a_c - self._a[axis], -jerk * dt), jerk * dt)
        if abs(error) <= abs(self._a[axis]) * dt and abs(self._a[axis]) <= 2 * jerk * dt:
            self._v[axis], self._a[axis] = target, 0.0
        else:
            self._v[axis] += self._a[axis] * dt

    def _velocity_target(self, p: np.ndarray, following: Callable[[], Task | None]) -> np.ndarray:
        get, task = self._params.__getitem__, self._task
        assert task is not None
        if self._landing:
            return np.array([*self._towards(0.0, task)[:2], self._landing_speed(p)])
        exit_speed = 0.0
        if task.passes and not self._steps and (after := following()) is not None and after.kind == tasks.WAYPOINT:
            exit_speed = self._corner_speed(after.target)
        v = self._towards(exit_speed, task)
        dz = float(self._b[2] - self._p[2])
        acc = get("MPC_ACC_DOWN_MAX") if dz < 0 else get("MPC_ACC_UP_MAX")
        speed = _speed_from_distance(abs(dz), 0.0, acc, get("MPC_JERK_AUTO"))
        if task.kind == tasks.TAKEOFF:
            speed = min(speed, get("MPC_TKO_SPEED"))
        v[2] = min(speed, get("MPC_Z_V_AUTO_DN")) if dz > 0 else -min(speed, get("MPC_Z_V_AUTO_UP"))
        return v

    def _towards(self, exit_speed: float, task: Task) -> np.ndarray:
        """Return the horizontal velocity towards a point of the line ahead, (3,)."""
        get = self._params.__getitem__
        offset = (self._b - self._p)[:2]
        distance = hypot(*offset)
        if distance < 0.05:
            return np.zeros(3)
        speed = min(
            _speed_from_distance(distance, exit_speed, get("MPC_ACC_HOR"), get("MPC_JERK_AUTO")),
            task.speed or get("MPC_XY_CRUISE"),
        )
        line = (self._b - self._prev)[:2]
        length = hypot(*line)
        aim = self._b[:2]
        if length > 1.0:
            along = float((self._p[:2] - self._prev[:2]) @ line) / length
            aim = self._prev[:2] + line / length * min(max(along, 0.0) + max(get("NAV_ACC_RAD"), 5.0), length)
        direction = aim - self._p[:2]
        return np.array([*(speed * direction / max(hypot(*direction), 1e-6)), 0.0])

    def _corner_speed(self, after: np.ndarray) -> float:
        """Return the speed at the end of this leg: an arc within the acceptance radius at half the acceleration."""
        inward, outward = (self._b - self._prev)[:2], (after - self._b)[:2]
        size = hypot(*inward) * hypot(*outward)
        if size < 1e-3:
            return _MIN_SPEED
        cosine = min(max(-float(inward @ outward) / size, -1.0), 1.0)
        angle = np.arccos(cosine)  # inside the corner; pi is straight on
        if angle > pi - 1e-3:
            return 1e3
        reach = min(self._params["NAV_ACC_RAD"], hypot(*inward) / 2)
        return max(sqrt(0.5 * self._params["MPC_ACC_HOR"] * reach * tan(angle / 2)), _MIN_SPEED)

    def _landing_speed(self, p: np.ndarray) -> float:
        get = self._params.__getitem__
        high, low = get("MPC_LAND_ALT1"), get("MPC_LAND_ALT2")
        share = min(max((-float(p[2]) - low) / (high - low), 0.0), 1.0)
        return get("MPC_LAND_SPEED") + share * (get("MPC_Z_V_AUTO_DN") - get("MPC_LAND_SPEED"))

    def _arrive(self, dt: float, p: np.ndarray) -> None:
        task, get = self._task, self._params.__getitem__
        assert task is not None
        self.touches_down = self._landing
        offset = self._b - p
        radius = get("NAV_ACC_RAD") if task.kind == tasks.WAYPOINT and not self._steps else 2.0
        if self._landing or task.kind == tasks.HOLD:
            return
        if self._waited > 0 or (hypot(*offset[:2]) < radius and abs(offset[2]) < get("NAV_MC_ALT_RAD")):
            self._waited += dt
            if self._waited < task.hold_s:
                return
            self._waited = 0.0
            if self._steps:
                self._prev, self._task = self._b, self._steps.pop(0)
                self._b = np.array(self._task.target, float)
            elif task.kind == tasks.LAND:
                self._landing = True
            else:
                self.finished = True

    def heading(self, p: np.ndarray, ref: Reference) -> float | None:
        """Return the heading to fly, towards the waypoint; None: keep it."""
        offset = self._b - p
        return atan2(offset[1], offset[0]) if hypot(*offset[:2]) > self._params["NAV_ACC_RAD"] else None


def _speed_from_distance(distance: float, final: float, acc: float, jerk: float) -> float:
    """Return the speed from which braking to `final` is possible with a ramp of acceleration [m/s]."""
    b = 4 * acc * acc / jerk
    c = -2 * acc * distance - final * final
    return max(0.5 * (-b + sqrt(b * b - 4 * c)), final if distance < 0.1 else 0.0)
