"""A multirotor that flies missions, for tests: limited tilt, quadratic drag, cascaded loops, gusts; not the twin's law.

Its reference is what ArduCopter's resembles: per leg a trapezoid of speed averaged over the jerk time, the next leg
begun before the last has ended as far as the corner radius allows. Drag grows with the square of the airspeed, tilt
follows a limited second-order loop, velocity is held by a PI, and thrust lags.
"""

from dataclasses import dataclass, field
from math import atan2, cos, hypot, sin

import numpy as np

from fleet.contract import Item, Message, Mission, Params, Sample, Status
from fleet.frames import G, to_geodetic
from tests.support.flights import HERE, T0, item, rows

DT = 0.02
_LAND_FROM = 10.0


@dataclass
class Leg:
    """One straight piece of the reference: where, how fast, how long it waits at its end."""

    a: np.ndarray
    b: np.ndarray
    seq: int
    speed: float
    acc: float
    wait: float = 0.0
    stop: bool = False
    way: np.ndarray = field(default_factory=lambda: np.zeros(0))  # displacement each DT [m]

    @property
    def length(self) -> float:
        return float(np.linalg.norm(self.b - self.a))


def displacement(length: float, speed: float, acc: float, jerk: float) -> np.ndarray:
    """Displacement each DT of a trapezoid of speed, averaged over the time the jerk needs."""
    top = min(speed, (length * acc) ** 0.5)
    ramp, flat = top / acc, length / top - top / acc
    t = np.arange(0.0, 2 * ramp + flat + DT, DT)
    v = np.clip(np.minimum(t / ramp, (2 * ramp + flat - t) / ramp), 0.0, 1.0) * top
    box = max(int(acc / jerk / DT), 1)
    v = np.convolve(v, np.ones(box) / box)
    s = np.concatenate([[0.0], np.cumsum(v) * DT])
    return s * length / s[-1]


