"""A chain of pretend aircraft: each meets the one before it or passes it clear, sinks or does not, leaves or stays.

Each flight is drawn and flown once to learn its path; then it is moved, home and all, so that it meets the aircraft
before it at an instant drawn between 115 and 150 s, and is flown anew where it is.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import msgspec
import numpy as np

from fleet.contract import Item
from fleet.frames import Origin, to_geodetic, to_ned
from fleet.mission import SEQ
from fleet.simulator.flight.uav import SimulatedUav
from fleet.simulator.vehicle.missions import HOME, StartState, draw_mission
from fleet.simulator.vehicle.types import CRUISE

END_S = 152.0  # the twins hear so much of each flight [s]
LOOK_S = 120.0  # what is never to happen does not happen for so long after it either [s]
STEP_S = 0.5
MEET_S = (115.0, 150.0)
WIDE_M, HIGH_M = 50.0, 20.0  # separation
CLEAR_M, ABOVE_M = 150.0, 60.0  # well separated: never nearer than both
SAFE_M = 30.0  # least height above home
CRUISE_M, SLOPING_M, LOW_M = 70.0, 45.0, 18.0  # heights of waypoints of flights that sink [m]
STAYS_M = (50.0, 64.0)  # the lowest waypoint of those that do not [m]
OUT_M, OUT_S = 30.0, 15.0  # a flight that leaves its fence goes so far beyond it, so soon
HOME_M = (300.0, 1500.0)  # how far home is moved away from the mission's middle
_TRIES = 400


class Plan(NamedTuple):
    """What one aircraft flies: items, where it starts on them, home."""

    items: tuple[Item, ...]
    start: StartState
    origin: Origin


class Told(NamedTuple):
    """What is arranged for one aircraft."""

    uav: int
    seed: int
    meets: bool | None  # the aircraft before it: meets it, passes it clear; None for the first
    sinks: bool
    may_leave: bool


@dataclass
class Flight:
    """One aircraft's flight, as it is.

    Attributes:
        told, plan, radius: what is arranged, what it flies, geofence about home [m]
        path: NED from HOME every STEP_S, (n, 3) [m]
        seq: mission item in force, (n,)
    """

    told: Told
    plan: Plan
    radius: float
    path: np.ndarray
    seq: np.ndarray

    @property
    def home(self) -> np.ndarray:
        """Give home, NED from HOME, (3,) [m]."""
        return to_ned(HOME, *(np.array([x]) for x in self.plan.origin))[0]

    def height(self) -> np.ndarray:
        """Give the height above its home, (n,) [m]."""
        return self.home[2] - self.path[:, 2]

    def away(self, home: np.ndarray | None = None) -> np.ndarray:
        """Give the distance from home (or from another place) over ground, (n,) [m]."""
        return np.hypot(*(self.path - (self.home if home is None else home))[:, :2].T)

    def leaves(self) -> bool:
        """Tell whether it ever leaves its geofence."""
        return bool((self.away() > self.radius).any())


def make(told: Told, plan: Plan, radius: float = 0.0) -> SimulatedUav:
    """Put one aircraft in the air."""
    fenced = {"FENCE_ENABLE": 1.0, "FENCE_TYPE": 2.0, "FENCE_RADIUS": radius} if radius else {}
    return SimulatedUav(told.uav, told.seed, origin=plan.origin, plan=(plan.items, plan.start), extra_params=fenced)


def fly(told: Told, plan: Plan, seconds: float) -> Flight:
    """Fly it alone; give what physics says of it."""
    uav, rows, seq = make(told, plan), [], []
    uav.silent = True
    for t in np.arange(0.0, seconds, STEP_S):
        uav.step(float(t))
        rows.append(uav.aircraft.truth().p)
        seq.append(int(uav.leg[SEQ]))
    path = to_ned(HOME, *to_geodetic(plan.origin, np.array(rows)).T)
    return Flight(told, plan, 0.0, path, np.array(seq))


def moved(plan: Plan, by: np.ndarray) -> Plan:
    """Move a plan with its home, NED (3,) [m]."""
    origin = Origin(*map(int, to_geodetic(plan.origin, by)))
    return Plan(_shifted(plan, plan.origin, origin), plan.start, origin)


def homed(plan: Plan, by: np.ndarray) -> Plan:
    """Move home alone, NED (3,) [m] with nothing down: the mission stays where it is."""
    origin = Origin(*map(int, to_geodetic(plan.origin, by)))
    return Plan(_shifted(plan, origin, origin), plan.start._replace(p=plan.start.p - by), origin)


def _shifted(plan: Plan, before: Origin, after: Origin) -> tuple[Item, ...]:
    """Write the items about another home, at the same places from `after` as they were from `before`."""
    home = {"lat_e7": after.lat_e7, "lon_e7": after.lon_e7, "alt_m": after.alt_mm * 1e-3}
    out = [msgspec.structs.replace(plan.items[0], **home)]
    for item in plan.items[1:]:
        if item.lat_e7 or item.lon_e7:
            ned = to_ned(before, np.array([item.lat_e7]), np.array([item.lon_e7]), np.array([before.alt_mm]))[0]
            lat, lon, _ = to_geodetic(after, ned)
            item = msgspec.structs.replace(item, lat_e7=int(lat), lon_e7=int(lon))
        out.append(item)
    return tuple(out)


def reshaped(drawn: Flight, sink_at: float | None, lowest: float) -> Plan:
    """Give its mission other heights: one low waypoint at `sink_at` [s], or none below `lowest` [m]."""
    items = drawn.plan.items
    placed = [item.seq for item in items[1:] if item.lat_e7]
    if sink_at is None:
        down = min(item.alt_m for item in items if item.seq in placed) - lowest
        heights = {item.seq: item.alt_m - down for item in items}
        start = -drawn.plan.start.p[2] - down
    else:
        now = int(drawn.seq[int(sink_at / STEP_S)])
        k = placed.index(min(placed, key=lambda seq: abs(seq - now)))
        around = {placed[k]: LOW_M, placed[k - 1]: SLOPING_M, placed[(k + 1) % len(placed)]: SLOPING_M}
        heights = {seq: around.get(seq, CRUISE_M) for seq in placed}
        start = CRUISE_M
    out = (msgspec.structs.replace(i, alt_m=round(heights[i.seq], 2)) if i.seq in placed else i for i in items)
    at = drawn.plan.start
    return drawn.plan._replace(items=tuple(out), start=at._replace(p=np.array([*at.p[:2], -start])))


def apart(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give the distances over ground and in height of two paths, (n,) each [m]."""
    n = min(len(a), len(b))
    d = a[:n] - b[:n]
    return np.hypot(d[:, 0], d[:, 1]), np.abs(d[:, 2])


