"""Where things are drawn: one local east-north-up frame for the whole fleet, in scene units of 10 m."""

import numpy as np

from fleet.contract import Sample
from fleet.frames import Origin, to_geodetic, to_ned

UNIT_M = 10.0  # metres per scene unit: keeps a fleet of kilometres well inside the renderer's near and far planes
REACH_M = 100_000.0  # farther from the origin than this the tangent plane lies, and nothing is drawn


class TooFar(ValueError):
    """A position that cannot be drawn in the scene there is."""


class Place:
    """The common frame: its origin is the first position anyone reported, until nobody flies within its reach."""

    def __init__(self, origin: Origin) -> None:
        self.origin = origin

    def geodetic(self, lat_e7: np.ndarray, lon_e7: np.ndarray, alt_mm: np.ndarray) -> np.ndarray:
        """Map geodetic positions, (n,) [1e-7 deg, 1e-7 deg, mm], to the scene: (n, 3) ENU [10 m].

        Raises:
            ValueError: when a position is not on this earth; check the sender.
            TooFar: when it is farther than 100 km from the fleet.
        """
        lat, lon, alt = (np.asarray(x, float) for x in (lat_e7, lon_e7, alt_mm))
        if not all(np.isfinite(x).all() for x in (lat, lon, alt)) or (np.abs(lat) > 9e8).any():
            raise ValueError("position: found a value that is no latitude, longitude or altitude; check the sender")
        scene = ned_to_scene(to_ned(self.origin, lat, lon, alt))
        if (np.abs(scene) > REACH_M / UNIT_M).any():
            away = np.abs(scene).max() * UNIT_M / 1000
            raise TooFar(
                f"position: found one {away:.0f} km from the fleet's first, expected at most 100 km; "
                "open another viewer for it"
            )
        return scene

    def local(self, origin: Origin, ned: np.ndarray) -> np.ndarray:
        """Map NED positions relative to another origin, (n, 3) [m], to the scene: (n, 3) ENU [10 m]."""
        ned = np.asarray(ned, float)
        if not np.isfinite(ned).all() or (np.abs(ned) > 2 * REACH_M).any():
            raise ValueError("path: found values that are not finite or beyond 200 km, expected metres; resend")
        if origin == self.origin:
            return ned_to_scene(ned)
        return self.geodetic(*to_geodetic(origin, ned).T)


def ned_to_scene(ned: np.ndarray) -> np.ndarray:
    """Turn NED [m] into east, north, up [10 m]: (..., 3)."""
    return np.stack([ned[..., 1], ned[..., 0], -ned[..., 2]], axis=-1) / UNIT_M


def scene_quat(phi: np.ndarray, theta: np.ndarray, psi: np.ndarray) -> np.ndarray:
    """Turn attitudes (n,) [rad] into orientations (n, 4), scalar first, of a mesh that looks along +x, left is +y.

    In ENU with a forward-left-up body the 3-2-1 angles are yaw = pi/2 - psi, pitch = -theta, roll = phi.
    """
    a, b, c = (np.pi / 2 - psi) / 2, -np.asarray(theta) / 2, np.asarray(phi) / 2
    cy, sy, cp, sp, cr, sr = np.cos(a), np.sin(a), np.cos(b), np.sin(b), np.cos(c), np.sin(c)
    return np.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        axis=-1,
    )


def first_fix(sample: Sample) -> Origin | None:
    """Read the frame's origin off the first position of a sample; None before a fix."""
    if sample.position is None:
        return None
    x = sample.position.x.numpy()
    if x.ndim != 2 or x.shape[1] < 3 or not len(x) or not np.isfinite(x[0]).all() or not x[0, :2].any():
        return None
    return checked(Origin(int(x[0, 0]), int(x[0, 1]), int(x[0, 2])))


def checked(origin: Origin) -> Origin:
    """Refuse an origin that is not on this earth."""
    if abs(origin.lat_e7) > 890_000_000 or abs(origin.lon_e7) > 1_800_000_000 or abs(origin.alt_mm) > 100_000_000:
        raise ValueError(f"origin: found {origin}, expected a place below 89 degrees and 100 km; check the sender")
    return origin