def reference(legs: list[Leg], jerk: float, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Reference position each DT (n, 3), and the item in force (n,)."""
    for leg in legs:
        leg.way = displacement(max(leg.length, 1e-3), leg.speed, leg.acc, jerk)
    begin, at = [], 0
    for k, leg in enumerate(legs):
        begin.append(at)
        at += len(leg.way)
        if leg.wait or leg.stop or k + 1 == len(legs):
            at += int(leg.wait / DT)
            continue
        at -= overlap(leg, legs[k + 1], radius)
    n = at + int(20.0 / DT)
    out, seq = np.tile(legs[0].a, (n, 1)), np.full(n, legs[0].seq)
    for k, leg in enumerate(legs):
        t = (leg.b - leg.a) / max(leg.length, 1e-9)
        whole = np.concatenate([leg.way, np.full(n, leg.way[-1])])[: n - begin[k]]
        out[begin[k] :] += whole[:, None] * t
        seq[begin[k] :] = leg.seq
    return out, seq


def overlap(one: Leg, two: Leg, radius: float) -> int:
    """Steps by which `two` may begin before `one` has ended so that the corner is missed by at most `radius`."""
    turn = (one.b - one.a) / max(one.length, 1e-9), (two.b - two.a) / max(two.length, 1e-9)
    best = 0
    for steps in range(0, min(len(one.way), len(two.way)) // 2, 5):
        left = one.way[-1] - one.way[len(one.way) - steps :] if steps else np.zeros(1)
        made = two.way[: len(left)]
        miss = np.linalg.norm(-left[:, None] * turn[0] + made[:, None] * turn[1], axis=1).min()
        if miss <= radius:
            best = steps
    return best


@dataclass(frozen=True)
class Flight:
    """A flown mission: true track each DT, and what the gateway would say of it."""

    t: np.ndarray
    p: np.ndarray
    messages: list[Message]
    items: tuple[Item, ...]


def mission(
    rng: np.random.Generator, speed: float
) -> tuple[tuple[Item, ...], list[tuple[int, np.ndarray, float, float]]]:
    """A random mission, and (item, point, wait, speed) of it."""
    height = float(rng.uniform(20, 40))
    items, points = [item(0), item(1, 22, alt_m=height)], [(1, np.array([0.0, 0.0, -height]), 0.0, 0.0)]
    at, course = np.zeros(2), rng.uniform(-np.pi, np.pi)
    for _ in range(int(rng.integers(4, 8))):
        if rng.random() < 0.25:
            speed = float(rng.uniform(3, 11))
            items.append(item(len(items), 178, param1=1.0, param2=speed))
        course += rng.choice([-1, 1]) * rng.uniform(0.2, 2.4)
        at = at + rng.uniform(60, 250) * np.array([cos(course), sin(course)])
        height = float(np.clip(height + rng.choice([0, 0, 1]) * rng.uniform(-15, 15), 15, 60))
        wait = float(rng.choice([0, 0, 0, rng.uniform(3, 10)]))
        command, wait = (19, wait + 3.0) if rng.random() < 0.15 else (16, wait)
        items.append(item(len(items), command, *at, param1=wait, alt_m=height))
        points.append((len(items) - 1, np.array([*at, -height]), wait, speed))
    items.append(item(len(items), 20))
    return tuple(items), points


def legs_of(items: tuple[Item, ...], points: list, p: dict[str, float]) -> list[Leg]:
    """Straight pieces for take-off, waypoints, return and landing."""
    up, down, cruise, acc = (p[f"WPNAV_{name}"] * 0.01 for name in ("SPEED_UP", "SPEED_DN", "SPEED", "ACCEL"))
    legs, at = [Leg(np.zeros(3), points[0][1], 1, up, 1.0, stop=True)], points[0][1]

    def straight(b: np.ndarray, seq: int, speed: float, **more) -> None:
        nonlocal at
        if np.linalg.norm(b - at) > 0.5:
            t = np.abs(b - at) / np.linalg.norm(b - at)
            vertical = (up if b[2] < at[2] else down) / max(t[2], 1e-6)
            top, push = (
                min(speed / max(hypot(*t[:2]), 1e-6), vertical),
                min(acc / max(hypot(*t[:2]), 1e-6), 1 / max(t[2], 1e-6)),
            )
            legs.append(Leg(at, b, seq, top, push, **more))
            at = b

    for seq, b, wait, speed in points[1:]:
        straight(b, seq, speed or cruise, wait=wait, stop=wait > 0)
    seq, top = items[-1].seq, min(at[2], -p["RTL_ALT"] * 0.01)
    legs[-1].stop = True
    straight(np.array([*at[:2], top]), seq, cruise, stop=True)
    straight(np.array([0.0, 0.0, top]), seq, cruise, stop=True)
    straight(np.array([0.0, 0.0, -_LAND_FROM]), seq, cruise)
    straight(np.zeros(3), seq, p["LAND_SPEED"] * 0.01, stop=True)
    legs[-1].speed = p["LAND_SPEED"] * 0.01
    return legs


def fly(seed: int, *, wind: float | None = None, attitude: bool = True, params: bool = True) -> Flight:
    """Fly a random mission in random wind with random tuning."""
    rng = np.random.default_rng(seed)
    speed = float(rng.uniform(4, 11))
    p = {
        "WPNAV_SPEED": 100 * speed,
        "WPNAV_SPEED_UP": 250.0,
        "WPNAV_SPEED_DN": 150.0,
        "WPNAV_ACCEL": float(rng.uniform(150, 350)),
        "WPNAV_JERK": float(rng.uniform(1, 3)),
        "WPNAV_RADIUS": 200.0,
        "LAND_SPEED": 50.0,
        "RTL_ALT": float(rng.uniform(1500, 3000)),
        "ANGLE_MAX": 3000.0,
    }
    items, points = mission(rng, 0.0)
    ref, seq = reference(legs_of(items, points, p), p["WPNAV_JERK"], p["WPNAV_RADIUS"] * 0.01)
    blow = float(rng.uniform(0, 8)) if wind is None else wind
    t, track, euler = _flown(rng, ref, blow, p)
    heard = _messages(rng, (t, track, euler, seq), (items, p if params else {}), attitude)
    return Flight(t, track[:, :3], heard, items)


def _flown(rng: np.random.Generator, ref: np.ndarray, blow: float, p: dict[str, float]) -> tuple[np.ndarray, ...]:
    """Integrate the vehicle behind the reference: (t, p v (n, 6), phi theta psi (n, 3))."""
    n = len(ref)
    rate = np.gradient(ref, DT, axis=0)
    course = rng.uniform(-np.pi, np.pi)
    mean = blow * np.array([cos(course), sin(course), 0.0])
    gust, white = np.zeros(3), rng.standard_normal((n, 3)) * 0.15 * blow * (2 * DT / 4.0) ** 0.5
    drag, kp, kv, ki = rng.uniform(0.008, 0.02), rng.uniform(0.8, 1.2), rng.uniform(1.5, 2.5), 0.6
    x, v, a, a_dot = ref[0].copy(), np.zeros(3), np.zeros(3), np.zeros(3)
    total, most, wn = np.zeros(3), G * np.tan(np.radians(p["ANGLE_MAX"] * 0.01)), rng.uniform(5, 9)
    out, euler = np.empty((n, 6)), np.empty((n, 3))
    for k in range(n):
        gust += -gust * DT / 4.0 + white[k]
        wanted = rate[k] + kp * (ref[k] - x)
        miss = wanted - v
        a_c = kv * miss + total
        level = hypot(a_c[0], a_c[1])
        if level > most:
            a_c[:2] *= most / level
        else:
            total = np.clip(total + ki * miss * DT, -4.0, 4.0)
        a_dot += DT * (wn * wn * (a_c - a) - 2 * 0.8 * wn * a_dot)
        a = a + DT * a_dot
        air = v - mean - gust
        v = v + DT * (a - drag * np.linalg.norm(air) * air)
        x = x + DT * v
        if x[2] > 0.0:
            x[2], v[2] = 0.0, 0.0
        out[k, :3], out[k, 3:] = x, v
        psi = atan2(rate[k, 1], rate[k, 0])
        fwd, right = a[0] * cos(psi) + a[1] * sin(psi), -a[0] * sin(psi) + a[1] * cos(psi)
        euler[k] = atan2(right, G), -atan2(fwd, G), psi
    return T0 + DT * np.arange(n), out, euler


def _messages(rng: np.random.Generator, flown: tuple, onboard: tuple, attitude: bool) -> list[Message]:
    t, track, euler, seq = flown
    items, params = onboard
    n, every = len(t), int(0.2 / DT)
    drift = np.cumsum(rng.standard_normal((n // every + 1, 3)), axis=0) * 0.05 * [1, 1, 1.5]
    drift -= np.linspace(0, 1, len(drift))[:, None] * drift[-1]
    out: list[Message] = [
        Status(uav=7, t=T0, mode="AUTO", armed=True, autopilot="ardupilot", vehicle="multirotor"),
        Mission(uav=7, t=T0, items=items, seq=1, complete=True),
        Params(uav=7, t=T0, values=params, complete=True),
    ]
    for j, k in enumerate(range(0, n, every)):
        where = track[k, :3] + np.clip(drift[j], -1.5, 1.5) + rng.standard_normal(3) * 0.03
        kinds = {
            "position": rows([t[k]], to_geodetic(HERE, where[None])),
            "velocity": rows([t[k]], (track[k, 3:] + rng.standard_normal(3) * 0.08)[None]),
        }
        if attitude:
            turned = np.concatenate([euler[k] + rng.standard_normal(3) * 0.005, np.zeros(3)])
            kinds["attitude"] = rows([t[k]], turned[None])
        if j % 5 == 0:
            kinds["leg"] = rows([t[k]], [[float(seq[k])]])
            out.append(
                Status(uav=7, t=float(t[k]), mode="AUTO", armed=True, autopilot="ardupilot", vehicle="multirotor")
            )
        out.append(Sample(uav=7, t=float(t[k]), **kinds))
    return out
