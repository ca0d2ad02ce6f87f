"""Offset positions of copies on a square ground grid, so that copies do not collide."""

from math import ceil, sqrt

import numpy as np

from fleet.frames import Origin, to_geodetic

SPACING_M = 500.0  # distance between neighbours [m]
_TURN = 3_600_000_000  # 360 deg [1e-7 deg]


class Aside:
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
        there = to_geodetic(origin, ned)
        self._lon0 = origin.lon_e7
        self._north = (there[:, 0] - origin.lat_e7)[:, None]
        self._east = (there[:, 1] - origin.lon_e7)[:, None]
        here, moved = np.cos(np.radians([origin.lat_e7 * 1e-7])), np.cos(np.radians(there[:, 0] * 1e-7))
        self._wider = (here / np.maximum(moved, 1e-3))[:, None]  # wider at high latitude

    def move(self, lat: np.ndarray, lon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Offset positions, (m,) [1e-7 deg], to (n, m), one row per copy; unset positions 0, 0 are unchanged."""
        nowhere = (lat == 0) & (lon == 0)
        off = (np.asarray(lon, np.int64) - self._lon0 + _TURN // 2) % _TURN - _TURN // 2
        east = self._lon0 + self._east + off * self._wider
        north = np.clip(lat + self._north, -900_000_000, 900_000_000)
        around = (np.rint(east).astype(np.int64) + _TURN // 2) % _TURN - _TURN // 2
        return np.where(nowhere, 0, north), np.where(nowhere, 0, around)
