"""Georeferenced rasters from files: heights and imagery in degrees, UTM or Web Mercator."""

import re
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fleet.process.file_options import check_file

_A, _F = 6_378_137.0, 1 / 298.257223563  # WGS 84: semi-major axis [m], flattening
_N = _F / (2 - _F)
_RADIUS = _A / (1 + _N) * (1 + _N**2 / 4 + _N**4 / 64)
_ALPHA = _N / 2 - 2 * _N**2 / 3 + 5 * _N**3 / 16, 13 * _N**2 / 48 - 3 * _N**3 / 5, 61 * _N**3 / 240
MERCATOR_LIMIT_DEG = 85.0511  # latitude at which the square map ends [deg]
_SCALE, _EAST_M, _SOUTH_M = 0.9996, 500_000.0, 10_000_000.0


def to_utm(lat_deg: np.ndarray, lon_deg: np.ndarray, zone: int, *, north: bool) -> tuple[np.ndarray, np.ndarray]:
    """Project to a UTM zone, accurate to 1 mm within it: easting and northing [m].

    Source: Krüger 1912 as Karney 2011, "Transverse Mercator with an accuracy of a few nanometers", eq. 7-11.
    """
    phi, lam = np.radians(lat_deg), np.radians((np.asarray(lon_deg) - (6 * zone - 183) + 180) % 360 - 180)
    e = 2 * np.sqrt(_N) / (1 + _N)
    t = np.sinh(np.arctanh(np.sin(phi)) - e * np.arctanh(e * np.sin(phi)))
    xi, eta = np.arctan2(t, np.cos(lam)), np.arcsinh(np.sin(lam) / np.hypot(t, np.cos(lam)))
    y = xi + sum(a * np.sin(2 * k * xi) * np.cosh(2 * k * eta) for k, a in enumerate(_ALPHA, 1))
    x = eta + sum(a * np.cos(2 * k * xi) * np.sinh(2 * k * eta) for k, a in enumerate(_ALPHA, 1))
    return _EAST_M + _SCALE * _RADIUS * x, _SCALE * _RADIUS * y + (0.0 if north else _SOUTH_M)


