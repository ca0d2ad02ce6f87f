"""Terrain and imagery in the scene: one textured mesh and contours."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from PIL import Image

from fleet.frames import to_geodetic
from viewer.scene.strokes import Strokes, chain
from viewer.scene.terrain.raster import Raster
from viewer.store.place import UNIT_M, Place
from viewer.theme.palette import Palette, mix, rgb

if TYPE_CHECKING:
    import trimesh

REACH_M = 15_000.0  # extent of the terrain from the scene origin [m]
CELLS, TEXELS = 160, 1_536  # mesh cells and texture pixels along one side
STEPS_M = (2, 5, 10, 20, 50, 100, 200, 500)  # contour intervals; the smallest with at most `MAX_CONTOURS` is used
MOST_CONTOURS = 24
SUN = np.array([-0.5, 0.6, 0.62])  # light direction for hill shading: north-west, as on maps
CONTOUR = {True: "#6B9A7E", False: "#7FA08C"}  # key: dark theme
DIM = {True: 0.65, False: 1.0}  # brightness of imagery; key: dark theme
LIT = 0.45  # compensates the scene lights [-]


class Shape(NamedTuple):
    """Height grid around the scene origin."""

    east: np.ndarray  # (n,) [10 m]
    north: np.ndarray  # (n,) [10 m]
    up: np.ndarray  # (n, n), rows towards north; NaN where unknown [10 m]


class Land:
    """Terrain and imagery, computed once per scene frame and shown on every page."""

    def __init__(self, terrain: Raster | None, imagery: Raster | None) -> None:
        self._terrain, self._imagery = terrain, imagery
        self._place: Place | None = None
        self._form: Shape | None = None
        self._extent = np.zeros((2, 2))
        self._meshes: dict[bool, trimesh.Trimesh] = {}  # key: dark theme
        self._contours = np.zeros((0, 2, 3))
        self._shown: dict[int, Place] = {}  # by client: scene frame of the shown terrain
        self.sentence = ""  # why nothing is shown; empty without an error

    @property
    def lies(self) -> bool:
        """Return whether terrain is shown, so that the grid is hidden."""
        return self._form is not None

    def forget(self, client: int) -> None:
        """Show the terrain again for a client whose scene was reset."""
        self._shown.pop(client, None)

    def show(self, client: Any, place: Place | None, palette: Palette, ground: float) -> None:
        """Show the terrain on a page, once; `ground` is the height of imagery without terrain [10 m]."""
        if place is None or (self._terrain is None and self._imagery is None):
            return
        if place is not self._place:
            self._lay(place, ground)
        if self._shown.get(client.client_id) is place:
            return
        self._shown[client.client_id] = place
        if self._form is not None:
            if palette.dark not in self._meshes:
                self._meshes[palette.dark] = mesh(self._form, self._picture(place, palette, self._form))
            made = self._meshes[palette.dark]
            client.scene.add_mesh_trimesh("/terrain/ground", made, cast_shadow=False, receive_shadow=False)
        lines = Strokes(client.scene, "/terrain/contours", 1.2)
        lines.draw(self._contours, mix(CONTOUR[palette.dark], palette.ground, 0.9))

    def _lay(self, place: Place, ground: float) -> None:
        self._place, self._form, self._contours, self.sentence = place, None, np.zeros((0, 2, 3)), ""
        self._meshes.clear()
        names = " and ".join(raster.name for raster in (self._terrain, self._imagery) if raster is not None)
        extent = self._covered(place)
        if extent is None:
            self.sentence = f"{names}: found no data within {REACH_M / 1000:.0f} km of the fleet; use other files."
            return
        self._extent, self._form = np.array(extent), shape(self._terrain, place, extent, ground)
        self._contours = contours(self._form) if self._terrain is not None else self._contours

    def _covered(self, place: Place) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the covered extent near the origin: south-west and north-east corner, (2,) each [10 m]."""
        side = np.linspace(-REACH_M, REACH_M, 201) / UNIT_M
        raster = self._terrain if self._terrain is not None else self._imagery
        assert raster is not None
        found = raster.at(*_degrees(place, *np.meshgrid(side, side)))
        known = np.isfinite(found if found.ndim == 2 else found[..., 0])
        if not known.any():
            return None
        rows, columns = side[known.any(axis=1)], side[known.any(axis=0)]
        return np.array([columns[0], rows[0]]), np.array([columns[-1], rows[-1]])

    def _picture(self, place: Place, palette: Palette, form: Shape) -> Image.Image:
        """Return the texture: imagery, or hill shading in the page colours."""
        (west, south), (east, north) = self._extent
        e, n = np.meshgrid(np.linspace(west, east, TEXELS), np.linspace(north, south, TEXELS))
        plain = rgb(palette.ground)
        light = shade(form)[::-1]
        scaled = np.asarray(
            Image.fromarray(light.astype(np.float32)).resize((TEXELS, TEXELS), Image.Resampling.BICUBIC)
        )
        if self._imagery is None:
            tint = 0.45 * rgb(palette.section) + 0.55 * plain
            return Image.fromarray(np.clip(LIT * tint * (0.55 + 0.9 * scaled[..., None]), 0, 255).astype(np.uint8))
        found = self._imagery.at(*_degrees(place, e, n)) * LIT * DIM[palette.dark] * (0.75 + 0.5 * scaled[..., None])
        return Image.fromarray(np.clip(np.where(np.isfinite(found), found, LIT * plain), 0, 255).astype(np.uint8))


