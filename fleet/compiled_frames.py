"""Compiled functions of `fleet.frames` and `fleet.terrain.areas`, which import them on first use; array assignment.

Numba takes 0.25 s to import.
"""

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


@nb.njit(cache=True, nogil=True)
def polygon_depth(points: np.ndarray, vertices: np.ndarray, out: np.ndarray) -> None:
    """Compute the distance of points (m, 2) to the edge of a polygon (n, 2), negative outside, into `out` (m,).

    Inside is where a ray crosses the edge an odd number of times.
    """
    n = len(vertices)
    for k in range(len(points)):
        x, y = points[k, 0], points[k, 1]
        nearest, inside = np.inf, False
        for i in range(n):
            ax, ay = vertices[i - 1, 0], vertices[i - 1, 1]
            bx, by = vertices[i, 0], vertices[i, 1]
            dx, dy = bx - ax, by - ay
            if (ay > y) != (by > y) and x < ax + (y - ay) * dx / dy:
                inside = not inside
            length2 = dx * dx + dy * dy
            share = ((x - ax) * dx + (y - ay) * dy) / length2 if length2 > 0.0 else 0.0
            share = min(max(share, 0.0), 1.0)
            away_x, away_y = x - ax - share * dx, y - ay - share * dy
            nearest = min(nearest, away_x * away_x + away_y * away_y)
        out[k] = np.sqrt(nearest) if inside else -np.sqrt(nearest)


@nb.njit(cache=True, nogil=True, _nrt=False)  # type: ignore[call-overload]  # no fastmath: copies nan and inf
def assign(out: np.ndarray, values: np.ndarray) -> None:
    """Copy `values` to `out`, both (n,), sizes unchecked.

    For `out[:] = values` numba compiles the text of its error message as well, which takes 1.5 s of CPU time.
    """
    for i in range(len(out)):
        out[i] = values[i]
