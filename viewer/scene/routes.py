"""Mission as lines: navigation items in order, loiters as circles; other or invalid items are skipped."""

from typing import NamedTuple

import numpy as np

from fleet.contract import Item, Mission
from viewer.store.event_detection import (
    DO_JUMP,
    LAND,
    LOITER_TIME,
    LOITER_TO_ALT,
    LOITER_TURNS,
    LOITER_UNLIM,
    RTL,
    SPLINE,
    TAKEOFF,
    VTOL_LAND,
    VTOL_TAKEOFF,
    WAYPOINT,
)
from viewer.store.place import UNIT_M, SceneFrame

POSITIONED = {
    WAYPOINT,
    LOITER_UNLIM,
    LOITER_TURNS,
    LOITER_TIME,
    LAND,
    TAKEOFF,
    LOITER_TO_ALT,
    SPLINE,
    VTOL_TAKEOFF,
    VTOL_LAND,
}
RADIUS_FIELD = {LOITER_UNLIM: "param3", LOITER_TURNS: "param3", LOITER_TIME: "", LOITER_TO_ALT: "param2"}
ABSOLUTE = {0, 5}  # MAV_FRAME: GLOBAL, GLOBAL_INT; every other altitude counts from home
RADIUS_M = 60.0  # default loiter radius: WP_LOITER_RAD of ArduPlane [m]
MAX_M = 50_000.0  # larger altitudes and radii are not drawn [m]


class RouteLines(NamedTuple):
    """Lines of a mission, scene ENU [10 m]."""

    legs: np.ndarray  # straight legs, (n, 2, 3)
    returns: np.ndarray  # jumps and returns, drawn dashed, (m, 2, 3)
    circles: np.ndarray  # loiter circles as segments, (k, 2, 3)
    points: np.ndarray  # positions of the items, (p, 3)
    items: np.ndarray  # their numbers, (p,)
    ends: np.ndarray  # number of the item at the end of each leg, (n,)


_NO_LINES, _NO_ITEMS = np.zeros((0, 2, 3)), np.zeros(0, int)
NOTHING = RouteLines(_NO_LINES, _NO_LINES, _NO_LINES, np.zeros((0, 3)), _NO_ITEMS, _NO_ITEMS)


def home_alt_m(mission: Mission | None) -> float | None:
    """Return the home altitude [m above mean sea level]: item 0 of an ArduPilot mission; None without home."""
    if mission is None or len(mission.items) < 2:
        return None
    first, rest = mission.items[0], mission.items[1:]
    is_home = first.seq == 0 and first.command == WAYPOINT and first.frame in ABSOLUTE and _usable(first)
    return float(first.alt_m) if is_home and any(item.frame not in ABSOLUTE for item in rest) else None


def mission_lines(mission: Mission | None, scene_frame: SceneFrame, ground: float) -> RouteLines:
    """Convert a mission to lines.

    Args:
        mission: as received, untrusted
        scene_frame: frame of the scene
        ground: height of the ground, used without home, scene [10 m]
    """
    if mission is None:
        return NOTHING
    home = home_alt_m(mission)
    base = (home - scene_frame.origin.alt_mm * 1e-3) / UNIT_M if home is not None else ground
    positions: dict[int, np.ndarray] = {}
    legs: list[np.ndarray] = []
    returns: list[np.ndarray] = []
    circles: list[np.ndarray] = []
    ends: list[int] = []
    last = None
    for index, item in enumerate(mission.items):
        if home is not None and index == 0:
            positions[item.seq] = (
                _item_position(item, scene_frame, base, None)[:1].reshape(-1) if _usable(item) else np.zeros(0)
            )
            continue
        if item.command == DO_JUMP:
            returns += _jump(item, positions, last)
        if item.command == RTL and last is not None and (first := positions.get(0)) is not None and first.size:
            returns.append(np.stack([last, first]))
        if item.command not in POSITIONED or not _usable(item):
            continue
        located = _item_position(item, scene_frame, base, last)
        if not len(located):
            continue
        position = positions[item.seq] = located[0]
        if last is not None and np.linalg.norm(position - last) > 1e-6:
            legs.append(np.stack([last, position]))
            ends.append(item.seq)
        if item.command in RADIUS_FIELD:
            circles.append(circle(position, _radius_m(item) / UNIT_M))
        last = position
    points = [position for position in positions.values() if position.size]
    items = [seq for seq, position in positions.items() if position.size]
    return RouteLines(
        np.array(legs).reshape(-1, 2, 3),
        np.array(returns).reshape(-1, 2, 3),
        np.concatenate(circles) if circles else NOTHING.circles,
        np.array(points).reshape(-1, 3),
        np.clip(np.array(items, dtype=object), -1, 10**6).astype(int),
        np.clip(np.array(ends, dtype=object), -1, 10**6).astype(int),
    )


def circle(centre: np.ndarray, radius: float, sides: int = 48) -> np.ndarray:
    """Return a horizontal circle as segments: (sides, 2, 3)."""
    turn = np.linspace(0, 2 * np.pi, sides + 1)
    ring = centre + radius * np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=-1)
    return np.stack([ring[:-1], ring[1:]], axis=1)


def _usable(item: Item) -> bool:
    return bool(np.isfinite(item.alt_m)) and abs(item.alt_m) < MAX_M


def _item_position(item: Item, scene_frame: SceneFrame, base: float, last: np.ndarray | None) -> np.ndarray:
    """Return the scene position of an item, (1, 3), or (0, 3) without one; 0, 0 is the previous position."""
    up = (
        (item.alt_m - scene_frame.origin.alt_mm * 1e-3) / UNIT_M
        if item.frame in ABSOLUTE
        else base + item.alt_m / UNIT_M
    )
    if item.lat_e7 == 0 and item.lon_e7 == 0:
        return np.zeros((0, 3)) if last is None else np.array([[last[0], last[1], up]])
    try:
        position = scene_frame.from_geodetic(
            np.array([item.lat_e7]), np.array([item.lon_e7]), np.array([scene_frame.origin.alt_mm])
        )
    except (ValueError, OverflowError):
        return np.zeros((0, 3))
    position[0, 2] = up
    return position


def _radius_m(item: Item) -> float:
    radius = abs(getattr(item, RADIUS_FIELD[item.command])) if RADIUS_FIELD[item.command] else 0.0
    return radius if np.isfinite(radius) and 0 < radius < MAX_M else RADIUS_M


def _jump(item: Item, positions: dict[int, np.ndarray], last: np.ndarray | None) -> list[np.ndarray]:
    target = positions.get(int(item.param1)) if np.isfinite(item.param1) else None
    return [np.stack([last, target])] if last is not None and target is not None and target.size else []
