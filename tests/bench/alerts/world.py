"""A chain of pretend aircraft: each meets the one before it or passes it clear, sinks or does not, leaves or stays.

Each flight is drawn and flown once to learn its path; then its home is moved so that it meets the aircraft before it,
at an instant drawn between 115 and 150 s. Moving a home moves the flight, which is then flown anew where it is.
"""

from dataclasses import dataclass
from typing import NamedTuple

import msgspec
import numpy as np

from fleet.contract import Item
from fleet.frames import Origin, to_geodetic, to_ned
from fleet.pretend.missions import HOME
from fleet.pretend.uav import PretendUav

END_S = 152.0  # the twins hear so much of each flight [s]
LOOK_S = 120.0  # what is never to happen does not happen for so long after it either [s]
STEP_S = 0.5
MEET_S = (115.0, 150.0)
WIDE_M, HIGH_M = 50.0, 20.0  # separation
CLEAR_M, ABOVE_M = 150.0, 60.0  # well separated: never nearer than both
SAFE_M = 30.0  # least height above home
CRUISE_M, SLOPING_M, LOW_M = 70.0, 45.0, 18.0  # heights of waypoints of flights that sink [m]
STAYS_M = (50.0, 64.0)  # the lowest waypoint of those that do not [m]
_TRIES = 400


class Told(NamedTuple):
    """What is arranged for one aircraft."""

    uav: int
    meets: bool | None  # the aircraft before it: meets it, passes it clear; None for the first
    sinks: bool


@dataclass
class Flight:
    """One aircraft's flight, as it is.

    Attributes:
        told: what is arranged
        items, origin, radius: mission, home, geofence about home [m]
        t: since the start, (n,) [s]
        path: NED from HOME, (n, 3) [m]
        seq: mission item in force, (n,)
    """

    told: Told
    items: tuple[Item, ...]
    origin: Origin
    radius: float
    t: np.ndarray
    path: np.ndarray
    seq: np.ndarray

    @property
    def home(self) -> np.ndarray:
        """Give home, NED from HOME, (3,) [m]."""
        return to_ned(HOME, *(np.array([x]) for x in self.origin))[0]

    def height(self) -> np.ndarray:
        """Give the height above its home, (n,) [m]."""
        return self.home[2] - self.path[:, 2]

    def away(self) -> np.ndarray:
        """Give the distance from its home over ground, (n,) [m]."""
        return np.hypot(*(self.path - self.home)[:, :2].T)

    def leaves(self) -> bool:
        """Tell whether it ever leaves its geofence."""
        return bool(self.radius) and bool((self.away() > self.radius).any())


def make(told: Told, seed: int, items: tuple[Item, ...], origin: Origin, radius: float = 0.0) -> PretendUav:
    """Put one aircraft in the air."""
    fenced = {"FENCE_ENABLE": 1.0, "FENCE_TYPE": 2.0, "FENCE_RADIUS": radius} if radius else {}
    return PretendUav(told.uav, seed, origin=origin, items=items, more=fenced)


def fly(told: Told, seed: int, items: tuple[Item, ...], origin: Origin, seconds: float) -> Flight:
    """Fly it alone; give what physics says of it."""
    uav = make(told, seed, items, origin)
    rows, seq = [], []
    for t in np.arange(0.0, seconds, STEP_S):
        uav.step(float(t))
        rows.append(uav.aircraft.truth().p)
        seq.append(uav.leg[8])
    place = to_geodetic(origin, np.array(rows))
    path = to_ned(HOME, *place.T)
    return Flight(told, uav.items, origin, 0.0, np.arange(0.0, seconds, STEP_S), path, np.array(seq))


def moved(items: tuple[Item, ...], origin: Origin, to: Origin) -> tuple[Item, ...]:
    """Move a mission with its home."""
    out = [items[0].__class__(seq=0, command=16, frame=0, lat_e7=to.lat_e7, lon_e7=to.lon_e7, alt_m=to.alt_mm * 1e-3)]
    for item in items[1:]:
        if item.lat_e7 or item.lon_e7:
            ned = to_ned(origin, np.array([item.lat_e7]), np.array([item.lon_e7]), np.array([origin.alt_mm]))[0]
            lat, lon, _ = to_geodetic(to, ned)
            item = msgspec.structs.replace(item, lat_e7=int(lat), lon_e7=int(lon))
        out.append(item)
    return tuple(out)