def to_mercator(lat_deg: np.ndarray, lon_deg: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project to Web Mercator (EPSG:3857), scaled to the unit square: x east, y south, NaN beyond 85.05 degrees."""
    phi = np.radians(np.where(np.abs(lat_deg) < MERCATOR_LIMIT_DEG, lat_deg, np.nan))
    return np.asarray(lon_deg) / 360 + 0.5, 0.5 - np.arctanh(np.sin(phi)) / (2 * np.pi)


MAX_PIXELS = 80_000_000  # pixels of one file
MERCATOR = "web mercator"  # x, y of EPSG:3857 in the unit square: x east from 180° W, y south from 85.05° N
HGT_SIDES = (1201, 3601)  # samples along one side of an SRTM file
HGT_VOID = -32768
SCALE, TIEPOINT, MATRIX, KEYS, NO_DATA = 33550, 33922, 34264, 34735, 42113  # TIFF tags
MODEL, RASTER_TYPE, PROJECTED = 1024, 1025, 3072  # keys in KEYS
WORLD = (".wld", ".pgw", ".pngw", ".jgw", ".tfw")
REMEDY = "convert it to EPSG:4326 (gdalwarp -t_srs EPSG:4326) or give its bounds: FILE@south,west,north,east"


class Raster(NamedTuple):
    """Georeferenced grid of heights or colours."""

    name: str
    values: np.ndarray  # (h, w) heights [m above mean sea level], NaN where unknown; or (h, w, 3) colours
    affine: np.ndarray  # (2, 3): column, row, 1 -> x, y of the pixel centre
    zone: tuple[int, bool] | str | None = None  # UTM zone and northern hemisphere; MERCATOR; None: x, y in degrees

    def __deepcopy__(self, memo: dict[int, Any]) -> "Raster":
        """Return itself: a raster is not changed, and may be large."""
        return self

    def sample(self, lat_deg: np.ndarray, lon_deg: np.ndarray) -> np.ndarray:
        """Interpolate values at positions of any shape, NaN outside; colours have a last axis of 3."""
        from scipy.ndimage import map_coordinates  # deferred import: only needed with terrain

        lat, lon = np.asarray(lat_deg, float).ravel(), np.asarray(lon_deg, float).ravel()
        x, y = self._project(lat, lon)
        column, row = np.linalg.inv(self.affine[:, :2]) @ (np.stack([x, y]) - self.affine[:, 2:])
        outside = (column < -0.5) | (row < -0.5)
        outside |= (column > self.values.shape[1] - 0.5) | (row > self.values.shape[0] - 0.5)
        outside |= ~np.isfinite(row)
        planes = np.asarray(self.values.reshape(*self.values.shape[:2], -1), np.float32)
        values = np.full((len(row), planes.shape[2]), np.nan, np.float32)
        at = [row[~outside], column[~outside]]
        for k in range(planes.shape[2]):
            values[~outside, k] = map_coordinates(planes[..., k], at, order=1, mode="nearest")
        return values.reshape((*np.shape(lat_deg), *self.values.shape[2:]))

    def _project(self, lat: np.ndarray, lon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self.zone is None or isinstance(self.zone, str):
            middle = self.affine[0] @ [self.values.shape[1] / 2, self.values.shape[0] / 2, 1.0]
            middle = middle if self.zone is None else (middle - 0.5) * 360
            lon = middle + (lon - middle + 180) % 360 - 180  # continuous where the raster crosses 180 degrees
            return (lon, lat) if self.zone is None else to_mercator(lat, lon)
        return to_utm(lat, lon, self.zone[0], north=self.zone[1])


def read_raster(text: str, *, colours: bool) -> Raster:
    """Read a raster file.

    Args:
        text: `FILE`, or `FILE@south,west,north,east` in degrees
        colours: True for imagery, False for heights in metres
    Raises:
        ValueError: when the file is invalid or not georeferenced; the message contains the remedy.
        OSError: when it cannot be opened.
    """
    from PIL import Image  # deferred import: only needed with a file

    path, bounds = _split(text)
    check_file("--imagery" if colours else "--terrain", path, "a raster file")
    if not colours and path.suffix.lower() == ".hgt":
        return _read_hgt(path)
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:  # errors are reported below
            if image.width * image.height > MAX_PIXELS:
                raise ValueError(
                    f"{path.name}: found {image.width} x {image.height} pixels, expected <= {MAX_PIXELS:,}; crop it"
                )
            values = np.asarray(image.convert("RGB")) if colours else _heights(image)
            affine, zone = (_bounded(bounds, image), None) if bounds else _georeference(path, image)
    except (Image.UnidentifiedImageError, Image.DecompressionBombError, SyntaxError, EOFError) as error:
        raise ValueError(f"{path.name}: found no readable raster ({error}), expected GeoTIFF, PNG or JPEG") from None
    except OSError as error:
        if error.errno is not None:
            raise
        text = f"{path.name}: found a damaged raster ({error}), expected a complete one; download it again"
        raise ValueError(text) from None
    return Raster(path.name, values, affine, zone)


def _read_hgt(path: Path) -> Raster:
    """Read an SRTM file: big-endian int16 heights, rows from the north; its name gives the south-western corner.

    Source: USGS, "SRTM Topography", documentation of version 2.1.
    """
    corner = re.fullmatch(r"([NS])(\d{2})([EW])(\d{3})", path.stem.upper())
    sizes = {2 * side * side: side for side in HGT_SIDES}
    size = path.stat().st_size
    if corner is None or size not in sizes:
        defect = f"{size:,} bytes" if corner else "no corner in its name"
        expected = " or ".join(f"{n:,}" for n in sizes)
        expected = f"a name such as N47E008.hgt and {expected} bytes"
        raise ValueError(f"{path.name}: found {defect}, expected {expected}; rename it or download it again")
    side = sizes[size]
    values = np.fromfile(path, ">i2").reshape(side, side).astype(np.float32)
    south = int(corner[2]) * (1 if corner[1] == "N" else -1)
    west = int(corner[4]) * (1 if corner[3] == "E" else -1)
    step = 1 / (side - 1)
    affine = np.array([[step, 0.0, west], [0.0, -step, south + 1.0]])
    return Raster(path.name, np.where(values == HGT_VOID, np.nan, values), affine)


def _split(text: str) -> tuple[Path, list[float]]:
    name, separator, numbers = text.rpartition("@")
    if not separator:
        return Path(text), []
    try:
        south, west, north, east = (float(x) for x in numbers.split(","))
    except ValueError:
        return Path(text), []  # the @ is part of the name
    if not (-90 <= south < north <= 90 and -180 <= west < east <= 180):
        raise ValueError(
            f"{name}: found bounds {numbers}, expected south,west,north,east in degrees; correct their order"
        )
    return Path(name), [south, west, north, east]


def _heights(image: Any) -> np.ndarray:
    if len(image.getbands()) != 1 or image.mode == "P":
        raise ValueError(f"terrain: found {image.mode} with {len(image.getbands())} bands, expected one band of metres")
    values = np.asarray(image).astype(np.float32)
    tags = getattr(image, "tag_v2", {})
    try:
        missing = float(str(tags.get(NO_DATA, "nan")).strip("\0 "))
    except ValueError:
        missing = np.nan
    invalid = (values == missing) | ~np.isfinite(values) | (np.abs(values) > 9_500)
    return np.where(invalid, np.nan, values)


def _bounded(bounds: list[float], image: Any) -> np.ndarray:
    south, west, north, east = bounds
    dx, dy = (east - west) / image.width, (south - north) / image.height
    return np.array([[dx, 0.0, west + dx / 2], [0.0, dy, north + dy / 2]])


def _georeference(path: Path, image: Any) -> tuple[np.ndarray, tuple[int, bool] | None]:
    """Return affine map and zone from the TIFF tags, else from a world file."""
    tags = dict(getattr(image, "tag_v2", {}))
    if KEYS in tags and (SCALE in tags or MATRIX in tags):
        return _tag_georeference(path.name, tags)
    for suffix in WORLD:
        if (world_file := path.with_suffix(suffix)).is_file():
            a, d, b, e, c, f = (float(x) for x in world_file.read_text(encoding="ascii").split()[:6])
            return np.array([[a, b, c], [d, e, f]]), None
    raise ValueError(f"{path.name}: found no georeference, expected a GeoTIFF or a world file; {REMEDY}")


def _tag_georeference(name: str, tags: dict[int, Any]) -> tuple[np.ndarray, tuple[int, bool] | None]:
    keys = np.array(tags[KEYS][4:], int)
    geo_keys = {int(k[0]): int(k[3]) for k in keys[: len(keys) // 4 * 4].reshape(-1, 4) if k[1] == 0}
    zone = _zone(name, geo_keys)
    if MATRIX in tags:
        matrix = np.array(tags[MATRIX], float).reshape(4, 4)[:2][:, [0, 1, 3]]
    else:
        (dx, dy), (i, j, _, x, y, _) = tags[SCALE][:2], tags[TIEPOINT][:6]
        matrix = np.array([[dx, 0.0, x - i * dx], [0.0, -dy, y + j * dy]], float)
    if geo_keys.get(RASTER_TYPE, 1) == 1:  # pixel corner to pixel centre
        matrix = matrix + np.outer(matrix[:, :2].sum(axis=1) / 2, [0, 0, 1])
    return matrix, zone


def _zone(name: str, geo_keys: dict[int, int]) -> tuple[int, bool] | None:
    if geo_keys.get(MODEL) == 2:
        return None
    code = geo_keys.get(PROJECTED, 0)
    for base, north in ((32600, True), (32700, False), (25800, True)):
        if base < code <= base + 60:
            return code - base, north
    raise ValueError(f"{name}: found projection EPSG:{code}, expected degrees or UTM on WGS 84; {REMEDY}")
