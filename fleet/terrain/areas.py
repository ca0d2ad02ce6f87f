"""Areas that aircraft have to stay in or out of: fence items of MAVLink, polygons of a GeoJSON file.

Source: MAVLink "Mission Protocol", MAV_CMD_NAV_FENCE_*; RFC 7946 (GeoJSON).
"""

from collections.abc import Iterable, Sequence
from functools import lru_cache
from math import inf, isfinite
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np

from fleet.contract import Item
from fleet.frames import Origin, to_ned

POLYGON_IN, POLYGON_OUT, CIRCLE_IN, CIRCLE_OUT = 5001, 5002, 5003, 5004  # MAV_CMD_NAV_FENCE_*_INCLUSION, _EXCLUSION
_FENCE_COMMANDS = (POLYGON_IN, POLYGON_OUT, CIRCLE_IN, CIRCLE_OUT)
_MIN_VERTICES = 3
_MAX_RADIUS_M = 1e6  # larger radii are invalid [m]
_CIRCLE_POINTS = 72  # of the outline of a circle
MAX_FILE_BYTES, MAX_VERTICES = 1 << 23, 50_000  # of one file
_REMEDY = "correct the file"


class Area(NamedTuple):
    """A polygon or circle between two heights above mean sea level.

    Attributes:
        name: for texts, e.g. polygon of 5 points
        vertices: (latitude, longitude) [1e-7 deg]; of a circle its centre alone
        exclusion: to stay out of; otherwise to stay in
        radius: of a circle [m]
        floor, ceiling: lower and upper end [m above mean sea level]
    """

    name: str
    vertices: tuple[tuple[int, int], ...]
    exclusion: bool
    radius: float = 0.0
    floor: float = -inf
    ceiling: float = inf

    def __deepcopy__(self, memo: dict[int, Any]) -> "Area":
        """Return itself: an area is not changed, and may have many vertices."""
        return self

    def outline(self, origin: Origin) -> np.ndarray:
        """Return the vertices, of a circle points on it, NED relative to `origin`, (n, 2) [m]."""
        if not self.radius:
            return self._vertices_ned(origin)
        angle = np.linspace(0.0, 2 * np.pi, _CIRCLE_POINTS, endpoint=False)
        return self._vertices_ned(origin) + self.radius * np.column_stack([np.cos(angle), np.sin(angle)])

    def _vertices_ned(self, origin: Origin) -> np.ndarray:
        lat, lon = np.array(self.vertices, float).T
        return to_ned(origin, lat, lon, np.full(len(lat), float(origin.alt_mm)))[:, :2]

    def depth(self, points: np.ndarray, origin: Origin) -> np.ndarray:
        """Return how far points are inside: the distance to the edge, negative outside.

        Args:
            points: NED relative to `origin`, (..., 3) [m]
            origin: of the points
        Returns:
            horizontal distance, (...) [m]; -inf below the floor and above the ceiling
        """
        flat = np.ascontiguousarray(points[..., :2], float).reshape(-1, 2)
        if self.radius:
            depth = self.radius - np.hypot(*(flat - self._vertices_ned(origin)).T)
        else:
            from fleet.compiled_frames import polygon_depth  # here, as a viewer needs no numba

            depth = np.empty(len(flat))
            polygon_depth(flat, np.ascontiguousarray(self._vertices_ned(origin)), depth)
        height = origin.alt_mm * 1e-3 - points[..., 2]
        within = (height >= self.floor) & (height <= self.ceiling)
        return np.where(within, depth.reshape(points.shape[:-1]), -np.inf)


class FenceItems(NamedTuple):
    """Areas of fence items, and what is wrong with the items; empty without an error."""

    areas: tuple[Area, ...]
    sentence: str


@lru_cache(maxsize=512)
def read_fence_items(items: tuple[Item, ...]) -> FenceItems:
    """Return the areas of fence items; a polygon consists of consecutive items that name the number of its vertices."""
    areas: list[Area] = []
    problems: list[str] = []
    k = 0
    while k < len(items):
        item = items[k]
        if item.command in _FENCE_COMMANDS and not _is_on_earth(item):
            problems.append(f"item {item.seq} has no position on earth")
            k += 1
            continue
        exclusion = item.command in (POLYGON_OUT, CIRCLE_OUT)
        if item.command in (CIRCLE_IN, CIRCLE_OUT):
            if 0.0 < item.param1 < _MAX_RADIUS_M:
                place = ((item.lat_e7, item.lon_e7),)
                areas.append(Area(f"circle of {item.param1:.0f} m", place, exclusion, item.param1))
            else:
                problems.append(f"item {item.seq} has a radius of {item.param1:g} m")
        elif item.command in (POLYGON_IN, POLYGON_OUT):
            same = _same_polygon(items[k:])
            if _MIN_VERTICES <= len(same) == item.param1:
                vertices = tuple((vertex.lat_e7, vertex.lon_e7) for vertex in same)
                areas.append(Area(f"polygon of {len(same)} points", vertices, exclusion))
            else:
                problems.append(f"item {item.seq} begins a polygon of {item.param1:g} points, found {len(same)}")
            k += len(same) - 1
        k += 1
    sentence = f"geofence: {'; '.join(problems[:3])}; upload it again" if problems else ""
    return FenceItems(tuple(areas), sentence)


