"""Aircraft of one page: one mesh batch per shape, scaled to the camera distance."""

from collections.abc import Callable
from typing import Any

import numpy as np

from viewer.scene.fleet_arrays import LOST, MISMATCH, Flock
from viewer.scene.labels import Sight
from viewer.theme.palette import Palette, mesh_colour, rgb
from viewer.theme.shapes import aircraft, dart, rotorcraft

SHARE, LEAST_SHARE = 0.042, 0.016  # share of the image height that an aircraft spans at its centre [-]
FEW = 60  # visible aircraft up to which they have that size; more are drawn smaller
NEARNESS = 0.5  # 1: same apparent size at any distance; 0: perspective [-]
EXCEPTION, CHOSEN = 1.7, 1.25  # scale of exceptional UAVs in a large fleet, and of the selected UAV
QUIET = 0.62  # large fleet: colour share of nominal UAVs, the rest is ground colour [-]


class Glyphs:
    """One batch per shape, rebuilt when its UAVs change."""

    def __init__(self, scene: Any, palette: Palette, clicked: Callable[[int], None]) -> None:
        self._scene, self._palette, self._clicked = scene, palette, clicked
        self._colours = np.array([rgb(colour) for colour in palette.looks()])
        self._batches: list[tuple[Any, np.ndarray]] = []  # batch and the fleet rows it shows
        self._known: tuple[int, int, bool] = (-1, -1, False)
        self._looks = np.zeros(0, int)
        self.unit = 1.0  # drawn span of an aircraft at the centre of the image [10 m]

    def draw(self, flock: Flock) -> None:
        """Update positions and orientations; call it at the full rate."""
        members = (hash(flock.uavs), hash(flock.hover.tobytes()), flock.crowd)
        if members != self._known:
            self._make(flock)
            self._known = members
        for batch, rows in self._batches:
            batch.batched_positions = flock.at[rows]
            batch.batched_wxyzs = flock.quat[rows]

    def look(self, flock: Flock, sight: Sight, *, selected: int | None, size: float) -> None:
        """Update colours and sizes; call it a few times per second.

        Args:
            fleet_arrays: drawn UAVs
            camera_view: view of the camera
            selected: selected UAV of this page
            size: scale set by the operator, 1 is the default [-]
        """
        if not self._batches or not len(flock.looks):
            return
        middle = float(np.linalg.norm(sight.look_at - sight.eye)) or 1.0
        spots, depth = sight.project(flock.at)
        seen = int(((depth > 0) & (np.abs(spots) < [sight.aspect / 2, 0.5]).all(axis=1)).sum())
        self.unit = size * middle * max(SHARE * min(1.0, FEW / max(seen, 1)) ** 0.5, LEAST_SHARE)
        away = np.linalg.norm(flock.at - sight.eye, axis=1) / middle
        scale = self.unit * np.clip(away, 0.05, 20.0) ** NEARNESS
        if flock.crowd:
            scale = np.where(flock.exceptions, EXCEPTION * scale, scale)
        if (chosen := flock.index(selected)) is not None:
            scale[chosen] *= CHOSEN
        for batch, rows in self._batches:
            batch.batched_scales = scale[rows].astype(np.float32)
        if not np.array_equal(flock.looks, self._looks):
            self._looks = flock.looks.copy()
            colours = self.colours(flock)
            for batch, rows in self._batches:
                batch.batched_colors = mesh_colour(colours[rows] * 0.85)

    def colours(self, flock: Flock) -> np.ndarray:
        """Return the colours, (n, 3) [0..255]; in a large fleet nominal UAVs are muted."""
        colours = self._colours[flock.looks]
        if not flock.crowd:
            return colours
        quiet = ~np.isin(flock.looks, (MISMATCH, LOST))[:, None]
        return np.where(quiet, QUIET * colours + (1 - QUIET) * rgb(self._palette.ground), colours)

    def _make(self, flock: Flock) -> None:
        for batch, _ in self._batches:
            batch.remove()
        fixed, rotors = np.flatnonzero(~flock.hover), np.flatnonzero(flock.hover)
        wings = dart() if flock.crowd else aircraft()
        made = [("/fleet/vehicles", fixed, wings), ("/fleet/rotors", rotors, rotorcraft())]
        self._looks = np.zeros(0, int)
        self._batches = [(self._batch(name, flock, rows, shape), rows) for name, rows, shape in made if len(rows)]

    def _batch(self, name: str, flock: Flock, rows: np.ndarray, shape: tuple[np.ndarray, np.ndarray]) -> Any:
        uavs = [flock.uavs[row] for row in rows]
        batch = self._scene.add_batched_meshes_simple(
            name,
            *shape,
            flock.quat[rows],
            flock.at[rows],
            batched_scales=np.full(len(rows), self.unit, np.float32),
            batched_colors=mesh_colour(self.colours(flock)[rows] * 0.85),
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
            flat_shading=True,
        )
        batch.on_click(lambda event: self._click(uavs, event.instance_index))
        return batch

    def _click(self, uavs: list[int], index: int | None) -> None:
        if index is not None and 0 <= index < len(uavs):
            self._clicked(uavs[index])
