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
from math import cos, pi, radians, sin, sqrt
from typing import Any, NamedTuple

import numba as nb
import numpy as np

G = 9.80665  # standard gravity [m/s2]
_A = 6378137.0  # WGS-84 equatorial radius [m]
_DEGREE = pi / 180.0  # [rad]
_E2 = 6.69437999014e-3  # WGS-84 first eccentricity squared [-]


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
    out = np.empty((*np.shape(lat_e7), 3))
    out[..., 0], out[..., 1], out[..., 2] = lat_e7, lon_e7, alt_mm
    _to_ned_in_place(out.reshape(-1, 3), float(origin[0]), float(origin[1]), float(origin[2]), _radii(origin))
    return out


@nb.njit(cache=True, nogil=True, _nrt=False)  # type: ignore[call-overload]  # no fastmath: same result as numpy
def _to_ned_in_place(
    positions: np.ndarray, lat_e7: float, lon_e7: float, alt_mm: float, radii: tuple[float, float]
) -> None:
    """Convert geodetic positions, (n, 3), to NED in place."""
    for k in range(len(positions)):
        d_lon = (positions[k, 1] - lon_e7 + 1.8e9) % 3.6e9 - 1.8e9  # shortest difference across the date line
        positions[k, 0] = (positions[k, 0] - lat_e7) * 1e-7 * _DEGREE * radii[0]
        positions[k, 1] = d_lon * 1e-7 * _DEGREE * radii[1]
        positions[k, 2] = (alt_mm - positions[k, 2]) * 1e-3


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
    euler, out = np.column_stack([phi, theta, psi]).astype(float), np.empty((len(phi), 3))
    _ned_to_body_rows(euler, np.ascontiguousarray(ned, float), out)
    return out


@nb.njit(cache=True, nogil=True)
def _ned_to_body_rows(euler: np.ndarray, ned: np.ndarray, out: np.ndarray) -> None:
    """Rotate NED vectors to the body, (n, 3), into `out`; compiled because it dominates the cost of resampling."""
    for k in range(len(euler)):
        cf, sf, ct, st = cos(euler[k, 0]), sin(euler[k, 0]), cos(euler[k, 1]), sin(euler[k, 1])
        cp, sp = cos(euler[k, 2]), sin(euler[k, 2])
        n, e, d = ned[k, 0], ned[k, 1], ned[k, 2]
        ahead, right = cp * n + sp * e, cp * e - sp * n
        out[k, 0] = ct * ahead - st * d
        out[k, 1] = sf * st * ahead + cf * right + sf * ct * d
        out[k, 2] = cf * st * ahead - sf * right + cf * ct * d


def rotation(phi: np.ndarray, theta: np.ndarray, psi: np.ndarray) -> np.ndarray:
    """Return the matrices from body to NED, (3, 3, n); angles (n,) [rad]. Source: Beard & McLain eq. 2.5."""
    cf, sf, ct, st, cp, sp = np.cos(phi), np.sin(phi), np.cos(theta), np.sin(theta), np.cos(psi), np.sin(psi)
    rows = [
        [ct * cp, sf * st * cp - cf * sp, cf * st * cp + sf * sp],
        [ct * sp, sf * st * sp + cf * cp, cf * st * sp - sf * cp],
        [-st, sf * ct, cf * ct],
    ]
    return np.array(rows)


@nb.njit(cache=True)
def wrap(angle: Any) -> Any:
    """Wrap an angle, or an array of them, to (-pi, pi] [rad]; a non-finite angle stays non-finite."""
    wrapped = (angle + pi) % (2 * pi) - pi
    return wrapped + 2 * pi * (wrapped <= -pi)


@nb.njit(cache=True)
def air_direction(phi: Any, theta: Any, psi: Any, gamma: Any) -> Any:
    """Return the horizontal direction of the velocity through the air without sideslip, numbers or arrays [rad].

    In a banked turn the angle of attack moves it out of the turn. The velocity is (cos(alpha), 0, sin(alpha)) in the
    body; rotated by phi and theta, with theta - gamma = alpha cos(phi) for small alpha, it lies left of the nose by
    alpha sin(phi) = (theta - gamma) tan(phi).  Source: Beard & McLain 2012, section 2.3.
    """
    return psi - (theta - gamma) * np.tan(phi)
