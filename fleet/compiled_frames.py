"""Compiled functions of `fleet.frames`, which imports them on first use: numba takes 0.25 s to import."""

from math import cos, pi, sin
from typing import Any

import numba as nb
import numpy as np

_DEGREE = pi / 180.0  # [rad]


@nb.njit(cache=True, nogil=True, _nrt=False)  # type: ignore[call-overload]  # no fastmath: same result as numpy
def to_ned_in_place(
    positions: np.ndarray, lat_e7: float, lon_e7: float, alt_mm: float, radii: tuple[float, float]
) -> None:
    """Convert geodetic positions, (n, 3), to NED in place."""
    for k in range(len(positions)):
        d_lon = (positions[k, 1] - lon_e7 + 1.8e9) % 3.6e9 - 1.8e9  # shortest difference across the date line
        positions[k, 0] = (positions[k, 0] - lat_e7) * 1e-7 * _DEGREE * radii[0]
        positions[k, 1] = d_lon * 1e-7 * _DEGREE * radii[1]
        positions[k, 2] = (alt_mm - positions[k, 2]) * 1e-3


@nb.njit(cache=True, nogil=True)
def ned_to_body_rows(euler: np.ndarray, ned: np.ndarray, out: np.ndarray) -> None:
    """Rotate NED vectors to the body, (n, 3), into `out`; compiled because it dominates the cost of resampling."""
    for k in range(len(euler)):
        cf, sf, ct, st = cos(euler[k, 0]), sin(euler[k, 0]), cos(euler[k, 1]), sin(euler[k, 1])
        cp, sp = cos(euler[k, 2]), sin(euler[k, 2])
        n, e, d = ned[k, 0], ned[k, 1], ned[k, 2]
        ahead, right = cp * n + sp * e, cp * e - sp * n
        out[k, 0] = ct * ahead - st * d
        out[k, 1] = sf * st * ahead + cf * right + sf * ct * d
        out[k, 2] = cf * st * ahead - sf * right + cf * ct * d


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
