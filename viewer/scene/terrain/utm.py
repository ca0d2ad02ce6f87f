"""Projection of latitude and longitude to UTM coordinates."""

import numpy as np

_A, _F = 6_378_137.0, 1 / 298.257223563  # WGS 84: semi-major axis [m], flattening
_N = _F / (2 - _F)
_RADIUS = _A / (1 + _N) * (1 + _N**2 / 4 + _N**4 / 64)
_ALPHA = (
    _N / 2 - 2 * _N**2 / 3 + 5 * _N**3 / 16,
    13 * _N**2 / 48 - 3 * _N**3 / 5,
    61 * _N**3 / 240,
)
_SCALE, _EAST_M, _SOUTH_M = 0.9996, 500_000.0, 10_000_000.0


def to_utm(lat_deg: np.ndarray, lon_deg: np.ndarray, zone: int, *, north: bool) -> tuple[np.ndarray, np.ndarray]:
    """Project to a UTM zone, accurate to 1 mm within it: easting and northing [m].

    Source: Krüger 1912 as Karney 2011, "Transverse Mercator with an accuracy of a few nanometers", eq. 7-11.
    """
    phi, lam = np.radians(lat_deg), np.radians(np.asarray(lon_deg) - (6 * zone - 183))
    e = 2 * np.sqrt(_N) / (1 + _N)
    t = np.sinh(np.arctanh(np.sin(phi)) - e * np.arctanh(e * np.sin(phi)))
    xi, eta = np.arctan2(t, np.cos(lam)), np.arcsinh(np.sin(lam) / np.hypot(t, np.cos(lam)))
    y = xi + sum(a * np.sin(2 * k * xi) * np.cosh(2 * k * eta) for k, a in enumerate(_ALPHA, 1))
    x = eta + sum(a * np.cos(2 * k * xi) * np.sinh(2 * k * eta) for k, a in enumerate(_ALPHA, 1))
    return _EAST_M + _SCALE * _RADIUS * x, _SCALE * _RADIUS * y + (0.0 if north else _SOUTH_M)
