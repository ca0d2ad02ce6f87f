"""Guidance of ArduCopter: straight legs flown by jerk-limited profiles of time that overlap at corners, and circles.

A leg is planned from rest to rest: seven phases of constant jerk or acceleration, with a jerk that rises and falls as a
cosine over twice ATC_INPUT_TC. The next leg begins before the present one ends, so
that its acceleration overlaps the deceleration, as soon as the corner cut by the sum of both stays within WPNAV_RADIUS
and below the corner acceleration. Profile time runs slower while the aircraft lags behind the reference.

Source: ArduCopter documentation (S-curve navigation, circle, RTL and land modes), its parameter names and defaults.
"""

from collections.abc import Callable
from math import atan2, cos, hypot, pi, radians, sin, sqrt

import numpy as np

from fleet.simulator.multirotor import tasks
from fleet.simulator.multirotor.position import Reference
from fleet.simulator.multirotor.tasks import Task

_CM = 0.01
_SLACK_S = 0.5  # time on the ground until the motors have spun up: MOT_SPOOL_TIME [s]
_MIN_CIRCLE_ACC = radians(2.0)  # smallest angular acceleration of a circle [rad/s2]


class Profile:
    """Distance over time from rest to rest, limited in speed, acceleration, jerk and rise of the jerk."""

    def __init__(self, length: float, speed: float, limits: tuple[float, float], rise: float = 0.0):
        """Plan over a length [m].

        Args:
            length: [m]
            speed: limit [m/s]
            limits: of acceleration and jerk [m/s2, m/s3]
            rise: time in which the jerk rises and falls [s]
        """
        self.length, self._rise = length, rise
        acc, jerk = limits
        acc, speed = _peak(length, speed, acc, (jerk, rise))
        if acc < jerk * rise:  # the jerk is not reached
            jerk = acc / rise
        constant = max(acc / jerk - rise, 0.0) if acc > 0 else 0.0
        steady = max(speed / acc - acc / jerk - rise, 0.0) if acc > 0 else 0.0
        cruise = max(length / speed - speed / acc - acc / jerk - rise, 0.0) if acc > 0 else 0.0
        up, down = (_pulse(sign * jerk, rise, constant) for sign in (1.0, -1.0))
        self._phases = (*up, (steady, 0.0, 0), *down, (cruise, 0.0, 0), *down, (steady, 0.0, 0), *up)
        self.duration = sum(time for time, _, _ in self._phases) if acc > 0 else 0.0
        self.speed = speed

    def at(self, t: float) -> tuple[float, float, float]:
        """Return distance, speed and acceleration at a time [s]."""
        if t >= self.duration:
            return self.length, 0.0, 0.0
        s = v = a = 0.0
        for duration, jerk, change in self._phases:
            h = min(t, duration)
            ds, dv, da = self._gain(h, jerk, change)
            s += h * (v + h * a / 2) + ds
            v += h * a + dv
            a += da
            t -= h
            if t <= 0:
                break
        return s, v, a

    def _gain(self, t: float, jerk: float, change: int) -> tuple[float, float, float]:
        """Return distance, speed and acceleration gained by a jerk that rises (1), falls (-1) or is constant (0)."""
        if not change:
            return jerk * t**3 / 6, jerk * t**2 / 2, jerk * t
        w = pi / self._rise
        wave = change * sin(w * t) / w
        return (
            jerk / 2 * (t**3 / 6 + (wave - change * t) / w**2),
            jerk / 2 * (t**2 / 2 + change * (cos(w * t) - 1) / w**2),
            jerk / 2 * (t - wave),
        )


def _pulse(jerk: float, rise: float, constant: float) -> tuple[tuple[float, float, int], ...]:
    """Return the phases of a pulse of jerk: duration, jerk, and whether it rises or falls."""
    return ((rise, jerk, 1), (constant, jerk, 0), (rise, jerk, -1)) if rise > 0 else ((constant, jerk, 0),)