def lost_at(a: np.ndarray, b: np.ndarray) -> float | None:
    """Give when two paths first lose separation [s]; None never."""
    wide, high = apart(a, b)
    k = np.flatnonzero((wide < WIDE_M) & (high < HIGH_M))
    return float(k[0] * STEP_S) if len(k) else None


def is_clear(a: np.ndarray, b: np.ndarray, more: float = 0.0) -> bool:
    """Tell whether two paths are well separated throughout, by so much more [m]."""
    wide, high = apart(a, b)
    return bool(((wide >= CLEAR_M + more) | (high >= ABOVE_M + 0.4 * more)).all())


def shift(rng: np.random.Generator, before: np.ndarray, path: np.ndarray, meets: bool) -> tuple[np.ndarray, int]:
    """Draw where a path is at one instant so that it meets the one before, or passes it clear: NED (3,) [m], when."""
    for _ in range(_TRIES):
        k = int(rng.uniform(*MEET_S) / STEP_S)
        angle = rng.uniform(-np.pi, np.pi)
        aside, above = rng.uniform(0, 20), rng.uniform(-6, 6)
        if not meets:
            high = bool(rng.integers(2))
            aside = rng.uniform(0, 60) if high else rng.uniform(165, 230)
            above = rng.choice([-1, 1]) * rng.uniform(66, 90) if high else rng.uniform(-8, 8)
        at = before[k] + [aside * np.cos(angle), aside * np.sin(angle), above]
        there = path + at - path[k]
        first = lost_at(before, there)
        if (first is not None and first >= MEET_S[0] - 10) if meets else is_clear(before, there, 15.0):
            return at, k
    raise RuntimeError("found no place for a flight; take another seed")


