"""Terrain and imagery in the scene: one textured mesh and contours."""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from PIL import Image

from fleet.cli import check_file
from fleet.frames import to_geodetic
from viewer.scene.strokes import Strokes, chain
from viewer.store.place import UNIT_M, SceneFrame
from viewer.theme.palette import Palette, mix, rgb

_A, _F = 6_378_137.0, 1 / 298.257223563  # WGS 84: semi-major axis [m], flattening
_N = _F / (2 - _F)
_RADIUS = _A / (1 + _N) * (1 + _N**2 / 4 + _N**4 / 64)
_ALPHA = _N / 2 - 2 * _N**2 / 3 + 5 * _N**3 / 16, 13 * _N**2 / 48 - 3 * _N**3 / 5, 61 * _N**3 / 240
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


MAX_PIXELS = 80_000_000  # pixels of one file
SCALE, TIEPOINT, MATRIX, KEYS, NO_DATA = 33550, 33922, 34264, 34735, 42113  # TIFF tags
MODEL, RASTER_TYPE, PROJECTED = 1024, 1025, 3072  # keys in KEYS
WORLD = (".wld", ".pgw", ".pngw", ".jgw", ".tfw")
REMEDY = "convert it to EPSG:4326 (gdalwarp -t_srs EPSG:4326) or give its bounds: FILE@south,west,north,east"


class Raster(NamedTuple):
    """Georeferenced grid of heights or colours."""

    name: str
    values: np.ndarray  # (h, w) heights [m above mean sea level], NaN where unknown; or (h, w, 3) colours
    affine: np.ndarray  # (2, 3): column, row, 1 -> x, y of the pixel centre
    zone: tuple[int, bool] | None = None  # UTM zone and northern hemisphere; None: x, y in degrees

    def sample(self, lat_deg: np.ndarray, lon_deg: np.ndarray) -> np.ndarray:
        """Interpolate values at positions of any shape, NaN outside; colours have a last axis of 3."""
        from scipy.ndimage import map_coordinates  # deferred import: only needed with terrain

        lat, lon = np.asarray(lat_deg, float).ravel(), np.asarray(lon_deg, float).ravel()
        x, y = (lon, lat) if self.zone is None else to_utm(lat, lon, self.zone[0], north=self.zone[1])
        column, row = np.linalg.inv(self.affine[:, :2]) @ (np.stack([x, y]) - self.affine[:, 2:])
        outside = (column < -0.5) | (row < -0.5)
        outside |= (column > self.values.shape[1] - 0.5) | (row > self.values.shape[0] - 0.5)
        planes = self.values.reshape(*self.values.shape[:2], -1).astype(np.float32)
        at = [row, column]
        channels = [map_coordinates(plane, at, order=1, mode="nearest") for plane in np.moveaxis(planes, -1, 0)]
        values = np.where(outside[:, None], np.nan, np.stack(channels, axis=-1))
        return values.reshape((*np.shape(lat_deg), *self.values.shape[2:]))


def read_raster(text: str, *, colours: bool) -> Raster:
    """Read a raster file.

    Args:
        text: `FILE`, or `FILE@south,west,north,east` in degrees
        colours: True for imagery, False for heights in metres
    Raises:
        ValueError: when the file is invalid or not georeferenced; the message contains the remedy.
        OSError: when it cannot be opened.
    """
    path, bounds = _split(text)
    check_file("--imagery" if colours else "--terrain", path, "a raster file")
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


if TYPE_CHECKING:
    import trimesh

REACH_M = 15_000.0  # extent of the terrain from the scene origin [m]
CELLS, TEXELS = 160, 1_536  # mesh cells and texture pixels along one side
STEPS_M = (2, 5, 10, 20, 50, 100, 200, 500)  # contour intervals; the smallest with at most `MAX_CONTOURS` is used
MAX_CONTOURS = 24
SUN = np.array([-0.5, 0.6, 0.62])  # light direction for hill shading: north-west, as on maps
CONTOUR = {True: "#6B9A7E", False: "#7FA08C"}  # key: dark theme
IMAGERY_GAIN = {True: 0.65, False: 1.0}  # brightness of imagery; key: dark theme
LIGHT_GAIN = 0.45  # compensates the scene lights [-]


