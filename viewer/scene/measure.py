"""Measure tool: distance, bearing and altitude difference between two picked points."""

from collections.abc import Callable
from html import escape
from typing import Any, NamedTuple

import numpy as np

from viewer.scene.labels import CameraView, Tag
from viewer.scene.strokes import Strokes, circle
from viewer.store.place import UNIT_M
from viewer.text.units import Units
from viewer.theme.palette import Palette, rgb

SNAP_PX = 16.0  # an aircraft or mission item so close to the pressed point is picked [CSS px]
REACH = 3_000.0  # farthest ground picked [10 m]
RAY_STEPS = 400  # points of a ray at which terrain is sampled
ENDS = "M ends"
MIDDLE = "X takes the middle of the view"


class Anchor(NamedTuple):
    """Picked point: an aircraft, which moves, or a fixed place."""

    name: str
    at: np.ndarray  # (3,) [10 m]
    uav: int | None = None


class Measurement(NamedTuple):
    """Difference between two points, from the first to the second."""

    distance_m: float  # horizontal
    slant_m: float  # in the line of sight
    bearing_deg: float  # from true north, clockwise, 0 to 360; NaN straight above each other
    climb_m: float  # the second is higher by this


def measure(first: np.ndarray, second: np.ndarray) -> Measurement:
    """Measure from one point (3,) to another, scene ENU [10 m]."""
    east, north, up = ((second - first) * UNIT_M).tolist()
    distance = float(np.hypot(east, north))
    bearing = float(np.degrees(np.arctan2(east, north)) % 360) if distance > 0.05 else np.nan
    return Measurement(distance, float(np.hypot(distance, up)), bearing, up)


def measurement_text(result: Measurement, units: Units) -> str:
    """Format a measurement: `1.23 km, bearing 045°, altitude +120 m`."""
    bearing = f", bearing {round(result.bearing_deg) % 360:03d}°" if np.isfinite(result.bearing_deg) else ""
    climb = units.height_text(abs(result.climb_m))
    sign = "±" if climb == units.height_text(0.0) else "+" if result.climb_m > 0 else "−"
    return f"{units.distance_text(result.distance_m)}{bearing}, altitude {sign}{climb}"


class Measure:
    """State and nodes of the tool on one page; it is off until `toggle`."""

    def __init__(self, scene: Any, palette: Palette) -> None:
        self._palette = palette
        self._lines = Strokes(scene, "/measure", 2.6)
        self.active = False
        self._anchors: tuple[Anchor, ...] = ()  # at most two; replaced as a whole, as clicks come on other threads
        self._missed = False  # the last press met no ground
        self.tags: list[Tag] = []

    def toggle(self) -> None:
        """Start, or end and clear."""
        self.active, self._anchors, self._missed = not self.active, (), False

    def add(self, anchor: Anchor | None) -> None:
        """Add a picked point, None where nothing was; after two points a new measurement begins."""
        self._missed = anchor is None
        if anchor is not None:
            self._anchors = (*(self._anchors if len(self._anchors) < 2 else ()), anchor)

    def draw(self, positions: Callable[[int], np.ndarray | None], ground: float, unit: float, units: Units) -> None:
        """Draw points, line and label; `positions` gives the current position of an aircraft, `unit` its drawn span."""
        self._anchors = tuple(
            a if a.uav is None or (at := positions(a.uav)) is None else a._replace(at=at) for a in self._anchors
        )
        self.tags, colour, lines = [], rgb(self._palette.horizon), [np.zeros((0, 2, 3))]
        for anchor in self._anchors if self.active else ():
            lines += [
                circle(anchor.at, 0.5 * unit, 24),
                np.stack([anchor.at, anchor.at * [1, 1, 0] + [0, 0, ground]])[None],
            ]
        if self.active and len(self._anchors) == 2:
            first, second = (anchor.at for anchor in self._anchors)
            lines.append(np.stack([first, second])[None])
            self.tags = [Tag("measure", measurement_text(measure(first, second), units), (first + second) / 2)]
        self._lines.draw(np.concatenate(lines), colour)

    def html(self, units: Units) -> str:
        """Return what the tool expects next, or the result; empty while it is off."""
        if not self.active:
            return ""
        names = [escape(anchor.name) for anchor in self._anchors]
        if len(names) == 2:
            result = measure(*(anchor.at for anchor in self._anchors))
            slant = f", line of sight {units.distance_text(result.slant_m)}"
            text = f"{names[0]} → {names[1]}: <b>{measurement_text(result, units)}</b>{slant}. {ENDS}."
        elif names:
            text = f"From {names[0]}: press the second point; {MIDDLE}, {ENDS}."
        else:
            text = f"Measure: press the first point; {MIDDLE}, {ENDS}."
        if self._missed:
            text = f"No ground or aircraft there: look down more steeply. {text}"
        return f'<div class="measure" role="status">{text}</div>'


def pick(
    ray: tuple[np.ndarray, np.ndarray],
    anchors: list[Anchor],
    view: CameraView,
    heights: Callable[[np.ndarray], np.ndarray],
    level: float,
) -> Anchor | None:
    """Return what a ray meets: an aircraft or item near it in the image, else the ground; None for the sky.

    Args:
        ray: start and direction, two (3,) [10 m]
        anchors: aircraft and mission items to snap to
        view: camera of the page
        heights: terrain under scene points (n, 3) [10 m], NaN where unknown
        level: height of the ground without terrain [10 m]
    """
    start, direction = ray[0], ray[1] / max(float(np.linalg.norm(ray[1])), 1e-9)
    if anchors:
        offsets = np.array([anchor.at for anchor in anchors]) - start
        depth = offsets @ direction
        across = np.linalg.norm(offsets - depth[:, None] * direction, axis=1)
        pixels = across / (2 * np.tan(view.fov / 2) * np.maximum(depth, 1e-3)) * view.height_px
        pixels[depth <= 0] = np.inf
        if pixels.min() < SNAP_PX:
            return anchors[int(pixels.argmin())]
    point = _ground_point(start, direction, heights, level)
    return None if point is None else Anchor("ground", point)


def _ground_point(
    start: np.ndarray, direction: np.ndarray, heights: Callable[[np.ndarray], np.ndarray], level: float
) -> np.ndarray | None:
    """Return the first point of a ray on the terrain, or on the level where no terrain is known; None without one."""
    steps = np.geomspace(0.5, REACH, RAY_STEPS)
    points = start + steps[:, None] * direction
    terrain = heights(points)
    above = points[:, 2] - np.where(np.isfinite(terrain), terrain, level)
    if start[2] < level and not np.isfinite(terrain).any():
        return None
    below = np.flatnonzero((above[1:] <= 0) & (above[:-1] > 0))
    if not len(below):
        return None
    k = int(below[0])
    share = above[k] / (above[k] - above[k + 1])
    return points[k] + share * (points[k + 1] - points[k])
