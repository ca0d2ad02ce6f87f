"""Scene frame: one local east-north-up frame for the whole fleet, in scene units of 10 m."""

from functools import lru_cache

import numpy as np

from fleet.frames import Origin, to_geodetic, to_ned
from viewer.store.inbox import SampleSubset

UNIT_M = 10.0  # metres per scene unit: keeps the fleet between the near and far planes of the renderer
REACH_M = 100_000.0  # beyond this distance the tangent plane is inaccurate and nothing is drawn


class OutOfRangeError(ValueError):
    """Position beyond the range of the scene frame."""


class SceneFrame:
    """Common local frame; its origin is the first reported position, until no UAV is within range."""

    def __init__(self, origin: Origin) -> None:
        self.origin = origin
        north, east, _ = to_ned(origin, *(np.array([x + 1e6]) for x in origin))[0]
        self._east, self._north = east / 1e6 / UNIT_M, north / 1e6 / UNIT_M  # linear map [10 m / 1e-7 deg]

    def from_geodetic(self, lat_e7: np.ndarray, lon_e7: np.ndarray, alt_mm: np.ndarray) -> np.ndarray:
        """Map geodetic positions, (n,) [1e-7 deg, 1e-7 deg, mm], to the scene: (n, 3) ENU [10 m].

        Raises:
            ValueError: when a position is invalid; check the sender.
            OutOfRangeError: when it is farther than 100 km from the fleet.
        """
        lat, lon, alt = (np.asarray(x, float) for x in (lat_e7, lon_e7, alt_mm))
        if not all(np.isfinite(x).all() for x in (lat, lon, alt)) or (np.abs(lat) > 9e8).any():
            raise ValueError("position: found an invalid latitude, longitude or altitude; check the sender")
        scene = ned_to_scene(to_ned(self.origin, lat, lon, alt))
        if (np.abs(scene) > REACH_M / UNIT_M).any():
            distance_km = np.abs(scene).max() * UNIT_M / 1000
            distance = f"position: found {distance_km:.0f} km from the scene origin"
            raise OutOfRangeError(f"{distance}, expected at most 100 km; open another viewer")
        return scene

    def from_geodetic_point(self, lat_e7: float, lon_e7: float, alt_mm: float) -> tuple[float, float, float]:
        """Map one position as `from_geodetic` does, without numpy: east, north, up [10 m].

        Raises:
            ValueError: when it is invalid; check the sender.
            OutOfRangeError: when it is farther than 100 km from the fleet.
        """
        d_lon = lon_e7 - self.origin.lon_e7
        east, north = d_lon * self._east, (lat_e7 - self.origin.lat_e7) * self._north
        up = (alt_mm - self.origin.alt_mm) * 1e-3 / UNIT_M
        reach = REACH_M / UNIT_M
        if -reach <= east <= reach and -reach <= north <= reach and -reach <= up <= reach:
            return east, north, up
        # raises, or crosses 180 degrees
        (point,) = self.from_geodetic(*(np.array([x]) for x in (lat_e7, lon_e7, alt_mm))).tolist()
        return point[0], point[1], point[2]

    def from_geodetic_in_range(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Map positions as `from_geodetic_point` does, (n, 3 or more) latitude, longitude, altitude.

        Returns:
            scene ENU (n, 3) [10 m]; a mask (n,) of those with a fix and in range on this side of 180 degrees
        """
        lat, lon, alt = positions.T[:3]
        scene = np.empty((len(positions), 3))
        scene[:, 0] = (lon - self.origin.lon_e7) * self._east
        scene[:, 1] = (lat - self.origin.lat_e7) * self._north
        scene[:, 2] = (alt - self.origin.alt_mm) * 1e-3 / UNIT_M
        return scene, (np.abs(scene) <= REACH_M / UNIT_M).all(axis=1) & ((lat != 0.0) | (lon != 0.0))

    def from_ned(self, origin: tuple[int, int, int], ned: np.ndarray) -> np.ndarray:
        """Map NED positions relative to another origin, (n, 3) [m], to the scene: (n, 3) ENU [10 m]."""
        ned = np.asarray(ned, float)
        if not np.abs(ned).max(initial=0.0) <= 2 * REACH_M:  # also of values that are not finite
            raise ValueError("path: found values that are not finite or beyond 200 km, expected metres; resend")
        if tuple(origin) == tuple(self.origin):
            return ned_to_scene(ned)
        (lat, lon, alt), (north, east) = origin, _e7_per_m(Origin(*origin))
        scene = np.empty(ned.shape)
        scene[:, 0] = (lon - self.origin.lon_e7 + ned[:, 1] * east) * self._east
        scene[:, 1] = (lat - self.origin.lat_e7 + ned[:, 0] * north) * self._north
        scene[:, 2] = ((alt - self.origin.alt_mm) * 1e-3 - ned[:, 2]) / UNIT_M
        if np.abs(scene).max(initial=0.0) <= REACH_M / UNIT_M:
            return scene
        return self.from_geodetic(*to_geodetic(Origin(*origin), ned).T)  # raises, or crosses 180 degrees


@lru_cache(maxsize=4096)
def _e7_per_m(origin: Origin) -> tuple[float, float]:
    """Return latitude and longitude per metre north and east of an origin [1e-7 deg / m]."""
    far = to_geodetic(origin, np.array([1e6, 1e6, 0.0]))
    north, east = int(far[0]) - origin.lat_e7, (int(far[1]) - origin.lon_e7) % 3_600_000_000
    return north / 1e6, east / 1e6


def ned_to_scene(ned: np.ndarray) -> np.ndarray:
    """Convert NED [m] to east, north, up [10 m]: (..., 3)."""
    return np.stack([ned[..., 1], ned[..., 0], -ned[..., 2]], axis=-1) / UNIT_M


def scene_quat(phi: np.ndarray, theta: np.ndarray, psi: np.ndarray) -> np.ndarray:
    """Convert attitudes (n,) [rad] to quaternions (n, 4), scalar first, of a mesh with +x forward, +y left.

    In ENU with a forward-left-up body the 3-2-1 angles are yaw = pi/2 - psi, pitch = -theta, roll = phi.
    """
    a, b, c = (np.pi / 2 - psi) / 2, -np.asarray(theta) / 2, np.asarray(phi) / 2
    cy, sy, cp, sp, cr, sr = np.cos(a), np.sin(a), np.cos(b), np.sin(b), np.cos(c), np.sin(c)
    w, x = cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy
    y, z = cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy
    return np.stack([w, x, y, z], axis=-1)


def first_fix(sample: SampleSubset) -> Origin | None:
    """Return the first position of a sample as frame origin; None before a fix."""
    if sample.position is None:
        return None
    x = sample.position.x.numpy()
    if x.ndim != 2 or x.shape[1] < 3 or not len(x) or not np.isfinite(x[0]).all() or not x[0, :2].any():
        return None
    return checked_origin(Origin(int(x[0, 0]), int(x[0, 1]), int(x[0, 2])))


def checked_origin(origin: Origin) -> Origin:
    """Return the origin unchanged; raise ValueError when it is invalid."""
    if abs(origin.lat_e7) > 890_000_000 or abs(origin.lon_e7) > 1_800_000_000 or abs(origin.alt_mm) > 100_000_000:
        raise ValueError(f"origin: found {origin}, expected latitude < 89 deg and altitude < 100 km; check the sender")
    return origin
