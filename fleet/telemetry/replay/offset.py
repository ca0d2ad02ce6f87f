"""Places moved aside, so that copies of an aircraft do not fly through each other: a square grid on the ground."""

from math import ceil, sqrt

import numpy as np

from fleet.frames import Origin, to_geodetic

SPACING_M = 500.0  # between two neighbours [m]
_TURN = 3_600_000_000  # once round the earth [1e-7 deg]


class Aside:
    """Where each copy flies what the original flew.

    Args:
        numbers: of the copies, from 1; 0 is the original, at a corner of the grid, (n,)
        total: originals and copies of one aircraft
        origin: a place of the original
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
        self._wider = (here / np.maximum(moved, 1e-3))[:, None]  # a metre east is more degrees further from the equator

    def move(self, lat: np.ndarray, lon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Move places, (m,) [1e-7 deg], aside: (n, m), a row for each copy. Nowhere, which is 0, 0, stays so."""
        nowhere = (lat == 0) & (lon == 0)
        off = (np.asarray(lon, np.int64) - self._lon0 + _TURN // 2) % _TURN - _TURN // 2
        east = self._lon0 + self._east + off * self._wider
        north = np.clip(lat + self._north, -900_000_000, 900_000_000)
        around = (np.rint(east).astype(np.int64) + _TURN // 2) % _TURN - _TURN // 2
        return np.where(nowhere, 0, north), np.where(nowhere, 0, around)