def _peak(length: float, speed: float, acc: float, jerk_rise: tuple[float, float]) -> tuple[float, float]:
    """Return acceleration and speed that are reached on a length, within their limits [m/s2, m/s]."""
    jerk, rise = jerk_rise

    def ramps(a: float) -> float:
        return max(a / jerk, rise) + rise

    if length <= 1e-9 or speed <= 0:
        return 0.0, 0.0
    pause = ramps(acc)
    speed = min(speed, acc / 2 * (sqrt(pause**2 + 4 * length / acc) - pause))
    if speed >= acc * pause:
        return acc, speed
    low, high = 0.0, acc  # without constant acceleration
    for _ in range(50):
        a = (low + high) / 2
        top = a * ramps(a)
        low, high = (a, high) if top < speed and 2 * top * ramps(a) < length else (low, a)
    return low, min(low * ramps(low), speed)


class Leg:
    """A straight leg and the time flown on it."""

    def __init__(self, a: np.ndarray, b: np.ndarray, profile: Profile, t: float = 0.0):
        self.a, self.b, self.profile, self.t = a, b, profile, t
        length = float(np.linalg.norm(b - a))
        self._direction = (b - a) / length if length > 1e-6 else np.zeros(3)

    @property
    def left_s(self) -> float:
        """Return the time to its end [s]."""
        return self.profile.duration - self.t

    def at(self, t: float) -> np.ndarray:
        """Return position, velocity, acceleration from its start at a time, (3, 3)."""
        return np.outer(self.profile.at(t), self._direction)


