"""Offset positions of copies on a square ground grid, so that copies do not collide."""

from math import ceil, sqrt

import numpy as np

from fleet.frames import Origin, to_geodetic

SPACING_M = 500.0  # distance between neighbours [m]
_FULL_TURN_E7 = 3_600_000_000  # 360 deg [1e-7 deg]


class GridOffset:
    """Position offset of each copy.

    Args:
        numbers: copy numbers from 1; 0 is the original, at a corner of the grid, (n,)
        total: number of copies, original included
        origin: a position of the original
    """

    def __init__(self, numbers: np.ndarray, total: int, origin: Origin) -> None:
        side = ceil(sqrt(total))
        ned = np.zeros((len(numbers), 3))
        ned[:, 0], ned[:, 1] = numbers // side * SPACING_M, numbers % side * SPACING_M
        places = to_geodetic(origin, ned)
        self._lon0 = origin.lon_e7
        self._north = (places[:, 0] - origin.lat_e7)[:, None]
        self._east = (places[:, 1] - origin.lon_e7)[:, None]
        origin_cos, place_cos = np.cos(np.radians([origin.lat_e7 * 1e-7])), np.cos(np.radians(places[:, 0] * 1e-7))
        self._east_scale = (origin_cos / np.maximum(place_cos, 1e-3))[:, None]  # wider at high latitude

    def move(self, lat: np.ndarray, lon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Offset positions, (m,) [1e-7 deg], to (n, m), one row per copy; unset positions 0, 0 are unchanged."""
        is_unset = (lat == 0) & (lon == 0)
        from_origin = (np.asarray(lon, np.int64) - self._lon0 + _FULL_TURN_E7 // 2) % _FULL_TURN_E7 - _FULL_TURN_E7 // 2
        east = self._lon0 + self._east + from_origin * self._east_scale
        north = np.clip(lat + self._north, -900_000_000, 900_000_000)
        wrapped_east = (np.rint(east).astype(np.int64) + _FULL_TURN_E7 // 2) % _FULL_TURN_E7 - _FULL_TURN_E7 // 2
        return np.where(is_unset, 0, north), np.where(is_unset, 0, wrapped_east)