def _degrees(place: Place, east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    ned = np.stack([north, east, np.zeros_like(east)], axis=-1) * UNIT_M
    where = to_geodetic(place.origin, ned.reshape(-1, 3)).reshape(ned.shape)
    return where[..., 0] * 1e-7, where[..., 1] * 1e-7


def shape(terrain: Raster | None, place: Place, extent: tuple[np.ndarray, np.ndarray], ground: float) -> Shape:
    """Sample the heights; without terrain return a plane slightly below the ground."""
    (west, south), (east, north) = extent
    e, n = np.linspace(west, east, CELLS), np.linspace(south, north, CELLS)
    if terrain is None:
        return Shape(e, n, np.full((CELLS, CELLS), ground - 0.1))
    heights = terrain.at(*_degrees(place, *np.meshgrid(e, n)))
    return Shape(e, n, (heights - place.origin.alt_mm * 1e-3) / UNIT_M)


def shade(form: Shape) -> np.ndarray:
    """Return the hill shading, about 0.5 on level ground, (n, n)."""
    up = np.where(np.isfinite(form.up), form.up, np.nanmin(form.up))
    slope_n, slope_e = np.gradient(up, form.north, form.east)
    normal = np.stack([-2 * slope_e, -2 * slope_n, np.ones_like(up)], axis=-1)
    return np.clip(normal @ SUN / np.linalg.norm(normal, axis=-1), 0, 1) * 0.8


def contours(form: Shape) -> np.ndarray:
    """Return the contours at whole metres above mean sea level of the scene, (n, 2, 3) [10 m]."""
    import contourpy  # deferred import, as in `mesh`

    low, high = float(np.nanmin(form.up)) * UNIT_M, float(np.nanmax(form.up)) * UNIT_M
    step = next((s for s in STEPS_M if (high - low) / s <= MOST_CONTOURS), STEPS_M[-1])
    maker = contourpy.contour_generator(form.east, form.north, np.ma.masked_invalid(form.up))
    found = [np.zeros((0, 2, 3))]
    for level in np.arange(np.ceil(low / step), high / step) * step / UNIT_M:
        for line in maker.lines(float(level)):
            flat = np.asarray(line, float)
            points = np.column_stack([flat, np.full(len(flat), level + 0.05)])
            found.append(chain(points))
    return np.concatenate(found)


def mesh(form: Shape, picture: Image.Image) -> "trimesh.Trimesh":
    """Return the textured mesh, with holes where heights are unknown."""
    import trimesh  # deferred import: most pages show no terrain

    east, north = np.meshgrid(form.east, form.north)
    known = np.isfinite(form.up).ravel()
    vertices = np.column_stack([east.ravel(), north.ravel(), np.where(known, form.up.ravel(), 0.0)])
    rows, columns = form.up.shape
    k = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    faces = np.concatenate([np.stack([k, k + 1, k + columns], -1), np.stack([k + 1, k + columns + 1, k + columns], -1)])
    faces = faces[known[faces].all(axis=1)]
    u, v = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=picture, metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True
    )
    visual = trimesh.visual.TextureVisuals(uv=np.column_stack([u.ravel(), v.ravel()]), material=material)
    return trimesh.Trimesh(vertices, faces, visual=visual, process=False)