class CopterGuidance:
    """Guidance of one ArduCopter; `start` begins a task, `step` returns the reference."""

    def __init__(self, params: dict[str, float]):
        self._params = params
        self.finished = False
        self.touches_down = False  # the task ends on the ground
        self._leg = Leg(np.zeros(3), np.full(3, 1e9), Profile(0.0, 1.0, (1.0, 1.0)))
        self._tail: Leg | None = None
        self._lead: Leg | None = None
        self._scale = 1.0

    def start(self, task: Task, p: np.ndarray, v: np.ndarray) -> None:
        """Begin a task at a position and velocity, NED; a leg begun before the corner goes on."""
        self._task, self.finished, self._waited = task, False, 0.0
        self._steps: list[Task] = []
        if self._lead is not None and task.kind == tasks.WAYPOINT and np.allclose(self._lead.b, task.target):
            self._tail, self._leg, self._lead = self._leg, self._lead, None
            return
        self._tail = self._lead = None
        acc = self._params["WPNAV_ACCEL"] * _CM
        origin = p + v * float(np.linalg.norm(v)) / (2 * acc)
        previous = self._leg
        if np.linalg.norm(v) < 0.7 and np.linalg.norm(previous.b - p) < 2.0:
            origin = previous.b  # waits at its target
        self._begin(task, origin, p)

    def _begin(self, task: Task, origin: np.ndarray, p: np.ndarray) -> None:
        self._circle: dict[str, float] | None = None
        self._descent: list[float] | None = None
        target = task.target
        if task.kind in (tasks.DELAY, tasks.HOLD):
            target = origin
        elif task.kind == tasks.TAKEOFF:
            target = np.array([*origin[:2], min(task.target[2], origin[2])])
            self._waited = -_SLACK_S
        elif task.kind == tasks.RETURN:
            target = self._return(origin)
        elif task.kind == tasks.TURNS:
            target = self._circle_entry(task, origin)
        elif task.kind == tasks.LAND:
            target = np.array([*(task.target[:2] if np.any(task.target[:2]) else origin[:2]), origin[2]])
        self._leg = self._plan(origin, target, task.speed)

    def _return(self, origin: np.ndarray) -> np.ndarray:
        top = min(-self._params["RTL_ALT"] * _CM, float(origin[2]))
        over_home = Task(tasks.WAYPOINT, -1, np.array([0.0, 0.0, top]), self._params["RTL_LOIT_TIME"] * 1e-3)
        self._steps = [over_home, Task(tasks.LAND, -1, np.array([1e-9, 0.0, top]))]
        return np.array([*origin[:2], top])

    def _circle_entry(self, task: Task, origin: np.ndarray) -> np.ndarray:
        radius = abs(task.radius) or self._params["CIRCLE_RADIUS"] * _CM
        offset = origin[:2] - task.target[:2]
        angle = atan2(offset[1], offset[0]) if hypot(*offset) > 0.1 else 0.0
        sense = 1.0 if task.radius >= 0 else -1.0
        self._circle = {"radius": radius, "angle": angle, "rate": 0.0, "turned": 0.0, "sense": sense}
        return np.array([*(task.target[:2] + radius * np.array([cos(angle), sin(angle)])), task.target[2]])

    def _plan(self, a: np.ndarray, b: np.ndarray, speed: float) -> Leg:
        get = self._params.__getitem__
        length = float(np.linalg.norm(b - a))
        across, rise = (hypot(*(b - a)[:2]) / length, (a[2] - b[2]) / length) if length > 1e-6 else (1.0, 0.0)
        vertical = get("WPNAV_SPEED_UP" if rise > 0 else "WPNAV_SPEED_DN") * _CM
        horizontal = speed or get("WPNAV_SPEED") * _CM
        top = min(horizontal / max(across, 1e-3), vertical / max(abs(rise), 1e-3))
        acc = min(get("WPNAV_ACCEL") * _CM / max(across, 1e-3), get("WPNAV_ACCEL_Z") * _CM / max(abs(rise), 1e-3))
        return Leg(a, b, Profile(length, top, (acc, get("WPNAV_JERK")), 2 * max(get("ATC_INPUT_TC"), 0.1)))

    def step(self, dt: float, p: np.ndarray, v: np.ndarray, following: Callable[[], Task | None]) -> Reference:
        """Advance by dt [s] and return the reference; `following` returns the task after this one."""
        if self._descent is not None:
            return self._descend(dt, p)
        if self._waited < 0:  # on the ground, motors spin up
            self._waited = min(self._waited + dt, 0.0)
            return Reference(self._leg.a, np.zeros(3), np.zeros(3))
        if self._circle is not None and self._circle["turned"] >= 0 and self._leg.left_s <= 0:
            return self._turn(dt, following)
        state = self._advance(dt, following)
        self._update_scale(dt, p, v, state)
        self._arrive(dt, p, v)
        return Reference(*state)

    def _advance(self, dt: float, following: Callable[[], Task | None]) -> np.ndarray:
        """Advance the legs; return the reference (3, 3): the sum of the present leg and its neighbours."""
        step, leg = dt * self._scale, self._leg
        for part in (leg, self._tail, self._lead):
            if part is not None:
                part.t += step
        if self._tail is not None and self._tail.left_s <= 0:
            self._tail = None
        if self._lead is None and self._task.passes and not self._steps:
            self._lead = self._corner(leg, following())
        state = leg.at(leg.t)
        state[0] += leg.a
        if self._tail is not None:
            state += self._tail.at(self._tail.t)
            state[0] += self._tail.a - self._tail.b
        if self._lead is not None:
            state += self._lead.at(self._lead.t)
        return state

    def _corner(self, leg: Leg, task: Task | None) -> Leg | None:
        """Return the next leg when it may begin now; None: not yet, or the aircraft stops here."""
        if task is None or task.kind != tasks.WAYPOINT or leg.left_s > 12.0:
            return None
        lead = self._plan(leg.b, task.target, task.speed)
        left = leg.left_s
        if not 0 <= left < lead.profile.duration / 2:
            return None
        half = leg.at(leg.t + left / 2) + lead.at(left / 2)
        half[0] += leg.a - leg.b
        get = self._params.__getitem__
        corner = get("WPNAV_ACCEL_C") * _CM or 2 * get("WPNAV_ACCEL") * _CM
        slow = hypot(*half[1, :2]) < max(min(leg.profile.speed, lead.profile.speed), 0.1)
        near = float(np.linalg.norm(half[0])) < get("WPNAV_RADIUS") * _CM
        return lead if near and slow and hypot(*half[2, :2]) < corner else None

    def _update_scale(self, dt: float, p: np.ndarray, v: np.ndarray, state: np.ndarray) -> None:
        """Slow the profile down while the aircraft lags behind the reference."""
        speed = float(np.linalg.norm(state[1]))
        target = 1.0
        if speed > 0.1:
            direction = state[1] / speed
            behind, along = float((state[0] - p) @ direction), float(v @ direction)
            target = 0.05 + (along - self._params["PSC_POSXY_P"] * behind) / speed
        time_constant = self._params["WPNAV_ACCEL"] * _CM / self._params["WPNAV_JERK"]
        self._scale += (min(max(target, 0.0), 1.0) - self._scale) * dt / (dt + time_constant)

    def _arrive(self, dt: float, p: np.ndarray, v: np.ndarray) -> None:
        if self._lead is not None:
            self.finished = self._lead.t >= self._leg.left_s
            return
        if self._leg.left_s > 0 or self._circle is not None:
            return
        radius = self._params["WPNAV_RADIUS"] * _CM
        if self._waited > 0 or np.linalg.norm(p - self._leg.b) < radius:
            self._waited += dt
            if self._waited >= self._task.hold_s and self._task.kind != tasks.HOLD:
                self._complete(p, v)

    def _complete(self, p: np.ndarray, v: np.ndarray) -> None:
        """Continue with the next part of a return, descend, or finish."""
        self._waited = 0.0
        if self._steps:
            self._task = self._steps.pop(0)
            self._leg = self._plan(self._leg.b, self._task.target, 0.0)
        elif self._task.kind == tasks.LAND:
            self._descent = [float(self._leg.b[2]), 0.0]
        else:
            self.finished = True

    def _turn(self, dt: float, following: Callable[[], Task | None]) -> Reference:
        """Fly the circle; its speed is limited by half the acceleration."""
        c = self._circle
        assert c is not None
        acc, radius, sense = self._params["WPNAV_ACCEL"] * _CM, c["radius"], c["sense"]
        speed = min((self._task.speed or self._params["WPNAV_SPEED"] * _CM), sqrt(0.5 * acc * radius))
        rate = min(radians(abs(self._params["CIRCLE_RATE"])), speed / radius)
        c["rate"] = min(c["rate"] + max(acc / radius, _MIN_CIRCLE_ACC) * dt, rate)
        c["angle"] += sense * c["rate"] * dt
        c["turned"] += c["rate"] * dt
        self.finished = c["turned"] >= 2 * pi * max(self._task.turns, 1.0)
        out = np.array([cos(c["angle"]), sin(c["angle"])])
        ahead = sense * np.array([-out[1], out[0]])
        centre = self._task.target
        p = np.array([*(centre[:2] + radius * out), centre[2]])
        v = np.array([*(c["rate"] * radius * ahead), 0.0])
        return Reference(p, v, np.array([*(-(c["rate"] ** 2) * radius * out), 0.0]))

    def _descend(self, dt: float, p: np.ndarray) -> Reference:
        """Descend at WPNAV_SPEED_DN, then at LAND_SPEED below LAND_ALT_LOW."""
        self.touches_down = True
        get = self._params.__getitem__
        d = self._descent
        assert d is not None
        high = (get("LAND_SPEED_HIGH") or get("WPNAV_SPEED_DN")) * _CM
        low = get("LAND_ALT_LOW") * _CM + float(p[2])  # height above the lower part [m], negative when above
        slow = get("LAND_SPEED") * _CM
        speed = min(high, max(slow, sqrt(slow**2 + max(-2 * low * get("WPNAV_ACCEL_Z") * _CM, 0.0))))
        d[1] += min(max(speed - d[1], -get("WPNAV_ACCEL_Z") * _CM * dt), get("WPNAV_ACCEL_Z") * _CM * dt)
        d[0] = min(d[0] + d[1] * dt, float(p[2]) + 1.0)  # not far below the aircraft, nor into the ground
        return Reference(np.array([*self._leg.b[:2], d[0]]), np.array([0.0, 0.0, d[1]]), np.zeros(3))

    def heading(self, p: np.ndarray, ref: Reference) -> float | None:
        """Return the heading to fly: towards the destination, or to the centre of a circle; None: keep it."""
        point = self._leg.b if self._circle is None else self._task.target
        offset = (self._leg.b if self._leg.left_s > 0 else point) - p
        far = hypot(*offset[:2]) > 2.0 and (self._circle is not None or self._leg.left_s > 0)
        return atan2(offset[1], offset[0]) if far else None
