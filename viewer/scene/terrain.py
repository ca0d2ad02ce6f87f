"""Terrain and imagery in the scene: one textured mesh, contours, coast and borders."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from PIL import Image

from fleet.frames import to_geodetic
from fleet.terrain.raster import Raster
from viewer.scene.map.tiles import Mosaic, TileMap
from viewer.scene.map.world import ground_lines
from viewer.scene.strokes import Strokes, chain
from viewer.store.place import UNIT_M, SceneFrame
from viewer.theme.palette import Palette, mix, rgb

if TYPE_CHECKING:
    import trimesh

REACH_M = 15_000.0  # extent of the terrain from the scene origin [m]
CELLS, TEXELS, IMAGE_TEXELS = 160, 1_536, 2_048  # mesh cells and pixels of hill shading and imagery along one side
NEAR_M = 1_000.0  # within this distance of the origin cells and pixels have about equal sizes, beyond it they grow [m]
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

    def __init__(self, terrain: Raster | None, imagery: Raster | None, tiles: TileMap | None = None) -> None:
        self._terrain, self._imagery, self._tiles = terrain, imagery, tiles
        self._colour_layers: list[Raster | Mosaic] = []  # the lower first
        self._scene_frame: SceneFrame | None = None
        self._grid: HeightGrid | None = None
        self._extent = np.zeros((2, 2))
        self._meshes: dict[bool, trimesh.Trimesh] = {}  # key: dark theme
        self._contours = np.zeros((0, 2, 3))
        self._world = np.zeros((0, 2, 3)), np.zeros((0, 2, 3))  # coast and borders
        self._shown_frames: dict[int, SceneFrame] = {}  # by client: scene frame of the shown terrain
        self._world_lines: dict[int, Strokes] = {}  # by client
        self.sentence = ""  # what is missing, and why; empty without an error

    @property
    def available(self) -> bool:
        """Return whether terrain is shown, so that the grid is hidden."""
        return self._grid is not None

    def reset_client(self, client: int) -> None:
        """Show the terrain again for a client whose scene was reset; forget one that departed."""
        self._shown_frames.pop(client, None)
        self._world_lines.pop(client, None)

    def show(self, client: Any, scene_frame: SceneFrame | None, palette: Palette, ground: float) -> None:
        """Show the map on a page, once; `ground` is the height of imagery without terrain [10 m]."""
        if scene_frame is None:
            return
        if scene_frame is not self._scene_frame:
            self._build(scene_frame, ground)
        if self._shown_frames.get(client.client_id) is scene_frame:
            return
        if client.client_id in self._shown_frames:  # of another origin, which may have had a map
            for name in ("/terrain/ground", "/terrain/contours", "/terrain/world", "/env/world"):
                client.scene.remove_by_name(name)
        self._shown_frames[client.client_id] = scene_frame
        if self._grid is not None:
            if palette.dark not in self._meshes:
                self._meshes[palette.dark] = mesh(self._grid, self._picture(scene_frame, palette, self._grid))
            ground_mesh = self._meshes[palette.dark]
            client.scene.add_mesh_trimesh("/terrain/ground", ground_mesh, cast_shadow=False, receive_shadow=False)
            lines = Strokes(client.scene, "/terrain/contours", 1.2)
            lines.draw(self._contours, mix(CONTOUR[palette.dark], palette.ground, 0.9))
        # a child of the ground grid, whose height follows the estimate; on terrain at the height of the terrain
        world = Strokes(client.scene, "/terrain/world" if self.available else "/env/world", 1.6)
        coast, borders = self._world
        world.draw_parts([(coast, rgb(palette.coast)), (borders[::2], rgb(palette.border))])
        self._world_lines[client.client_id] = world

    def show_world(self, client: int, visible: bool) -> None:
        """Show or hide coast and borders on the page of a client."""
        if (lines := self._world_lines.get(client)) is not None:
            lines.show(visible)

    def heights(self, points: np.ndarray) -> np.ndarray:
        """Return the height of the terrain under scene points (n, 2 or 3) ENU [10 m]: (n,) [10 m], NaN if unknown."""
        if self._terrain is None or self._scene_frame is None:
            return np.full(len(points), np.nan)
        heights = self._terrain.sample(*_degrees(self._scene_frame, points[:, 0], points[:, 1]))
        return (heights - self._scene_frame.origin.alt_mm * 1e-3) / UNIT_M

    def _build(self, scene_frame: SceneFrame, ground: float) -> None:
        self._scene_frame, self._grid, self._contours, self.sentence = scene_frame, None, np.zeros((0, 2, 3)), ""
        self._meshes.clear()
        self._colour_layers = [self._imagery] if self._imagery is not None else []
        if self._tiles is not None:
            self._read_tiles(self._tiles, scene_frame)
        if self._terrain is not None or self._colour_layers:
            self._build_grid(scene_frame, ground)
        self._world = self._draped_world(scene_frame)

    def _read_tiles(self, tiles: TileMap, scene_frame: SceneFrame) -> None:
        """Put the tiles around the origin below the imagery; a damaged archive is reported on the page."""
        try:
            mosaic = tiles.around(scene_frame.origin.lat_e7 * 1e-7, scene_frame.origin.lon_e7 * 1e-7)
        except ValueError as error:
            self.sentence = str(error)
            return
        if mosaic.damaged:
            damage = f"found {mosaic.damaged} damaged tiles of {mosaic.tiles} near the fleet, expected images"
            self.sentence = f"{tiles.name}: {damage}; download it again."
        elif not mosaic.tiles:
            self.sentence = (
                f"{tiles.name}: found no tiles within {REACH_M / 1000:.0f} km of the fleet; use another file."
            )
        if mosaic.levels:
            self._colour_layers.insert(0, mosaic)

    def _build_grid(self, scene_frame: SceneFrame, ground: float) -> None:
        """Compute grid and contours from the files."""
        extent = self._covered_extent(scene_frame)
        if extent is None:
            names = " and ".join(raster.name for raster in (self._terrain, self._imagery) if raster is not None)
            self.sentence = f"{names}: found no data within {REACH_M / 1000:.0f} km of the fleet; use other files."
            return
        self._extent, self._grid = np.array(extent), height_grid(self._terrain, scene_frame, extent, ground)
        self._contours = contours(self._grid) if self._terrain is not None else self._contours

    def _draped_world(self, scene_frame: SceneFrame) -> tuple[np.ndarray, np.ndarray]:
        """Return coast and borders: at height 0 of the ground grid, or on the terrain."""
        coast, borders = ground_lines(scene_frame)
        if self._grid is None:
            return coast, borders
        lowest = float(np.nanmin(self._grid.up))
        for lines in (coast, borders):
            heights = self.heights(lines.reshape(-1, 3)).reshape(lines.shape[:2])
            lines[..., 2] = np.where(np.isfinite(heights), heights, lowest) + 0.1
        return coast, borders

    def _colours(self, scene_frame: SceneFrame, east: np.ndarray, north: np.ndarray) -> np.ndarray:
        """Return the imagery at scene points of any shape: (..., 3) [0..255], NaN where there is none."""
        where = _degrees(scene_frame, east, north)
        colours = np.full((*east.shape, 3), np.nan, np.float32)
        for layer in self._colour_layers:
            values = layer.sample(*where)
            colours = np.where(np.isfinite(values), values, colours)
        return colours

    def _covered_extent(self, scene_frame: SceneFrame) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the covered extent near the origin: south-west and north-east corner, (2,) each [10 m]."""
        side = np.linspace(-REACH_M, REACH_M, 201) / UNIT_M
        points = np.meshgrid(side, side)
        if self._terrain is not None:
            finite = np.isfinite(self._terrain.sample(*_degrees(scene_frame, *points)))
        else:
            finite = np.isfinite(self._colours(scene_frame, *points)[..., 0])
        if not finite.any():
            return None
        rows, columns = side[finite.any(axis=1)], side[finite.any(axis=0)]
        return np.array([columns[0], rows[0]]), np.array([columns[-1], rows[-1]])

    def _picture(self, scene_frame: SceneFrame, palette: Palette, grid: HeightGrid) -> Image.Image:
        """Return the texture: imagery, or hill shading in the page colours."""
        (west, south), (east, north) = self._extent
        side = IMAGE_TEXELS if self._colour_layers else TEXELS
        e, n = np.meshgrid(spread(west, east, side), spread(south, north, side)[::-1])
        shading = Image.fromarray(shade(grid)[::-1].astype(np.float32))
        light = np.asarray(shading.resize((side, side), Image.Resampling.BICUBIC))[..., None]
        base_colour = rgb(palette.ground)
        if not self._colour_layers:
            tint = 0.45 * rgb(palette.section) + 0.55 * base_colour
            colours = LIGHT_GAIN * tint * (0.55 + 0.9 * light)
        else:
            image = self._colours(scene_frame, e, n) * LIGHT_GAIN * IMAGERY_GAIN[palette.dark]
            colours = image * (0.75 + 0.5 * light)
        colours = np.where(np.isfinite(colours), colours, LIGHT_GAIN * base_colour)
        return Image.fromarray(np.clip(colours, 0, 255).astype(np.uint8))


def _degrees(scene_frame: SceneFrame, east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    ned = np.stack([north, east, np.zeros_like(east)], axis=-1) * UNIT_M
    where = to_geodetic(scene_frame.origin, ned.reshape(-1, 3)).reshape(ned.shape)
    return where[..., 0] * 1e-7, where[..., 1] * 1e-7


def spread(low: float, high: float, n: int) -> np.ndarray:
    """Return n coordinates from `low` to `high` [10 m], dense near the origin: equal steps of asinh(x / `NEAR_M`)."""
    near = NEAR_M / UNIT_M
    return near * np.sinh(np.linspace(np.arcsinh(low / near), np.arcsinh(high / near), n))


def height_grid(
    terrain: Raster | None, scene_frame: SceneFrame, extent: tuple[np.ndarray, np.ndarray], ground: float
) -> HeightGrid:
    """Sample the heights; without terrain return a plane slightly below the ground."""
    (west, south), (east, north) = extent
    e, n = spread(west, east, CELLS), spread(south, north, CELLS)
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