def _same_polygon(items: tuple[Item, ...]) -> tuple[Item, ...]:
    """Return the first item and those after it that belong to the same polygon."""
    first, n = items[0], 1
    while n < min(first.param1, len(items)):
        item = items[n]
        if not _is_on_earth(item) or (item.command, item.param1) != (first.command, first.param1):
            break
        n += 1
    return items[:n]


def _is_on_earth(item: Item) -> bool:
    return abs(item.lat_e7) <= 90e7 and abs(item.lon_e7) <= 180e7


class _Geometry(msgspec.Struct):
    type: str
    coordinates: Any = None


class _Properties(msgspec.Struct):
    fence: Literal["exclusion", "inclusion"] = "exclusion"
    name: str = ""
    floor_m: float | None = None
    ceiling_m: float | None = None


class _Feature(msgspec.Struct):
    geometry: _Geometry
    properties: _Properties | None = None


class _Collection(msgspec.Struct):
    type: Literal["FeatureCollection"]
    features: list[_Feature]


def read_areas(path: Path) -> tuple[Area, ...]:
    """Read the areas of a GeoJSON file.

    A feature is a Polygon or MultiPolygon without holes; its properties are `fence` (exclusion, the default, or
    inclusion), `name`, `floor_m` and `ceiling_m`, heights above mean sea level.

    Raises:
        ValueError: when the file is none, or a feature is not usable; the message names it.
        OSError: when it cannot be read.
    """
    with path.open("rb") as file:
        content = file.read(MAX_FILE_BYTES + 1)
    if len(content) > MAX_FILE_BYTES:
        raise ValueError(f"{path.name}: found more than {MAX_FILE_BYTES >> 20} MiB, expected areas; simplify them")
    try:
        collection = msgspec.json.decode(content, type=_Collection)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(
            f"{path.name}: found {error}, expected a GeoJSON FeatureCollection of polygons; {_REMEDY}"
        ) from None
    areas: list[Area] = []
    for number, feature in enumerate(collection.features, 1):
        properties = feature.properties or _Properties()
        name = properties.name.strip()[:40] or f"area {number}"
        where = f"{path.name}: feature {number}"
        floor, ceiling = _height(properties.floor_m, -inf), _height(properties.ceiling_m, inf)
        if not floor < ceiling:
            raise ValueError(f"{where}: found floor_m {floor:g} and ceiling_m {ceiling:g}, expected less; {_REMEDY}")
        exclusion = properties.fence == "exclusion"
        areas += [Area(name, ring, exclusion, 0.0, floor, ceiling) for ring in _rings(feature.geometry, where)]
    if not areas:
        raise ValueError(f"{path.name}: found no areas, expected one at least; {_REMEDY}")
    if sum(len(area.vertices) for area in areas) > MAX_VERTICES:
        raise ValueError(f"{path.name}: found more than {MAX_VERTICES} vertices; simplify the areas")
    return tuple(areas)


def _height(value: float | None, default: float) -> float:
    return default if value is None else value


def _rings(geometry: _Geometry, where: str) -> Iterable[tuple[tuple[int, int], ...]]:
    """Return the vertices of each polygon of a geometry."""
    if geometry.type not in ("Polygon", "MultiPolygon"):
        raise ValueError(f"{where}: found a {geometry.type[:40]}, expected a Polygon or MultiPolygon; {_REMEDY}")
    polygons = [geometry.coordinates] if geometry.type == "Polygon" else geometry.coordinates
    if not isinstance(polygons, list):
        raise ValueError(f"{where}: found no coordinates, expected rings of positions; {_REMEDY}")
    for polygon in polygons:
        if not isinstance(polygon, list) or len(polygon) != 1:
            rings = len(polygon) if isinstance(polygon, list) else 0
            raise ValueError(f"{where}: found {rings} rings, expected one: holes are not supported; {_REMEDY}")
        yield _ring(polygon[0], where)


def _ring(positions: Any, where: str) -> tuple[tuple[int, int], ...]:
    """Return the vertices of a ring of longitudes and latitudes, without the repeated first one."""
    vertices = []
    for position in positions if isinstance(positions, list) else []:
        if not (isinstance(position, list) and len(position) >= 2 and _is_position(position)):
            raise ValueError(f"{where}: found a vertex {str(position)[:40]}, expected longitude, latitude; {_REMEDY}")
        vertices.append((round(position[1] * 1e7), round(position[0] * 1e7)))
    if len(vertices) > 1 and vertices[0] == vertices[-1]:
        vertices.pop()
    if len(vertices) < _MIN_VERTICES:
        raise ValueError(f"{where}: found {len(vertices)} vertices, expected {_MIN_VERTICES} at least; {_REMEDY}")
    return tuple(vertices)


def _is_position(position: Sequence[Any]) -> bool:
    lon, lat = position[:2]
    return all(isinstance(x, int | float) and isfinite(x) for x in (lon, lat)) and abs(lat) <= 90 and abs(lon) <= 180
