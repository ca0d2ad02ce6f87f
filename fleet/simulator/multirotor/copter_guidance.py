"""Guidance of ArduCopter: straight legs flown by jerk-limited profiles of time that overlap at corners, and circles.

A leg is planned from rest to rest: seven phases of constant jerk or acceleration, with a jerk that rises and falls as a
cosine over twice ATC_INPUT_TC. The next leg begins in its deceleration, as soon as the corner cut by the sum of both
stays within WPNAV_RADIUS and below the corner acceleration. A commanded speed changes a leg that has begun after its
acceleration. Profile time runs slower while the aircraft lags behind. The target on a circle is shaped.

Source: ArduCopter documentation (S-curve navigation, circle, RTL and land modes), its parameter names and defaults.
"""

from collections.abc import Callable
from math import atan2, cos, hypot, pi, radians, sin, sqrt

import numpy as np

from fleet.simulator.multirotor import tasks
from fleet.simulator.multirotor.attitude import square_root_control
from fleet.simulator.multirotor.position import Reference, ShapedPosition
from fleet.simulator.multirotor.tasks import Task

_CM = 0.01
_SLACK_S = 0.5  # time on the ground until the motors have spun up: MOT_SPOOL_TIME [s]
_PLACE_M, _EDGE_M = 0.01, 3.0  # rounding of a place; largest distance at which a circle begins at once [m]
_SHAPING_STEPS = 4  # of the target of a circle in one step
_CHANGE_RISES = 12.0  # of the jerk that a change of speed within a leg needs at least
_MIN_CIRCLE_ACC = radians(2.0)  # smallest angular acceleration of a circle [rad/s2]


_Phase = tuple[float, float, int]
"""Duration, jerk, and whether it rises (1), falls (-1) or is constant (0)."""


class Profile:
    """Distance over time from rest to rest, limited in speed, acceleration, jerk and rise of the jerk."""

    def __init__(
        self, length: float, speed: float, limits: tuple[float, float], rise: float = 0.0, then: float | None = None
    ):
        """Plan over a length [m].

        Args:
            length: [m]
            speed: limit [m/s]
            limits: of acceleration and jerk [m/s2, m/s3]
            rise: time in which the jerk rises and falls [s]
            then: speed after the acceleration, if it differs and the leg is long enough [m/s]
        """
        self.length, self.limit = length, speed if then is None else then
        acc, jerk = limits
        if rise > 0 and 0 < length < 8.0 * jerk * rise**3:  # the jerk is not reached
            snap = pi * jerk / (2 * rise)
            rise = (pi * length / (16 * snap)) ** 0.25
            jerk = 2 * snap * rise / pi
        self._rise = rise
        acc, speed = _peak(length, speed, acc, (jerk, rise))
        if acc < jerk * rise:
            jerk = acc / rise
        last, up = speed, _ramp(speed, acc, (jerk, rise))
        down, change = _ramp(-speed, acc, (jerk, rise)), tuple[_Phase, ...]()
        distance = speed * _duration(up)
        if then is not None and abs(then - speed) > 1e-3 and length - distance > _CHANGE_RISES * rise * speed > 0:
            last = min(then, (length - distance) / (_CHANGE_RISES * rise)) if then > speed else then
            change, down = _ramp(last - speed, acc, (jerk, rise)), _ramp(-last, acc, (jerk, rise))
            distance = (speed * _duration(up) + (speed + last) * _duration(change) + last * _duration(down)) / 2
        cruise = max(length - distance, 0.0) / last if last > 0 else 0.0
        self._phases = (*up, *change, (cruise, 0.0, 0), *down)
        self.duration, self.braking_s = _duration(self._phases), _duration(down)
        self.accelerating_s, self.speed, self.acc = _duration(up), speed, limits[0]

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


def _pulse(jerk: float, rise: float, constant: float) -> tuple[_Phase, ...]:
    """Return the phases of a pulse of jerk: duration, jerk, and whether it rises or falls."""
    return ((rise, jerk, 1), (constant, jerk, 0), (rise, jerk, -1)) if rise > 0 else ((constant, jerk, 0),)


