"""Geometry of messages on the map: flown positions, predicted path, ellipses of the prediction region."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from fleet.contract import Prediction, Rows, Sample
from fleet.frames import Origin, to_geodetic, to_ned

MAX_REACH_M = 200_000.0  # a path that reaches farther from its origin is invalid [m]
MAX_ELLIPSES = 24  # ellipses of one prediction region
ELLIPSE_POINTS = 32
_INTERVALS_S = (1.0, 2.0, 5.0, 10.0, 30.0, 60.0, 120.0, 300.0)


class PredictedPath(NamedTuple):
    """Checked arrays of a prediction."""

    ahead: np.ndarray  # look-ahead, increasing, (n,) [s]
    ned: np.ndarray  # mean path from `origin`, (n, 3) [m]
    half_axes: np.ndarray  # along, cross, vertical, (n, 3) [m]
    origin: Origin
    horizon_s: float  # confidence horizon, at most the last look-ahead [s]

    def at(self, ahead: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Interpolate path and half-axes at look-aheads (k,) [s]: NED (k, 3) and half-axes (k, 3) [m]."""
        ned = np.stack([np.interp(ahead, self.ahead, column) for column in self.ned.T], axis=-1)
        return ned, np.stack([np.interp(ahead, self.ahead, column) for column in self.half_axes.T], axis=-1)

    def marks(self) -> np.ndarray:
        """Return the look-aheads of the drawn ellipses up to the horizon, the horizon included, (k,) [s]."""
        interval = next((s for s in _INTERVALS_S if self.horizon_s / s < MAX_ELLIPSES), _INTERVALS_S[-1])
        marks = np.arange(interval, self.horizon_s, interval)[: MAX_ELLIPSES - 1]
        return np.append(marks, self.horizon_s) if self.horizon_s > 0 else marks

    def headings(self, ahead: np.ndarray) -> np.ndarray:
        """Return the course of the path at look-aheads (k,) [s], clockwise from north, (k,) [rad]."""
        slope = np.gradient(self.ned[:, :2], self.ahead, axis=0)
        north, east = (np.interp(ahead, self.ahead, column) for column in slope.T)
        return np.arctan2(east, north)


def predicted_path(message: Prediction) -> PredictedPath | None:
    """Check the arrays of a prediction; None when it has no path.

    Raises:
        ValueError: when they disagree or are not finite; the worker must resend.
    """
    arrays = (message.ahead, message.path, message.prediction_region_half_axes)
    ahead, ned, half_axes = (array.numpy().astype(float) for array in arrays)
    n = ahead.shape[0] if ahead.ndim == 1 else -1
    if n == 0:
        return None
    shapes_agree = n >= 2 and ned.shape == half_axes.shape == (n, 3)
    if not shapes_agree or not (np.diff(ahead) > 0).all() or not np.abs(ned).max() <= MAX_REACH_M:
        raise ValueError(f"uav-{message.uav}: found an invalid predicted path, expected finite points; resend")
    lat_e7, lon_e7, alt_mm = message.origin
    if abs(lat_e7) > 9e8 or abs(lon_e7) > 1.8e9 or abs(alt_mm) > 1e8:
        raise ValueError(f"uav-{message.uav}: found an origin outside the Earth, expected a position; resend")
    horizon = message.horizon_s if np.isfinite(message.horizon_s) else 0.0
    reach = float(np.clip(horizon, 0.0, max(ahead[-1], 0.0)))
    return PredictedPath(ahead, ned, np.clip(np.nan_to_num(half_axes), 0.0, MAX_REACH_M), message.ned_origin(), reach)


def coordinates(origin: Origin, ned: np.ndarray) -> list[list[float]]:
    """Map NED positions (n, 3) [m] to longitude, latitude [deg], altitude above mean sea level [m], rounded."""
    return rounded(to_geodetic(origin, ned))


def enu(path: PredictedPath, ned: np.ndarray, origin: Origin) -> np.ndarray:
    """Map NED positions of a prediction, (n, 3) [m], to east, north, up from another origin, (n, 3) [m]."""
    moved = to_ned(origin, *to_geodetic(path.origin, ned).astype(float).T)
    return moved[:, [1, 0, 2]] * [1.0, 1.0, -1.0]


def rounded(lat_lon_alt: np.ndarray) -> list[list[float]]:
    """Convert integers of MAVLink, (n, 3) [1e-7 deg, 1e-7 deg, mm], to longitude, latitude [deg], altitude [m]."""
    return [
        [round(lon * 1e-7, 7), round(lat * 1e-7, 7), round(alt * 1e-3, 3)] for lat, lon, alt in lat_lon_alt.tolist()
    ]