class HeightGrid(NamedTuple):
    """Height grid around the scene origin."""

    east: np.ndarray  # (n,) [10 m]
    north: np.ndarray  # (n,) [10 m]
    up: np.ndarray  # (n, n), rows towards north; NaN where unknown [10 m]


class TerrainLayer:
    """Terrain and imagery, computed once per scene frame and shown on every page."""

    def __init__(self, terrain: Raster | None, imagery: Raster | None) -> None:
        self._terrain, self._imagery = terrain, imagery
        self._scene_frame: SceneFrame | None = None
        self._grid: HeightGrid | None = None
        self._extent = np.zeros((2, 2))
        self._meshes: dict[bool, trimesh.Trimesh] = {}  # key: dark theme
        self._contours = np.zeros((0, 2, 3))
        self._shown_frames: dict[int, SceneFrame] = {}  # by client: scene frame of the shown terrain
        self.sentence = ""  # why nothing is shown; empty without an error

    @property
    def available(self) -> bool:
        """Return whether terrain is shown, so that the grid is hidden."""
        return self._grid is not None

    def reset_client(self, client: int) -> None:
        """Show the terrain again for a client whose scene was reset."""
        self._shown_frames.pop(client, None)

    def show(self, client: Any, scene_frame: SceneFrame | None, palette: Palette, ground: float) -> None:
        """Show the terrain on a page, once; `ground` is the height of imagery without terrain [10 m]."""
        if scene_frame is None or (self._terrain is None and self._imagery is None):
            return
        if scene_frame is not self._scene_frame:
            self._build(scene_frame, ground)
        if self._shown_frames.get(client.client_id) is scene_frame:
            return
        self._shown_frames[client.client_id] = scene_frame
        if self._grid is not None:
            if palette.dark not in self._meshes:
                self._meshes[palette.dark] = mesh(self._grid, self._picture(scene_frame, palette, self._grid))
            ground_mesh = self._meshes[palette.dark]
            client.scene.add_mesh_trimesh("/terrain/ground", ground_mesh, cast_shadow=False, receive_shadow=False)
        lines = Strokes(client.scene, "/terrain/contours", 1.2)
        lines.draw(self._contours, mix(CONTOUR[palette.dark], palette.ground, 0.9))

    def _build(self, scene_frame: SceneFrame, ground: float) -> None:
        self._scene_frame, self._grid, self._contours, self.sentence = scene_frame, None, np.zeros((0, 2, 3)), ""
        self._meshes.clear()
        names = " and ".join(raster.name for raster in (self._terrain, self._imagery) if raster is not None)
        extent = self._covered_extent(scene_frame)
        if extent is None:
            self.sentence = f"{names}: found no data within {REACH_M / 1000:.0f} km of the fleet; use other files."
            return
        self._extent, self._grid = np.array(extent), height_grid(self._terrain, scene_frame, extent, ground)
        self._contours = contours(self._grid) if self._terrain is not None else self._contours

    def _covered_extent(self, scene_frame: SceneFrame) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the covered extent near the origin: south-west and north-east corner, (2,) each [10 m]."""
        side = np.linspace(-REACH_M, REACH_M, 201) / UNIT_M
        raster = self._terrain if self._terrain is not None else self._imagery
        assert raster is not None
        values = raster.sample(*_degrees(scene_frame, *np.meshgrid(side, side)))
        finite = np.isfinite(values if values.ndim == 2 else values[..., 0])
        if not finite.any():
            return None
        rows, columns = side[finite.any(axis=1)], side[finite.any(axis=0)]
        return np.array([columns[0], rows[0]]), np.array([columns[-1], rows[-1]])

    def _picture(self, scene_frame: SceneFrame, palette: Palette, grid: HeightGrid) -> Image.Image:
        """Return the texture: imagery, or hill shading in the page colours."""
        (west, south), (east, north) = self._extent
        e, n = np.meshgrid(np.linspace(west, east, TEXELS), np.linspace(north, south, TEXELS))
        shading = Image.fromarray(shade(grid)[::-1].astype(np.float32))
        light = np.asarray(shading.resize((TEXELS, TEXELS), Image.Resampling.BICUBIC))[..., None]
        base_colour = rgb(palette.ground)
        if self._imagery is None:
            tint = 0.45 * rgb(palette.section) + 0.55 * base_colour
            colours = LIGHT_GAIN * tint * (0.55 + 0.9 * light)
        else:
            image = self._imagery.sample(*_degrees(scene_frame, e, n)) * LIGHT_GAIN * IMAGERY_GAIN[palette.dark]
            colours = image * (0.75 + 0.5 * light)
        colours = np.where(np.isfinite(colours), colours, LIGHT_GAIN * base_colour)
        return Image.fromarray(np.clip(colours, 0, 255).astype(np.uint8))


def _degrees(scene_frame: SceneFrame, east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    ned = np.stack([north, east, np.zeros_like(east)], axis=-1) * UNIT_M
    where = to_geodetic(scene_frame.origin, ned.reshape(-1, 3)).reshape(ned.shape)
    return where[..., 0] * 1e-7, where[..., 1] * 1e-7


def height_grid(
    terrain: Raster | None, scene_frame: SceneFrame, extent: tuple[np.ndarray, np.ndarray], ground: float
) -> HeightGrid:
    """Sample the heights; without terrain return a plane slightly below the ground."""
    (west, south), (east, north) = extent
    e, n = np.linspace(west, east, CELLS), np.linspace(south, north, CELLS)
    if terrain is None:
        return HeightGrid(e, n, np.full((CELLS, CELLS), ground - 0.1))
    heights = terrain.sample(*_degrees(scene_frame, *np.meshgrid(e, n)))
    return HeightGrid(e, n, (heights - scene_frame.origin.alt_mm * 1e-3) / UNIT_M)


def shade(grid: HeightGrid) -> np.ndarray:
    """Return the hill shading, about 0.5 on level ground, (n, n)."""
    up = np.where(np.isfinite(grid.up), grid.up, np.nanmin(grid.up))
    slope_n, slope_e = np.gradient(up, grid.north, grid.east)
    normal = np.stack([-2 * slope_e, -2 * slope_n, np.ones_like(up)], axis=-1)
    return np.clip(normal @ SUN / np.linalg.norm(normal, axis=-1), 0, 1) * 0.8


def contours(grid: HeightGrid) -> np.ndarray:
    """Return the contours at whole metres above mean sea level of the scene, (n, 2, 3) [10 m]."""
    import contourpy  # deferred import, as in `mesh`

    low, high = float(np.nanmin(grid.up)) * UNIT_M, float(np.nanmax(grid.up)) * UNIT_M
    step = next((s for s in STEPS_M if (high - low) / s <= MAX_CONTOURS), STEPS_M[-1])
    maker = contourpy.contour_generator(grid.east, grid.north, np.ma.masked_invalid(grid.up))
    segments = [np.zeros((0, 2, 3))]
    for level in np.arange(np.ceil(low / step), high / step) * step / UNIT_M:
        lines = [np.asarray(line, float) for line in maker.lines(float(level))]
        segments += [chain(np.column_stack([line, np.full(len(line), level + 0.05)])) for line in lines]
    return np.concatenate(segments)


def mesh(grid: HeightGrid, picture: Image.Image) -> "trimesh.Trimesh":
    """Return the textured mesh, with holes where heights are unknown."""
    import trimesh  # deferred import: most pages show no terrain

    east, north = np.meshgrid(grid.east, grid.north)
    finite = np.isfinite(grid.up).ravel()
    vertices = np.column_stack([east.ravel(), north.ravel(), np.where(finite, grid.up.ravel(), 0.0)])
    rows, columns = grid.up.shape
    k = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    faces = np.concatenate([np.stack([k, k + 1, k + columns], -1), np.stack([k + 1, k + columns + 1, k + columns], -1)])
    faces = faces[finite[faces].all(axis=1)]
    u, v = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=picture, metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True
    )
    visual = trimesh.visual.TextureVisuals(uv=np.column_stack([u.ravel(), v.ravel()]), material=material)
    return trimesh.Trimesh(vertices, faces, visual=visual, process=False)
