"""Altitude profile ahead of an aircraft: route, terrain and prediction region over the distance along the way."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from viewer.store.forecast import ScenePrediction
from viewer.store.place import UNIT_M

STEPS = 200  # points of a profile
PREDICTED_STEPS = 60  # of these, look-aheads at which the prediction is evaluated
REACH = 6.0  # length of the profile in lengths of the predicted path, at most [-]
MIN_REACH_M = 2_000.0  # the profile is at least so long where the route is [m]
MIN_LENGTH_M = 10.0  # a shorter way has no profile [m]


class Surface(NamedTuple):
    """Ground of the scene."""

    heights: Callable[[np.ndarray], np.ndarray]  # scene points (n, 2 or 3) [10 m] -> (n,) [10 m], NaN where unknown
    level: float  # height of home, used where no terrain is known, scene [10 m]
    origin_m: float  # altitude of the scene origin above mean sea level [m]

    def altitude_m(self, up: np.ndarray) -> np.ndarray:
        """Convert scene heights [10 m] to altitudes above mean sea level [m]."""
        return up * UNIT_M + self.origin_m


class AltitudeProfile(NamedTuple):
    """Altitudes above mean sea level over the horizontal distance from the aircraft; NaN where there is none."""

    distance_m: np.ndarray  # (n,) along the way, increasing
    ground_m: np.ndarray  # (n,) terrain, or the level of home
    route_m: np.ndarray  # (n,) straight lines between mission items
    low_m: np.ndarray  # (n,) lower edge of the prediction region
    predicted_m: np.ndarray  # (n,)
    high_m: np.ndarray  # (n,) upper edge
    is_terrain: bool  # else the ground is the level of home

    @property
    def clearance_m(self) -> tuple[float, float] | None:
        """Return the least height of the prediction region above the ground and its distance [m]; None without one."""
        clearance = self.low_m - self.ground_m
        if not np.isfinite(clearance).any():
            return None
        at = int(np.nanargmin(clearance))
        return float(clearance[at]), float(self.distance_m[at])


def altitude_profile(
    way: np.ndarray, forecast: ScenePrediction | None, span: tuple[float, float], surface: Surface
) -> AltitudeProfile | None:
    """Compute the altitude profile; None without a way ahead.

    Args:
        way: points of the route ahead, the aircraft first, (n, 3) scene ENU [10 m]; without a route only the aircraft
        forecast: prediction, or None
        span: look-aheads at which the prediction begins and ends [s]; equal: no prediction
        surface: ground below the way
    """
    path = axes = np.zeros((0, 3))
    if forecast is not None and span[1] > span[0]:
        ahead = np.linspace(*span, PREDICTED_STEPS)
        path, axes = forecast.position_at(ahead), forecast.half_axes_at(ahead)
    predicted_s, route_s = _lengths(path), _lengths(way)
    predicted_m, route_m = (float(s[-1]) * UNIT_M if len(s) else 0.0 for s in (predicted_s, route_s))
    length_m = max(predicted_m, min(route_m, max(REACH * predicted_m, MIN_REACH_M)))
    if length_m < MIN_LENGTH_M:
        return None
    distance_m = np.linspace(0.0, length_m, STEPS)
    s = distance_m / UNIT_M
    route = _along(s, route_s, way[:, 2])
    line, line_s = (way, route_s) if len(way) > 1 else (path, predicted_s)
    below = np.stack([_along(s, line_s, line[:, i]) for i in (0, 1)], axis=-1)
    if len(path) and len(way) > 1:  # where the prediction goes on beyond the end of the route
        ends = ~np.isfinite(below[:, 0])
        below[ends] = np.stack([_along(s, predicted_s, path[:, i]) for i in (0, 1)], axis=-1)[ends]
    ground = np.full(STEPS, np.nan)
    known = np.isfinite(below[:, 0])
    ground[known] = surface.heights(below[known])
    is_terrain = bool(np.isfinite(ground).any())
    if not is_terrain:
        ground[:] = surface.level
    edges = [_along(s, predicted_s, path[:, 2] + sign * axes[:, 2]) for sign in (-1, 0, 1)]
    low, middle, high = (surface.altitude_m(edge) for edge in edges)
    ground, route = surface.altitude_m(ground), surface.altitude_m(route)
    return AltitudeProfile(distance_m, ground, route, low, middle, high, is_terrain)


def _lengths(points: np.ndarray) -> np.ndarray:
    """Return the horizontal distance along points (n, 3) from the first: (n,)."""
    if not len(points):
        return np.zeros(0)
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1))])


def _along(s: np.ndarray, lengths: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Interpolate values (n,) at distances `s` (k,): NaN beyond the end, or without a way."""
    if len(lengths) < 2:
        return np.full(len(s), np.nan)
    return np.interp(s, lengths, values, right=np.nan)
