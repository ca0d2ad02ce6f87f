"""Aircraft of one page: one mesh batch per shape, scaled to the camera distance."""

from collections.abc import Callable
from typing import Any

import numpy as np

from viewer.scene.fleet_arrays import LOST, MISMATCH, FleetArrays
from viewer.scene.labels import CameraView
from viewer.theme.palette import Palette, mesh_colour, rgb
from viewer.theme.shapes import aircraft, dart, rotorcraft

SPAN_SHARE, MIN_SPAN_SHARE = 0.042, 0.016  # share of the image height that an aircraft spans at its centre [-]
LARGE_GLYPH_COUNT = 60  # visible aircraft up to which they have that size; more are drawn smaller
DISTANCE_EXPONENT = 0.5  # 1: same apparent size at any distance; 0: perspective [-]
EXCEPTION_SCALE, SELECTED_SCALE = 1.7, 1.25  # scale of exceptional UAVs in a large fleet, and of the selected UAV
MUTED_SHARE = 0.62  # large fleet: colour share of nominal UAVs, the rest is ground colour [-]


class Glyphs:
    """One batch per shape, rebuilt when its UAVs change."""

    def __init__(self, scene: Any, palette: Palette, on_click: Callable[[int], None]) -> None:
        self._scene, self._palette, self._on_click = scene, palette, on_click
        self._colours = np.array([rgb(colour) for colour in palette.status_colours()])
        self._batches: list[tuple[Any, np.ndarray]] = []  # batch and the fleet rows it shows
        self._members: tuple[int, int, bool] = (-1, -1, False)
        self._statuses = np.zeros(0, int)
        self.unit = 1.0  # drawn span of an aircraft at the centre of the image [10 m]

    def draw(self, fleet_arrays: FleetArrays) -> None:
        """Update positions and orientations; call it at the full rate."""
        members = (hash(fleet_arrays.uavs), hash(fleet_arrays.has_rotors.tobytes()), fleet_arrays.large_fleet)
        if members != self._members:
            self._rebuild(fleet_arrays)
            self._members = members
        for batch, rows in self._batches:
            batch.batched_positions = fleet_arrays.at[rows]
            batch.batched_wxyzs = fleet_arrays.quat[rows]

    def update_appearance(
        self, fleet_arrays: FleetArrays, camera_view: CameraView, *, selected: int | None, size: float
    ) -> None:
        """Update colours and sizes; call it a few times per second.

        Args:
            fleet_arrays: drawn UAVs
            camera_view: view of the camera
            selected: selected UAV of this page
            size: scale set by the operator, 1 is the default [-]
        """
        if not self._batches or not len(fleet_arrays.statuses):
            return
        focus_distance = float(np.linalg.norm(camera_view.look_at - camera_view.position)) or 1.0
        points, depth = camera_view.project(fleet_arrays.at)
        visible_count = int(((depth > 0) & (np.abs(points) < [camera_view.aspect / 2, 0.5]).all(axis=1)).sum())
        self.unit = (
            size
            * focus_distance
            * max(SPAN_SHARE * min(1.0, LARGE_GLYPH_COUNT / max(visible_count, 1)) ** 0.5, MIN_SPAN_SHARE)
        )
        relative_distance = np.linalg.norm(fleet_arrays.at - camera_view.position, axis=1) / focus_distance
        scale = self.unit * np.clip(relative_distance, 0.05, 20.0) ** DISTANCE_EXPONENT
        if fleet_arrays.large_fleet:
            scale = np.where(fleet_arrays.exceptions, EXCEPTION_SCALE * scale, scale)
        if (row := fleet_arrays.index(selected)) is not None:
            scale[row] *= SELECTED_SCALE
        for batch, batch_rows in self._batches:
            batch.batched_scales = scale[batch_rows].astype(np.float32)
        if not np.array_equal(fleet_arrays.statuses, self._statuses):
            self._statuses = fleet_arrays.statuses.copy()
            colours = self.colours(fleet_arrays)
            for batch, batch_rows in self._batches:
                batch.batched_colors = mesh_colour(colours[batch_rows] * 0.85)

    def colours(self, fleet_arrays: FleetArrays) -> np.ndarray:
        """Return the colours, (n, 3) [0..255]; in a large fleet nominal UAVs are muted."""
        colours = self._colours[fleet_arrays.statuses]
        if not fleet_arrays.large_fleet:
            return colours
        is_normal = ~np.isin(fleet_arrays.statuses, (MISMATCH, LOST))[:, None]
        return np.where(is_normal, MUTED_SHARE * colours + (1 - MUTED_SHARE) * rgb(self._palette.ground), colours)

    def _rebuild(self, fleet_arrays: FleetArrays) -> None:
        for batch, _ in self._batches:
            batch.remove()
        fixed, rotors = np.flatnonzero(~fleet_arrays.has_rotors), np.flatnonzero(fleet_arrays.has_rotors)
        wings = dart() if fleet_arrays.large_fleet else aircraft()
        specifications = [("/fleet/vehicles", fixed, wings), ("/fleet/rotors", rotors, rotorcraft())]
        self._statuses = np.zeros(0, int)
        self._batches = [
            (self._batch(name, fleet_arrays, rows, shape), rows) for name, rows, shape in specifications if len(rows)
        ]

    def _batch(
        self, name: str, fleet_arrays: FleetArrays, rows: np.ndarray, shape: tuple[np.ndarray, np.ndarray]
    ) -> Any:
        uavs = [fleet_arrays.uavs[row] for row in rows]
        batch = self._scene.add_batched_meshes_simple(
            name,
            *shape,
            fleet_arrays.quat[rows],
            fleet_arrays.at[rows],
            batched_scales=np.full(len(rows), self.unit, np.float32),
            batched_colors=mesh_colour(self.colours(fleet_arrays)[rows] * 0.85),
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
            flat_shading=True,
        )
        batch.on_click(lambda event: self._click(uavs, event.instance_index))
        return batch

    def _click(self, uavs: list[int], index: int | None) -> None:
        if index is not None and 0 <= index < len(uavs):
            self._on_click(uavs[index])