def cut_at_antimeridian(geometry: str, points: Any) -> tuple[str, Any]:
    """Cut a line or a polygon that crosses 180 degrees of longitude, as RFC 7946, section 3.1.9 asks.

    Args:
        geometry: Point, LineString or Polygon
        points: its coordinates as in GeoJSON, longitudes within +-180 deg
    Returns:
        the same, or MultiLineString or MultiPolygon with a part on each side
    """
    if geometry == "LineString":
        parts = cut_line(points)
        return ("LineString", points) if len(parts) == 1 else ("MultiLineString", parts)
    if geometry != "Polygon" or max(lon := [point[0] for point in points[0]]) - min(lon) <= 180:
        return geometry, points
    eastern = [[lon + 360 if lon < 0 else lon, *rest] for lon, *rest in points[0]]
    beyond = _clip_ring([[lon - 360, *rest] for lon, *rest in eastern], -180.0, 1)
    return "MultiPolygon", [[ring] for ring in (_clip_ring(eastern, 180.0, -1), beyond) if len(ring) > 3]


def cut_line(points: Sequence[Sequence[float]]) -> list[list[list[float]]]:
    """Cut a line, points with longitude first [deg], where it crosses 180 degrees; both parts end there."""
    parts: list[list[list[float]]] = [[]]
    for point in map(list, points):
        if parts[-1] and abs(step := point[0] - (last := parts[-1][-1])[0]) > 180:
            side = math.copysign(180.0, last[0])
            share = (side - last[0]) / (step - math.copysign(360.0, step))
            crossing = [round(a + share * (b - a), 7) for a, b in zip(last[1:], point[1:], strict=True)]
            if last[0] != side:
                parts[-1].append([side, *crossing])
            parts.append([] if point[0] == -side else [[-side, *crossing]])
        parts[-1].append(point)
    return [part for part in parts if len(part) > 1] or parts[:1]


def _clip_ring(ring: list[list[float]], limit: float, side: int) -> list[list[float]]:
    """Clip a closed ring to the longitudes below (`side` -1) or above (1) a limit [deg]."""
    clipped: list[list[float]] = []
    for a, b in pairwise(ring):
        inside, next_inside = side * (a[0] - limit) >= 0, side * (b[0] - limit) >= 0
        if inside:
            clipped.append(a)
        if inside != next_inside:
            share = (limit - a[0]) / (b[0] - a[0])
            clipped.append([limit, *(round(p + share * (q - p), 7) for p, q in zip(a[1:], b[1:], strict=True))])
    clipped = [[round(lon, 7), *rest] for lon, *rest in clipped]
    return [*clipped, clipped[0]] if clipped else []


def ellipse(centre: np.ndarray, half_axes: np.ndarray, heading: float) -> np.ndarray:
    """Return a closed ring round the horizontal section of the region, counter-clockwise seen from above.

    Args:
        centre: NED (3,) [m]
        half_axes: along, cross, vertical (3,) [m]
        heading: of the along-axis, clockwise from north [rad]
    Returns:
        NED, (`ELLIPSE_POINTS` + 1, 3) [m]
    """
    angle = np.linspace(0.0, -2 * np.pi, ELLIPSE_POINTS + 1)
    along, cross = half_axes[0] * np.cos(angle), half_axes[1] * np.sin(angle)
    north = np.cos(heading) * along - np.sin(heading) * cross
    east = np.sin(heading) * along + np.cos(heading) * cross
    ring = centre + np.stack([north, east, np.zeros_like(north)], axis=-1)
    ring[-1] = ring[0]
    return ring


def position_rows(message: Sample) -> tuple[np.ndarray, np.ndarray]:
    """Return times (n,) [s since 1970] and valid positions (n, 3) [1e-7 deg, 1e-7 deg, mm] of a sample."""
    rows: Rows | None = message.position
    if rows is None:
        return np.zeros(0), np.zeros((0, 3))
    t, x = rows.t.numpy(), rows.x.numpy().astype(float)
    if x.ndim != 2 or x.shape != (len(t), 3):
        return np.zeros(0), np.zeros((0, 3))
    valid = np.isfinite(x).all(axis=1) & np.isfinite(t) & (np.abs(x[:, 0]) <= 9e8) & (np.abs(x[:, 1]) <= 1.8e9)
    return t[valid], x[valid]
