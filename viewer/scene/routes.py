"""Mission as lines: navigation items in order, loiters as circles; other or invalid items are skipped.

Outlines of geofence areas lie on the ground.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fleet.contract import Item, Mission
from fleet.terrain.areas import Area
from viewer.scene.strokes import chain, circle
from viewer.store import event_detection as mav
from viewer.store.place import UNIT_M, SceneFrame

POSITIONED = mav.ITEM_NAMES.keys() - {mav.RTL, mav.DO_JUMP}
RADIUS_FIELD = {mav.LOITER_UNLIM: "param3", mav.LOITER_TURNS: "param3", mav.LOITER_TO_ALT: "param2"}
LOITERS = {*RADIUS_FIELD, mav.LOITER_TIME}
ABSOLUTE = {0, 5}  # MAV_FRAME: GLOBAL, GLOBAL_INT; every other altitude counts from home
RADIUS_M = 60.0  # default loiter radius: WP_LOITER_RAD of ArduPlane [m]
MAX_M = 50_000.0  # larger altitudes and radii are not drawn [m]
Heights = Callable[[np.ndarray], np.ndarray]
EDGE_PARTS = 12  # of each edge of an area: it follows the terrain


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
    is_home = first.seq == 0 and first.command == mav.WAYPOINT and first.frame in ABSOLUTE and _usable(first)
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
        is_home = home is not None and index == 0
        target = positions.get(seq) if (seq := _return_seq(item)) is not None else None
        if last is not None and target is not None:
            returns.append(np.stack([last, target]))
        if not is_home and item.command not in POSITIONED:
            continue
        if (position := _item_position(item, scene_frame, base, last)) is None:
            continue
        positions[item.seq] = position
        if is_home:
            continue
        if last is not None and np.linalg.norm(position - last) > 1e-6:
            legs.append(np.stack([last, position]))
            ends.append(item.seq)
        if item.command in LOITERS:
            circles.append(circle(position, _radius_m(item) / UNIT_M))
        last = position
    return RouteLines(
        np.array(legs).reshape(-1, 2, 3),
        np.array(returns).reshape(-1, 2, 3),
        np.concatenate(circles) if circles else NOTHING.circles,
        np.array(list(positions.values())).reshape(-1, 3),
        np.clip(np.array(list(positions), dtype=object), -1, 10**6).astype(int),
        np.clip(np.array(ends, dtype=object), -1, 10**6).astype(int),
    )


def route_ahead(route: RouteLines, seq: int, at: np.ndarray) -> np.ndarray:
    """Return the way from a position (3,) along the route: (n, 3) [10 m], the position first.

    It leads from the active item `seq` to the last one, and from there, along a jump or a return, once more up to the
    active item. Loiter circles and earlier jumps are left out.
    """
    begin = next((k for k, item in enumerate(route.items.tolist()) if item == seq), None)
    if begin is None:
        return at[None]
    points = [at, *route.points[begin:]]
    back = [target for start, target in route.returns if np.linalg.norm(start - route.points[-1]) < 1e-6]
    if back:
        again = int(np.argmin(np.linalg.norm(route.points - back[-1], axis=1)))
        points += [*route.points[again : begin + 1]]
    return np.array(points)


def area_lines(area: Area, scene_frame: SceneFrame, heights: Heights, ground: float) -> np.ndarray:
    """Return the outline of an area on the ground, segments (n, 2, 3) [10 m].

    Args:
        area, scene_frame: the area, and the frame of the scene
        heights: of the terrain under scene points (n, 3), NaN where unknown [10 m]
        ground: height of the ground there [10 m]
    """
    north, east = area.outline(scene_frame.origin).T / UNIT_M
    corners = np.column_stack([east, north, np.full(len(east), ground)])
    shares = np.linspace(0.0, 1.0, EDGE_PARTS, endpoint=False)[:, None]
    edges = corners[:, None] + shares * (np.roll(corners, -1, axis=0) - corners)[:, None]
    points = np.concatenate([edges.reshape(-1, 3), corners[:1]])
    known = heights(points)
    points[:, 2] = np.where(np.isfinite(known), known, ground)
    return chain(points)


def _return_seq(item: Item) -> int | None:
    """Return the item to which a jump or a return leads; None for other items."""
    if item.command == mav.RTL:
        return 0
    return int(item.param1) if item.command == mav.DO_JUMP and np.isfinite(item.param1) else None


def _usable(item: Item) -> bool:
    return bool(np.isfinite(item.alt_m)) and abs(item.alt_m) < MAX_M


def _item_position(item: Item, scene_frame: SceneFrame, base: float, last: np.ndarray | None) -> np.ndarray | None:
    """Return the scene position of an item, (3,); None without one; 0, 0 is the previous position."""
    if not _usable(item):
        return None
    is_absolute = item.frame in ABSOLUTE
    up = (item.alt_m - scene_frame.origin.alt_mm * 1e-3) / UNIT_M if is_absolute else base + item.alt_m / UNIT_M
    if item.lat_e7 == 0 and item.lon_e7 == 0:
        return None if last is None else np.array([last[0], last[1], up])
    where = (item.lat_e7, item.lon_e7, scene_frame.origin.alt_mm)
    try:
        position = scene_frame.from_geodetic(*(np.array([x]) for x in where))[0]
    except (ValueError, OverflowError):
        return None
    position[2] = up
    return position


def _radius_m(item: Item) -> float:
    radius = abs(getattr(item, RADIUS_FIELD[item.command])) if item.command in RADIUS_FIELD else 0.0
    return radius if np.isfinite(radius) and 0 < radius < MAX_M else RADIUS_M
