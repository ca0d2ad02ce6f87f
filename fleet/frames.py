"""Frames and letters: NED, FRD, geodetic, quaternions, the wind triangle.

Letters of Beard & McLain, "Small Unmanned Aircraft" (2012), used throughout the project:

    p_n p_e p_d      position, north-east-down from a named origin (NED)        [m]
    v_n v_e v_d      velocity over ground (NED)                                 [m/s]
    u v w            velocity in the body, forward-right-down (FRD)             [m/s]
    quat             attitude, body -> NED, scalar first                        [-]
    phi theta psi    roll, pitch, yaw (3-2-1)                                   [rad]
    p q r            body rates (FRD)                                           [rad/s]
    Va alpha beta    airspeed, angle of attack, sideslip                        [m/s, rad]
    chi gamma        course over ground, flight-path angle                      [rad]
    delta_a delta_e delta_r   aileron, elevator, rudder, -1..1 of full throw    [-]
    delta_t          throttle, 0..1                                             [-]
    w_n w_e          wind, the direction it blows to (NED)                      [m/s]

Positive aileron rolls right, positive elevator pitches up, positive rudder yaws right.
"""

from functools import lru_cache
from math import cos, radians, sin, sqrt
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from fleet.compiled_frames import air_direction as air_direction
    from fleet.compiled_frames import wrap as wrap

G = 9.80665  # standard gravity [m/s2]
_A = 6378137.0  # WGS-84 equatorial radius [m]
_E2 = 6.69437999014e-3  # WGS-84 first eccentricity squared [-]


def __getattr__(name: str) -> Any:
    """Import `wrap` and `air_direction` on first use: numba would dominate the start of commands without it."""
    if name in ("wrap", "air_direction"):
        from fleet import compiled_frames

        return getattr(compiled_frames, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


class Origin(NamedTuple):
    """Origin of a local NED frame; integers as in MAVLink, so nothing is rounded twice."""

    lat_e7: int  # geodetic latitude [1e-7 deg]
    lon_e7: int  # longitude [1e-7 deg]
    alt_mm: int  # height above mean sea level [mm]


@lru_cache(maxsize=4096)
def _radii(origin: Origin) -> tuple[float, float]:
    lat = radians(origin.lat_e7 * 1e-7)
    s = sin(lat)
    meridian = _A * (1 - _E2) / (1 - _E2 * s * s) ** 1.5
    normal = _A / sqrt(1 - _E2 * s * s)
    h = origin.alt_mm * 1e-3
    return meridian + h, (normal + h) * cos(lat)


def to_ned(origin: Origin, lat_e7: np.ndarray, lon_e7: np.ndarray, alt_mm: np.ndarray) -> np.ndarray:
    """Map geodetic positions to local NED of `origin` (tangent plane, good within 100 km).

    Args:
        lat_e7, lon_e7: geodetic position, (n,) [1e-7 deg]
        alt_mm: height above mean sea level, (n,) [mm]
    Returns:
        position, NED, (n, 3) [m]
    """
    from fleet.compiled_frames import to_ned_in_place

    out = np.empty((*np.shape(lat_e7), 3))
    out[..., 0], out[..., 1], out[..., 2] = lat_e7, lon_e7, alt_mm
    to_ned_in_place(out.reshape(-1, 3), float(origin[0]), float(origin[1]), float(origin[2]), _radii(origin))
    return out


def to_geodetic(origin: Origin, ned: np.ndarray) -> np.ndarray:
    """Map local NED positions to geodetic: (n, 3) [m] -> (n, 3) integers [1e-7 deg, 1e-7 deg, mm]."""
    m, n = _radii(origin)
    ned = np.asarray(ned, float)
    lon = origin.lon_e7 + np.degrees(ned[..., 1] / n) * 1e7
    out = np.empty((*ned.shape[:-1], 3))
    out[..., 0] = origin.lat_e7 + np.degrees(ned[..., 0] / m) * 1e7
    out[..., 1] = (lon + 1.8e9) % 3.6e9 - 1.8e9
    out[..., 2] = origin.alt_mm - ned[..., 2] * 1e3
    return np.rint(out, out=out).astype(np.int64)


def body_to_ned(phi: np.ndarray, theta: np.ndarray, psi: np.ndarray, body: np.ndarray) -> np.ndarray:
    """Rotate body vectors to NED. Angles (n,) [rad], body FRD (n, 3). Source: Beard & McLain eq. 2.5."""
    return np.einsum("nij,nj->ni", np.moveaxis(rotation(phi, theta, psi), -1, 0), body)


def ned_to_body(phi: np.ndarray, theta: np.ndarray, psi: np.ndarray, ned: np.ndarray) -> np.ndarray:
    """Rotate NED vectors to the body. Angles (n,) [rad], NED (n, 3)."""
    from fleet.compiled_frames import ned_to_body_rows

    euler, out = np.column_stack([phi, theta, psi]).astype(float), np.empty((len(phi), 3))
    ned_to_body_rows(euler, np.ascontiguousarray(ned, float), out)
    return out


def rotation(phi: np.ndarray, theta: np.ndarray, psi: np.ndarray) -> np.ndarray:
    """Return the matrices from body to NED, (3, 3, n); angles (n,) [rad]. Source: Beard & McLain eq. 2.5."""
    cf, sf, ct, st, cp, sp = np.cos(phi), np.sin(phi), np.cos(theta), np.sin(theta), np.cos(psi), np.sin(psi)
    rows = [
        [ct * cp, sf * st * cp - cf * sp, cf * st * cp + sf * sp],
        [ct * sp, sf * st * sp + cf * cp, cf * st * sp - sf * cp],
        [-st, sf * ct, cf * ct],
    ]
    return np.array(rows)