def reshaped(drawn: Flight, sink_at: float | None, lowest: float) -> tuple[Item, ...]:
    """Give its mission other heights: one low waypoint at `sink_at` [s], or none below `lowest` [m]."""
    placed = [item.seq for item in drawn.items[1:] if item.lat_e7]
    if sink_at is None:
        down = min(item.alt_m for item in drawn.items if item.seq in placed) - lowest
        heights = {item.seq: item.alt_m - down for item in drawn.items}
    else:
        now = int(drawn.seq[int(sink_at / STEP_S)])
        k = placed.index(min(placed, key=lambda seq: abs(seq - now)))
        around = {placed[k]: LOW_M, placed[k - 1]: SLOPING_M, placed[(k + 1) % len(placed)]: SLOPING_M}
        heights = {seq: around.get(seq, CRUISE_M) for seq in placed}
    return tuple(
        msgspec.structs.replace(item, alt_m=round(heights[item.seq], 2)) if item.seq in placed else item
        for item in drawn.items
    )


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


def is_clear(a: np.ndarray, b: np.ndarray) -> bool:
    """Tell whether two paths are well separated throughout."""
    wide, high = apart(a, b)
    return bool(((wide >= CLEAR_M) | (high >= ABOVE_M)).all())


def shift(rng: np.random.Generator, before: np.ndarray, path: np.ndarray, meets: bool) -> tuple[np.ndarray, float]:
    """Draw how far to move a path so that it meets the one before, or passes it just clear: NED (3,) [m], when [s]."""
    for _ in range(_TRIES):
        at = float(np.round(rng.uniform(*MEET_S) / STEP_S) * STEP_S)
        k = int(at / STEP_S)
        angle = rng.uniform(-np.pi, np.pi)
        aside, above = rng.uniform(0, 20), rng.uniform(-6, 6)
        if not meets:
            high = bool(rng.integers(2))
            aside = rng.uniform(0, 60) if high else rng.uniform(155, 230)
            above = rng.choice([-1, 1]) * rng.uniform(63, 90) if high else rng.uniform(-8, 8)
        move = before[k] + [aside * np.cos(angle), aside * np.sin(angle), above] - path[k]
        if meets:
            first = lost_at(before, path + move)
            if first is not None and first >= MEET_S[0] - 10:
                return move, at
        elif is_clear(before, path + move):
            return move, at
    raise RuntimeError("found no place for a flight; take another seed")


def chain(count: int, seed: int, say=print) -> list[Flight]:
    """Arrange `count` flights, each with the one before it: odd ones meet it, even ones pass clear."""
    rng = np.random.default_rng((seed, 77))
    flights: list[Flight] = []
    for uav in range(count):
        told = Told(uav, None if uav == 0 else uav % 2 == 1, uav % 4 in (1, 2))
        flights.append(_arrange(told, seed, rng, flights[-1].path if flights else None))
        may = sum(one.leaves() for one in flights) < count // 2
        flights[-1].radius = _fence(flights[-1], rng, may)
        say(f"arranged {uav + 1} of {count}")
    return flights


def _arrange(told: Told, seed: int, rng: np.random.Generator, before: np.ndarray | None) -> Flight:
    drawn = fly(told, seed, (), HOME, MEET_S[1] + 5)
    sink_at = rng.uniform(*MEET_S) if told.sinks else None
    items, origin = reshaped(drawn, sink_at, rng.uniform(*STAYS_M)), HOME
    one = fly(told, seed, items, origin, END_S + LOOK_S)
    if before is not None:
        assert told.meets is not None
        move, at = shift(rng, before, one.path, told.meets)
        wanted = one.path[int(at / STEP_S)] + move
        for _ in range(2):  # air is thinner higher up: the moved flight differs a little
            to = Origin(*map(int, to_geodetic(HOME, one.home + wanted - one.path[int(at / STEP_S)])))
            items, origin = moved(items, origin, to), to
            one = fly(told, seed, items, origin, END_S + LOOK_S)
    return one


def _fence(one: Flight, rng: np.random.Generator, may: bool) -> float:
    """Draw a fence that it leaves for the first time between 115 and 150 s, or one it stays within by 40 to 80 m."""
    away = one.away()
    meet = range(int(MEET_S[0] / STEP_S), int(MEET_S[1] / STEP_S))
    first = [i for i in meet if away[i] > away[:i].max() + 2.0]
    if may and first:
        return float(away[rng.choice(first)] - 1.0)
    return float(np.ceil(away.max() + rng.uniform(40, 80)))