def _ramp(change: float, acc: float, jerk_rise: tuple[float, float]) -> tuple[_Phase, ...]:
    """Return the phases of a change of speed [m/s] within the acceleration limit."""
    jerk, rise = jerk_rise
    size, sense = abs(change), 1.0 if change > 0 else -1.0
    if size < 1e-9 or acc <= 0:
        return ()
    if size < acc * (max(acc / jerk, rise) + rise):  # without constant acceleration
        acc = min(acc, max((sqrt(rise**2 * jerk**2 + 4 * jerk * size) - rise * jerk) / 2, 0.0))
        if acc < jerk * rise:
            acc = size / (2 * rise)
            jerk = acc / rise
    constant = max(acc / jerk - rise, 0.0)
    steady = max(size / acc - acc / jerk - rise, 0.0)
    first, last = (_pulse(sign * sense * jerk, rise, constant) for sign in (1.0, -1.0))
    return (*first, (steady, 0.0, 0), *last)


def _duration(phases: tuple[_Phase, ...]) -> float:
    return sum(time for time, _, _ in phases)


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


def _stop_time(speed: float, gain: float, acc: float) -> float:
    """Return the distance in which the position controller stops, over the speed [s]."""
    return 1 / gain if speed <= acc / gain else (speed / acc + acc / (gain**2 * speed)) / 2


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
        self.restarts = False  # the position controller is to take over the present tilt
        self._leg = Leg(np.zeros(3), np.full(3, 1e9), Profile(0.0, 1.0, (1.0, 1.0)))
        self._tail: Leg | None = None
        self._lead: Leg | None = None
        self._circle: dict[str, float] | None = None
        self._shaped: ShapedPosition | None = None
        self._scale = 1.0

    def start(self, task: Task, p: np.ndarray, v: np.ndarray) -> None:
        """Begin a task at a position and velocity, NED; a leg begun before the corner goes on."""
        self._task, self.finished, self._waited = task, False, 0.0
        self._steps: list[Task] = []
        if self._lead is not None and task.kind == tasks.WAYPOINT and np.allclose(self._lead.b, task.target):
            self._tail, self._leg, self._lead = self._leg, self._lead, None
            self._change_speed(task.speed)
            return
        self._tail = self._lead = None
        self.restarts |= self._circle is not None
        acc = self._params["WPNAV_ACCEL"] * _CM
        origin = p + v * _stop_time(float(np.linalg.norm(v)), self._params["PSC_POSXY_P"], acc)
        previous = self._leg
        if np.linalg.norm(v) < 0.7 and np.linalg.norm(previous.b - p) < 2.0:
            origin = previous.b  # waits at its target
        self._begin(task, origin, v)

    def _begin(self, task: Task, origin: np.ndarray, v: np.ndarray) -> None:
        self._circle = None
        self._descent: list[float] | None = None
        target = task.target
        if task.kind in (tasks.DELAY, tasks.HOLD):
            target = origin
        elif task.kind == tasks.TAKEOFF:
            target = np.array([*origin[:2], min(task.target[2], origin[2])])
            self._waited = -_SLACK_S
        elif task.kind == tasks.RETURN:
            target = self._return(origin, float(v[2]))
        elif task.kind == tasks.TURNS:
            target = self._circle_entry(task, origin)
        elif task.kind == tasks.LAND:
            target = np.array([*(task.target[:2] if np.any(task.target[:2]) else origin[:2]), origin[2]])
        jerk = "PSC_JERK_Z" if task.kind == tasks.TAKEOFF else "WPNAV_JERK"
        self._leg = self._plan(origin, target, task.speed, jerk)

    def _return(self, origin: np.ndarray, v_down: float) -> np.ndarray:
        """Plan a climb within the cone above home, the way home and the landing; return the end of the climb."""
        cone = max(hypot(*origin[:2]) * self._params["RTL_CONE_SLOPE"], -float(origin[2]))
        top = min(-min(self._params["RTL_ALT"] * _CM, cone), float(origin[2]))
        if top > origin[2] - _PLACE_M:  # from the stopping point to the present height, if no further
            top = float(origin[2]) - max(_PLACE_M, abs(v_down) / self._params["PSC_POSZ_P"])
        over_home = Task(tasks.WAYPOINT, -1, np.array([0.0, 0.0, top]), self._params["RTL_LOIT_TIME"] * 1e-3)
        self._steps = [over_home, Task(tasks.LAND, -1, np.array([1e-9, 0.0, top]))]
        return np.array([*origin[:2], top])

    def _circle_entry(self, task: Task, origin: np.ndarray) -> np.ndarray:
        radius = abs(task.radius) or self._params["CIRCLE_RADIUS"] * _CM
        offset = origin[:2] - task.target[:2]
        angle = atan2(offset[1], offset[0]) if hypot(*offset) > 0.1 else 0.0
        sense = 1.0 if task.radius >= 0 else -1.0
        self._circle = {"radius": radius, "angle": angle, "rate": 0.0, "turned": 0.0, "sense": sense}
        self._shaped = None
        edge = np.array([*(task.target[:2] + radius * np.array([cos(angle), sin(angle)])), task.target[2]])
        return edge if np.linalg.norm(edge - origin) > _EDGE_M else origin

    def _change_speed(self, speed: float) -> None:
        """Apply a commanded speed to a leg that has begun with the speed before.

        The acceleration reaches its limit in any case, and ends then as soon as its jerk permits.
        """
        leg, new = self._leg, self._plan(self._leg.a, self._leg.b, speed).profile
        _, v, a = leg.profile.at(leg.t)
        jerk, rise = self._params["WPNAV_JERK"], 2 * max(self._params["ATC_INPUT_TC"], 0.1)
        if abs(new.limit - leg.profile.limit) < 1e-3:
            return
        top = leg.profile.speed
        if new.limit < leg.profile.limit and a >= 0.0:
            begun = max(new.acc / jerk - rise, 0.0) + 2 * rise
            v_full, a_full = (v, a) if leg.t > begun else leg.profile.at(begun)[1:]
            top = min(max(new.limit, v_full + 0.5 * a_full * (a_full / jerk + rise)), top)
        profile = Profile(leg.profile.length, top, (new.acc, jerk), rise, new.limit)
        self._leg = Leg(leg.a, leg.b, profile, leg.t)

    def _plan(self, a: np.ndarray, b: np.ndarray, speed: float, jerk: str = "WPNAV_JERK") -> Leg:
        get = self._params.__getitem__
        length = float(np.linalg.norm(b - a))
        across, rise = (hypot(*(b - a)[:2]) / length, (a[2] - b[2]) / length) if length > 1e-6 else (1.0, 0.0)
        vertical = get("WPNAV_SPEED_UP" if rise > 0 else "WPNAV_SPEED_DN") * _CM
        horizontal = speed or get("WPNAV_SPEED") * _CM
        top = min(horizontal / max(across, 1e-3), vertical / max(abs(rise), 1e-3))
        acc = min(get("WPNAV_ACCEL") * _CM / max(across, 1e-3), get("WPNAV_ACCEL_Z") * _CM / max(abs(rise), 1e-3))
        return Leg(a, b, Profile(length, top, (acc, get(jerk)), 2 * max(get("ATC_INPUT_TC"), 0.1)))

    def step(self, dt: float, p: np.ndarray, v: np.ndarray, following: Callable[[], Task | None]) -> Reference:
        """Advance by dt [s] and return the reference; `following` returns the task after this one."""
        if self._descent is not None:
            return self._descend(dt, p)
        if self._waited < 0:  # on the ground, motors spin up
            self._waited = min(self._waited + dt, 0.0)
            return Reference(self._leg.a, np.zeros(3), np.zeros(3))
        if self._circle is not None and self._circle["turned"] >= 0 and self._leg.left_s <= 0:
            return self._turn(dt, p, v)
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
        climbs = self._task.kind == tasks.RETURN and bool(self._steps)
        if self._lead is None and (climbs or (self._task.passes and not self._steps)):
            self._lead = self._corner(leg, self._steps[0] if climbs else following())
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
        if task is None or task.kind != tasks.WAYPOINT:
            return None
        lead = self._plan(leg.b, task.target, self._task.speed)
        left = leg.left_s
        if not 0 <= left <= min(leg.profile.braking_s, lead.profile.accelerating_s):
            return None
        half = leg.at(leg.t + left / 2) + lead.at(left / 2)
        half[0] += leg.a - leg.b
        get = self._params.__getitem__
        corner = get("WPNAV_ACCEL_C") * _CM or 2 * get("WPNAV_ACCEL") * _CM
        slow = float(np.linalg.norm(half[1])) < min(leg.profile.limit, lead.profile.limit)
        near = float(np.linalg.norm(half[0])) < get("WPNAV_RADIUS") * _CM
        level = abs(float(half[2, 2])) < get("WPNAV_ACCEL_Z") * _CM
        return lead if near and slow and level and hypot(*half[2, :2]) < corner else None

    def _update_scale(self, dt: float, p: np.ndarray, v: np.ndarray, state: np.ndarray) -> None:
        """Slow the profile down while the aircraft lags behind the reference."""
        speed = float(np.linalg.norm(state[1]))
        target = 1.0
        if speed > 1e-3 and self._task.kind != tasks.TAKEOFF:
            direction = state[1] / speed
            behind, along = float((state[0] - p) @ direction), float(v @ direction)
            target = 0.05 + (along - self._params["PSC_POSXY_P"] * behind) / speed
        time_constant = self._params["WPNAV_ACCEL"] * _CM / self._params["WPNAV_JERK"]
        self._scale += (min(max(target, 0.0), 1.0) - self._scale) * dt / (dt + time_constant)

    def _arrive(self, dt: float, p: np.ndarray, v: np.ndarray) -> None:
        if self._lead is not None:
            if self._lead.t < self._leg.left_s:
                return
            if self._steps:  # from the climb of a return to the way home
                self._task = self._steps.pop(0)
                self._tail, self._leg, self._lead = self._leg, self._lead, None
            else:
                self.finished = True
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

    def _turn(self, dt: float, p: np.ndarray, v: np.ndarray) -> Reference:
        """Fly the circle; its speed is limited by half the acceleration."""
        c = self._circle
        assert c is not None
        acc, radius, sense = self._params["WPNAV_ACCEL"] * _CM, c["radius"], c["sense"]
        top = self._task.speed or self._params["WPNAV_SPEED"] * _CM
        centre = self._task.target
        if self._shaped is None:  # at rest at the stopping point
            stop = p + v * _stop_time(hypot(*v[:2]), self._params["PSC_POSXY_P"], acc)
            self._shaped = ShapedPosition(stop[:2], (top, acc, self._params["PSC_JERK_XY"]))
            c["angle"] = atan2(*(stop - centre)[1::-1])
            self.restarts = True
        rate = min(radians(abs(self._params["CIRCLE_RATE"])), min(top, sqrt(0.5 * acc * radius)) / radius)
        h = dt / _SHAPING_STEPS
        for _ in range(_SHAPING_STEPS):
            c["rate"] = min(c["rate"] + max(acc / radius, _MIN_CIRCLE_ACC) * h, rate)
            c["angle"] += sense * c["rate"] * h
            c["turned"] += c["rate"] * h
            self._shaped.step(centre[:2] + radius * np.array([cos(c["angle"]), sin(c["angle"])]), h)
        self.finished = c["turned"] >= 2 * pi * max(self._task.turns, 1.0)
        one = self._shaped
        return Reference(np.array([*one.p, self._leg.b[2]]), np.array([*one.v, 0.0]), np.array([*one.a, 0.0]))

    def _descend(self, dt: float, p: np.ndarray) -> Reference:
        """Descend at WPNAV_SPEED_DN, then at LAND_SPEED below LAND_ALT_LOW."""
        self.touches_down = True
        get = self._params.__getitem__
        d = self._descent
        assert d is not None
        high = (get("LAND_SPEED_HIGH") or get("WPNAV_SPEED_DN")) * _CM
        low = get("LAND_ALT_LOW") * _CM + float(p[2])  # height above the lower part [m], negative when above
        slow = get("LAND_SPEED") * _CM
        speed = min(high, max(slow, square_root_control(max(-low, 0.0), get("PSC_POSZ_P"), get("WPNAV_ACCEL_Z") * _CM)))
        d[1] += min(max(speed - d[1], -get("WPNAV_ACCEL_Z") * _CM * dt), get("WPNAV_ACCEL_Z") * _CM * dt)
        d[0] = min(d[0] + d[1] * dt, float(p[2]) + 1.0)  # not far below the aircraft, nor into the ground
        return Reference(np.array([*self._leg.b[:2], d[0]]), np.array([0.0, 0.0, d[1]]), np.zeros(3))

    def heading(self, p: np.ndarray, ref: Reference) -> float | None:
        """Return the heading to fly: towards the destination, or to the centre of a circle; None: keep it."""
        point = self._leg.b if self._circle is None else self._task.target
        offset = (self._leg.b if self._leg.left_s > 0 else point) - p
        far = hypot(*offset[:2]) > 2.0 and (self._circle is not None or self._leg.left_s > 0)
        return atan2(offset[1], offset[0]) if far else None