def chain(count: int, seed: int, say: Callable[[str], None] = print) -> list[Flight]:
    """Arrange `count` flights, each with the one before it: odd ones meet it, even ones pass clear."""
    rng = np.random.default_rng((seed, 77))
    flights: list[Flight] = []
    for uav in range(count):
        may_leave = sum(one.leaves() for one in flights) < count // 2
        told = Told(uav, seed, None if uav == 0 else uav % 2 == 1, uav % 4 in (1, 2), may_leave)
        flights.append(arrange(told, rng, flights[-1].path if flights else None))
        say(f"arranged {uav + 1} of {count}")
    return flights


def arrange(told: Told, rng: np.random.Generator, before: np.ndarray | None) -> Flight:
    own = int(np.random.SeedSequence((told.seed, told.uav)).generate_state(1)[0])
    drawn = fly(told, Plan(*draw_mission(own, CRUISE, HOME), HOME), MEET_S[1] + 5)
    one = _heights(told, drawn, rng)
    plan = one.plan
    if told.may_leave:
        plan = homed(plan, _home(one, rng))
    if before is not None:
        assert told.meets is not None
        at, k = shift(rng, before, one.path, told.meets)
        now = one.path[k]
        for seconds in (k * STEP_S + 1, END_S + LOOK_S):  # air is thinner higher up: the moved flight differs a little
            plan = moved(plan, at - now)
            one = fly(told, plan, seconds)
            now = one.path[k]
    else:
        one = fly(told, plan, END_S + LOOK_S)
    one.radius = _fence(one, rng)
    return one


def _heights(told: Told, drawn: Flight, rng: np.random.Generator) -> Flight:
    """Give a flight that first sinks between 115 and 150 s, or that never does."""
    for _ in range(6):
        sink_at = rng.uniform(*MEET_S) + 8.0 if told.sinks else None
        plan = reshaped(drawn, sink_at and min(sink_at, MEET_S[1]), rng.uniform(*STAYS_M))
        one = fly(told, plan, END_S + LOOK_S)
        low = np.flatnonzero(one.height() < SAFE_M)
        if not told.sinks or (len(low) and MEET_S[0] <= low[0] * STEP_S <= MEET_S[1]):
            break
    return one


def _home(one: Flight, rng: np.random.Generator) -> np.ndarray:
    """Draw a home that the flight goes away from between 115 and 150 s, farther than ever before, NED (3,) [m]."""
    for _ in range(_TRIES):
        angle, far = rng.uniform(-np.pi, np.pi), rng.uniform(*HOME_M)
        by = np.array([far * np.cos(angle), far * np.sin(angle), 0.0])
        if len(_goes(one.away(one.home + by))):
            return by
    return np.zeros(3)


def _goes(away: np.ndarray) -> np.ndarray:
    """Give the rows between 115 and 150 s from which a flight goes farther away than ever before, by 30 m in 15 s."""
    meet = range(int(MEET_S[0] / STEP_S), int(MEET_S[1] / STEP_S))
    soon = int(OUT_S / STEP_S)
    return np.array([i for i in meet if away[i] > away[:i].max() and away[i : i + soon].max() > away[i] + OUT_M])


def _fence(one: Flight, rng: np.random.Generator) -> float:
    """Draw a fence that it leaves for the first time between 115 and 150 s, or one it stays within by 40 to 80 m."""
    away, goes = one.away(), _goes(one.away())
    if one.told.may_leave and len(goes):
        return float(away[rng.choice(goes)])
    return float(np.ceil(away.max() + rng.uniform(40, 80)))
