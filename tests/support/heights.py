"""Made-up terrain."""

from collections.abc import Callable

import numpy as np

from fleet.frames import Origin, to_geodetic
from fleet.terrain.raster import Raster


def raster(
    origin: Origin,
    height: Callable[[np.ndarray, np.ndarray], np.ndarray],
    *,
    step_m: float = 10.0,
    reach_m: float = 4_500.0,
) -> Raster:
    """Sample heights [m above sea level], a function of north and east of the origin [m], on a square grid."""
    side = np.arange(-reach_m, reach_m + step_m, step_m)
    north, east = np.meshgrid(side[::-1], side, indexing="ij")
    corners = to_geodetic(origin, np.array([[side[-1], side[0], 0.0], [side[0], side[-1], 0.0]])) * 1e-7
    (lat_0, lon_0, _), (lat_1, lon_1, _) = corners
    n = len(side) - 1
    affine = np.array([[(lon_1 - lon_0) / n, 0.0, lon_0], [0.0, (lat_1 - lat_0) / n, lat_0]])
    return Raster("grid", height(north, east).astype(np.float32), affine)
