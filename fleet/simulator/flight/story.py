"""Missions of a fleet of which two aircraft meet at a known time, and all others stay far apart.

Both aircraft are flown once without telemetry. Then the second mission is moved, home and all, so that both are at the
same place at one instant of the window `MEET_S`: where their courses cross most nearly at a right angle.
"""

from typing import Any, NamedTuple

import msgspec
import numpy as np

from fleet.contract import Item
from fleet.frames import Origin, to_geodetic, to_ned, wrap
from fleet.simulator.flight.uav import SimulatedUav
from fleet.simulator.vehicle.missions import HOME, StartState, draw_mission
from fleet.simulator.vehicle.types import TYPES

MEET_S = (125.0, 145.0)  # both aircraft are at one place in this window, after the start [s]
HEIGHT_M = 120.0  # of both missions above home
STRAIGHT_S = 12.0  # flight before the meeting whose course changes are counted [s]
SEPARATION_M = 50.0  # smallest horizontal distance before the meeting [m]
RING_M = 3_500.0  # distance of the other homes from the first, and at least between any two of them
MAX_UAVS = 20
_STEP_S = 0.5
_MOVES = 2
_AIRCRAFT = "small"


class StoryPlan(NamedTuple):
    """Mission of one aircraft, its state at the start, and its home."""

    items: tuple[Item, ...]
    start: StartState
    origin: Origin


def conflict_plans(count: int, seed: int, autopilot: str = "ardupilot", **weather: Any) -> list[StoryPlan]:
    """Return the plans of a fleet whose aircraft 0 and 1 meet.

    Args:
        count: aircraft, 2 to `MAX_UAVS`
        seed: of missions, aircraft and weather, as of `SimulatedUav`
        autopilot: ardupilot or px4
        weather: wind, turbulence and wind_field as of `SimulatedUav`
    Raises:
        ValueError: when no instant of the window fits, or `count` is out of range.
    """
    if not 2 <= count <= MAX_UAVS:
        raise ValueError(f"--story conflict: found {count} aircraft, expected 2 to {MAX_UAVS}; change --uavs")
    plans = [_plan(uav, seed, autopilot) for uav in range(count)]
    paths = [_fly(_aircraft(uav, seed, plans[uav], autopilot, weather)) for uav in (0, 1)]
    k = _meeting(paths[0], paths[1], seed)
    second = paths[1]
    for _ in range(_MOVES):  # the wind of a field and the density of the air differ where it is moved to
        plans[1] = _moved(plans[1], (paths[0][k] - second[k]) * [1.0, 1.0, 0.0])
        path = _fly(_aircraft(1, seed, plans[1], autopilot, weather))
        second = to_ned(HOME, *to_geodetic(plans[1].origin, path).T)
    for uav in range(2, count):
        plans[uav] = _moved(plans[uav], _place(uav - 2))
    return plans


def story_aircraft(count: int, seed: int, autopilot: str, **weather: Any) -> list[SimulatedUav]:
    """Return the simulated aircraft of `conflict_plans`; arguments as there."""
    plans = conflict_plans(count, seed, autopilot, **weather)
    return [_aircraft(uav, seed, plan, autopilot, weather) for uav, plan in enumerate(plans)]


def _plan(uav: int, seed: int, autopilot: str) -> StoryPlan:
    own, kind = int(np.random.SeedSequence((seed, uav)).generate_state(1)[0]), TYPES[_AIRCRAFT]
    items, start = draw_mission(own, kind.cruise, HOME, kind.geometry, autopilot)
    if uav < 2:  # at one height, so that only the place matters
        items = tuple(msgspec.structs.replace(item, alt_m=HEIGHT_M) if _is_above_home(item) else item for item in items)
        start = start._replace(p=np.array([*start.p[:2], -HEIGHT_M]))
    return StoryPlan(items, start, HOME)


def _is_above_home(item: Item) -> bool:
    return item.frame == 3 and item.lat_e7 != 0


def _aircraft(uav: int, seed: int, plan: StoryPlan, autopilot: str, weather: dict[str, Any]) -> SimulatedUav:
    options = {"autopilot": autopilot, "aircraft": _AIRCRAFT, **weather}
    return SimulatedUav(uav, seed, origin=plan.origin, plan=plan[:2], **options)


def _fly(aircraft: SimulatedUav) -> np.ndarray:
    """Return the path of one aircraft up to the end of the window, NED from its home, (n, 3) [m]."""
    aircraft.silent, rows = True, []
    for t in np.arange(0.0, MEET_S[1] + _STEP_S, _STEP_S):
        aircraft.step(float(t))
        rows.append(aircraft.aircraft.truth().p.copy())
    return np.array(rows)


def _meeting(first: np.ndarray, second: np.ndarray, seed: int) -> int:
    """Return the row at which both aircraft are to be at one place; the second path is moved there."""
    courses = [np.arctan2(*np.gradient(path[:, :2], axis=0).T[::-1]) for path in (first, second)]
    steps, best = int(STRAIGHT_S / _STEP_S), (np.inf, 0)
    for k in range(int(MEET_S[0] / _STEP_S), int(MEET_S[1] / _STEP_S)):
        offset = (first[k] - second[k]) * [1.0, 1.0, 0.0]
        distance = np.hypot(*(first - second - offset)[: k - steps, :2].T)
        if distance.min() < 2.0 * SEPARATION_M:  # they meet before
            continue
        crossing = abs(wrap(courses[0][k] - courses[1][k]))
        turns = sum(np.ptp(np.unwrap(course[k - steps : k + 1])) for course in courses)
        best = min(best, (abs(crossing - 0.5 * np.pi) + turns, k), key=lambda one: one[0])
    if not np.isfinite(best[0]):
        raise ValueError(f"--story conflict: found no meeting of two aircraft with seed {seed}; take another --seed")
    return best[1]


def _place(k: int) -> np.ndarray:
    """Return the place of the home of one of the other aircraft, on rings about the first, NED, (3,) [m]."""
    ring, place = 1, k
    while place >= 6 * ring:
        ring, place = ring + 1, place - 6 * ring
    angle = 2.0 * np.pi * place / (6 * ring)
    return RING_M * ring * np.array([np.cos(angle), np.sin(angle), 0.0])


def _moved(plan: StoryPlan, by: np.ndarray) -> StoryPlan:
    """Return a plan moved with its home, NED, (3,) [m]."""
    lat, lon, alt = to_geodetic(plan.origin, by)
    origin, items = Origin(int(lat), int(lon), int(alt)), []
    for item in plan.items:
        if item.lat_e7:
            at = to_ned(plan.origin, np.array([item.lat_e7]), np.array([item.lon_e7]), np.array([plan.origin.alt_mm]))
            lat, lon, _ = to_geodetic(origin, at[0])
            item = msgspec.structs.replace(item, lat_e7=int(lat), lon_e7=int(lon))
        items.append(item)
    return StoryPlan(tuple(items), plan.start, origin)
