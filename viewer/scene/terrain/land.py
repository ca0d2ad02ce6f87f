"""Terrain and imagery in the scene: one textured mesh and contours."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from PIL import Image

from fleet.frames import to_geodetic
from viewer.scene.strokes import Strokes, chain
from viewer.scene.terrain.raster import Raster
from viewer.store.place import UNIT_M, SceneFrame
from viewer.theme.palette import Palette, mix, rgb

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
        base_colour = rgb(palette.ground)
        light = shade(grid)[::-1]
        scaled = np.asarray(
            Image.fromarray(light.astype(np.float32)).resize((TEXELS, TEXELS), Image.Resampling.BICUBIC)
        )
        if self._imagery is None:
            tint = 0.45 * rgb(palette.section) + 0.55 * base_colour
            return Image.fromarray(
                np.clip(LIGHT_GAIN * tint * (0.55 + 0.9 * scaled[..., None]), 0, 255).astype(np.uint8)
            )
        colours = (
            self._imagery.sample(*_degrees(scene_frame, e, n))
            * LIGHT_GAIN
            * IMAGERY_GAIN[palette.dark]
            * (0.75 + 0.5 * scaled[..., None])
        )
        return Image.fromarray(
            np.clip(np.where(np.isfinite(colours), colours, LIGHT_GAIN * base_colour), 0, 255).astype(np.uint8)
        )


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
        for line in maker.lines(float(level)):
            flat = np.asarray(line, float)
            points = np.column_stack([flat, np.full(len(flat), level + 0.05)])
            segments.append(chain(points))
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
