"""Ways around an area: the route leaves out what lies in an octagon about it, and follows its corners on one side."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull

_EDGES = 8


class Detour(NamedTuple):
    """Part of a route, (n, 2), that is replaced.

    Attributes:
        first, last: points of the route between which the corners lie; those between them are left out
        corners: (k, 2) [m]; none where the direct way avoids the area
    """

    first: int
    last: int
    corners: np.ndarray


def way_around(route: np.ndarray, outline: np.ndarray, margin: float, *, right: bool) -> Detour | None:
    """Return the way around an area.

    Args:
        route: points of the route, NED, the present position first, (n, 2) [m]
        outline: of the area, NED, (m, 2) [m]
        margin: distance to keep [m]
        right: pass it on the right, with the area on the left
    Returns:
        the detour; None if the route begins or ends within the margin, or does not come so near
    """
    normals, limits = _octagon(route, outline, margin)
    inside = (route @ normals.T < limits).all(axis=1)
    crosses = [_crosses(a, b, normals, limits) for a, b in pairwise(route)]
    if inside[0] or not any(crosses):
        return None
    first = crosses.index(True)
    last = first + 1
    while last < len(route) and (inside[last] or (last < len(crosses) and crosses[last])):
        last += 1
    if last == len(route):
        return None
    points = np.vstack([route[[first, last]], _corners(normals, limits)])
    order = ConvexHull(points).vertices.tolist()  # from north to east: with the area on the right
    if 0 not in order or 1 not in order:
        return Detour(first, last, np.empty((0, 2)))
    begin = order.index(0)
    order = order[begin:] + order[:begin]
    end = order.index(1)
    between = order[end + 1 :][::-1] if right else order[1:end]
    return Detour(first, last, points[between])


def _octagon(route: np.ndarray, outline: np.ndarray, margin: float) -> tuple[np.ndarray, np.ndarray]:
    """Return outward normals, (8, 2), and distances, (8,) [m], of an octagon along the leg nearest to the area."""
    centre = outline.mean(axis=0)
    middles = (route[:-1] + route[1:]) / 2
    k = int(np.hypot(*(middles - centre).T).argmin())
    heading = np.arctan2(*(route[k + 1] - route[k])[::-1])
    angle = heading + np.arange(_EDGES) * 2 * np.pi / _EDGES
    normals = np.column_stack([np.cos(angle), np.sin(angle)])
    return normals, (outline @ normals.T).max(axis=0) + margin


def _corners(normals: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Return the intersections of neighbouring edges, (8, 2)."""
    pairs = zip(normals, np.roll(normals, -1, axis=0), limits, np.roll(limits, -1), strict=True)
    return np.array([np.linalg.solve(np.array([n, m]), [a, b]) for n, m, a, b in pairs])


def _crosses(start: np.ndarray, end: np.ndarray, normals: np.ndarray, limits: np.ndarray) -> bool:
    """Return whether a leg passes through a convex polygon.

    Source: Cyrus and Beck 1978, "Generalized two- and three-dimensional clipping".
    """
    slack, slope = limits - normals @ start, normals @ (end - start)
    if (slack[slope == 0.0] <= 0.0).any():
        return False
    with np.errstate(over="ignore"):  # nearly parallel to an edge: the leg meets it at infinity
        t = slack[slope != 0.0] / slope[slope != 0.0]
    is_exit = slope[slope != 0.0] > 0.0
    enter, leave = t[~is_exit].max(initial=0.0), t[is_exit].min(initial=1.0)
    return bool(enter < leave)
