"""What lies around the flights of a case: terrain with a hill, and a no-fly area, at one place of the first flight."""

from typing import NamedTuple

import numpy as np

from fleet.frames import to_geodetic
from fleet.simulator.vehicle.missions import HOME
from fleet.terrain.areas import Area
from fleet.terrain.raster import Raster
from tests.support.heights import raster

PLACE_S = 120.0  # when the aircraft reaches the place [s]
HILL_TOP_M, HILL_WIDTH_M = 10.0, 250.0  # how far below the aircraft; a bell's width
AREA_M, CORNERS = 150.0, 6  # radius and corners of the no-fly area
CLEAR_M, CLEAR_S = 350.0, 60.0  # the place is so far from home and from the path before then, where there is such a one
PLACES_S = np.arange(PLACE_S - 30.0, PLACE_S + 30.0, 5.0)


class Surroundings(NamedTuple):
    """Terrain and areas; paths are NED from HOME [m]."""

    terrain: Raster | None = None
    areas: tuple[Area, ...] = ()

    def clearance(self, path: np.ndarray, home: np.ndarray) -> np.ndarray:
        """Return the height above ground along a path, (n, 3), relative to the ground at home [m]."""
        height: np.ndarray = home[2] - path[:, 2]
        if self.terrain is None:
            return height
        at = to_geodetic(HOME, np.vstack([path, home])) * 1e-7
        ground = self.terrain.sample(at[:, 0], at[:, 1])
        return height - np.nan_to_num(ground[:-1] - ground[-1])

    def enters(self, path: np.ndarray) -> bool:
        """Tell whether a path, (n, 3), enters a no-fly area."""
        return any(bool((area.depth(path, HOME) > 0.0).any()) for area in self.areas)


NOTHING_AROUND = Surroundings()


def hill(path: np.ndarray, height: np.ndarray, row_s: float) -> Surroundings:
    """Return flat terrain with a bell-shaped hill below one place of a path, (n, 3); `height` is above home [m]."""
    k = int(PLACE_S / row_s)
    top, centre = height[k] - HILL_TOP_M, path[k]

    def ground(north: np.ndarray, east: np.ndarray) -> np.ndarray:
        away = np.hypot(north - centre[0], east - centre[1]) / HILL_WIDTH_M
        return HOME.alt_mm * 1e-3 + top * np.exp(-0.5 * away**2)

    return Surroundings(raster(HOME, ground, step_m=30.0, reach_m=12_000.0))


def no_fly_area(path: np.ndarray, row_s: float) -> Surroundings:
    """Return a no-fly area around one place of a path, (n, 3), away from its begin where there is such a place."""
    begin = path[: int(CLEAR_S / row_s)]

    def away(t: float) -> float:
        return float(np.hypot(*(begin - path[int(t / row_s)])[:, :2].T).min())

    t = next((t for t in PLACES_S if away(t) > CLEAR_M), max(PLACES_S, key=away))
    angle = np.linspace(0.0, 2 * np.pi, CORNERS, endpoint=False)
    corners = path[int(t / row_s)] + AREA_M * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(CORNERS)])
    lat, lon, _ = to_geodetic(HOME, corners).T
    return Surroundings(areas=(Area("no-fly", tuple(zip(lat.astype(int), lon.astype(int), strict=True)), True),))
