"""Fleet in 3-D on one page: about fifteen nodes, independent of its size; aircraft glyphs."""

from collections.abc import Callable
from typing import Any

import numpy as np

from fleet.contract import Item
from fleet.terrain.areas import Area, read_fence_items
from viewer.scene.fleet_arrays import CHUNKS, LOST, MISMATCH, STEPS, FleetArrays
from viewer.scene.ground import GroundGrid
from viewer.scene.labels import CameraView
from viewer.scene.routes import NOTHING, Heights, RouteLines, area_lines
from viewer.scene.strokes import Strokes, chain, circle, dash_lines, faded, smooth_curve
from viewer.store.place import SceneFrame
from viewer.store.vehicle import Vehicle
from viewer.theme.palette import Palette, mesh_colour, mix, rgb
from viewer.theme.shapes import aircraft, dart, rotorcraft

SPAN_SHARE, MIN_SPAN_SHARE = 0.042, 0.016  # share of the image height that an aircraft spans at its centre [-]
LARGE_GLYPH_COUNT = 80  # aircraft up to which they have that size in a square image; more are drawn smaller
DISTANCE_EXPONENT = 0.5  # 1: same apparent size at any distance; 0: perspective [-]
EXCEPTION_SCALE, SELECTED_SCALE = 1.7, 1.25  # scale of exceptional UAVs in a large fleet, and of the selected UAV
MUTED_SHARE = 0.62  # large fleet: colour share of nominal UAVs, the rest is ground colour [-]


class Glyphs:
    """One batch per shape, rebuilt when its UAVs change."""

    def __init__(self, scene: Any, palette: Palette, on_click: Callable[[int], None]) -> None:
        self._scene, self._palette, self._on_click = scene, palette, on_click
        self._colours = palette.status_colours()
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
        """Update colours and sizes, a few times per second; `size` is the operator's scale, 1 is the default [-]."""
        if not self._batches or not len(fleet_arrays.statuses):
            return
        focus_distance = float(np.linalg.norm(camera_view.look_at - camera_view.position)) or 1.0
        points, depth = camera_view.project(fleet_arrays.at)
        visible_count = int(((depth > 0) & (np.abs(points) < [camera_view.aspect / 2, 0.5]).all(axis=1)).sum())
        covered = (camera_view.top_px + camera_view.bottom_px) / camera_view.height_px
        room = LARGE_GLYPH_COUNT * min(camera_view.aspect, 1.0) * (1.0 - min(covered, 0.9))
        share = SPAN_SHARE * min(1.0, room / max(visible_count, 1)) ** 0.5
        self.unit = size * focus_distance * max(share, MIN_SPAN_SHARE)
        relative_distance = np.linalg.norm(fleet_arrays.at - camera_view.position, axis=1) / focus_distance
        scale = self.unit * np.clip(relative_distance, 0.05, 20.0) ** DISTANCE_EXPONENT
        if fleet_arrays.large_fleet:
            scale = np.where(fleet_arrays.exceptions, EXCEPTION_SCALE * scale, scale)
        if (row := fleet_arrays.index(selected)) is not None:
            scale[row] *= SELECTED_SCALE
        recoloured = not np.array_equal(fleet_arrays.statuses, self._statuses)
        self._statuses = fleet_arrays.statuses.copy()
        for batch, rows in self._batches:
            batch.batched_scales = scale[rows].astype(np.float32)
            if recoloured:
                batch.batched_colors = mesh_colour(self.colours(fleet_arrays)[rows] * 0.85)

    def colours(self, fleet_arrays: FleetArrays) -> np.ndarray:
        """Return the colours, (n, 3) [0..255]; in a large fleet nominal UAVs are muted."""
        colours = self._colours[fleet_arrays.statuses]
        if not fleet_arrays.large_fleet:
            return colours
        muted = MUTED_SHARE * colours + (1 - MUTED_SHARE) * rgb(self._palette.ground)
        return np.where(fleet_arrays.exceptions[:, None], colours, muted)

    def _rebuild(self, fleet_arrays: FleetArrays) -> None:
        for batch, _ in self._batches:
            batch.remove()
        fixed, rotors = np.flatnonzero(~fleet_arrays.has_rotors), np.flatnonzero(fleet_arrays.has_rotors)
        wings = dart() if fleet_arrays.large_fleet else aircraft()
        shapes = (("/fleet/vehicles", fixed, wings), ("/fleet/rotors", rotors, rotorcraft()))
        self._statuses = np.zeros(0, int)
        self._batches = [
            (self._batch(name, fleet_arrays, rows, shape), rows) for name, rows, shape in shapes if len(rows)
        ]

    def _batch(
        self, name: str, fleet_arrays: FleetArrays, rows: np.ndarray, shape: tuple[np.ndarray, np.ndarray]
    ) -> Any:
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
        uavs = dict(enumerate(fleet_arrays.uavs[row] for row in rows))

        def click(event: Any) -> None:
            if (uav := uavs.get(event.instance_index)) is not None:
                self._on_click(uav)

        batch.on_click(click)
        return batch


DASHES, SMALL_FLEET = 30, 60  # dashes of one predicted path; half as many, without ground marks, in a larger fleet
MAX_AHEAD_S = 60.0  # longest look-ahead drawn for UAVs that are not selected [s]
PARTS = 3  # points per second of trail in a small fleet
ALERT_DASHES = 18  # dashes of the alert ring on the ground


class Scene:
    """Nodes of the fleet: ground, aircraft, trails, predicted paths, stems, alert rings, routes."""

    def __init__(self, scene: Any, palette: Palette, on_click: Callable[[int], None]) -> None:
        self._scene, self._palette = scene, palette
        self.ground = GroundGrid(scene, palette)
        self.glyphs = Glyphs(scene, palette, on_click)
        self.trails = [Strokes(scene, f"/fleet/trail{i}", 2.0) for i in range(CHUNKS)]
        self.head = Strokes(scene, "/fleet/head", 2.0)
        self.predicted = Strokes(scene, "/fleet/predicted", 1.8)
        self.stems = Strokes(scene, "/fleet/stems", 1.2)
        self.routes = Strokes(scene, "/fleet/routes", 1.4)
        self._areas: Strokes | None = None  # a node of its own where there are areas
        self.alert = Strokes(scene, "/alert", 2.2)
        self._drawn: tuple = (None, -1)  # revision and selection, and closed chunks, when the trails were last drawn
        self._drawn_areas: tuple = ()
        self._statuses = np.zeros(0, int)  # statuses they were coloured by
        self._head_statuses = np.zeros(0, int)

    def draw_trails(self, fleet_arrays: FleetArrays, selected: int | None) -> None:
        """Draw changed chunks: one when a chunk closes, all when the drawn UAVs or the selection change."""
        closed = fleet_arrays.trail_steps // STEPS
        recoloured = not np.array_equal(fleet_arrays.statuses, self._statuses)
        changes, previous = self._drawn
        if (key := (fleet_arrays.revision, selected)) == changes and closed == previous and not recoloured:
            return
        redrawn = range(CHUNKS) if key != changes or closed > previous + 1 else range(closed - previous)
        if redrawn == range(1):  # the node of the oldest chunk draws the newest; the others only fade
            self.trails = [self.trails[-1], *self.trails[:-1]]
        colours, n = self.glyphs.colours(fleet_arrays), _parts(fleet_arrays) * STEPS // fleet_arrays.stride + 1
        brightness = 0.6 if fleet_arrays.large_fleet else 1.0
        for age, strokes in enumerate(self.trails):
            ages = age * STEPS + np.linspace(STEPS, 0, n)
            shares = np.interp(ages, [-STEPS, CHUNKS * STEPS], [0.95, 0.03]) * brightness
            shades = faded(colours, rgb(self._palette.ground), shares).reshape(-1, 2, 3)
            if age >= fleet_arrays.chunks:
                strokes.draw(NOTHING.legs)
            elif age in redrawn:
                strokes.draw(_curves(fleet_arrays, fleet_arrays.chunk(age), selected), shades)
            else:
                strokes.colour(shades, len(shades))
        self._drawn, self._statuses = (key, closed), fleet_arrays.statuses.copy()

    def draw_heads(self, fleet_arrays: FleetArrays, selected: int | None) -> None:
        """Draw the newest stretch of every trail up to the aircraft; the array size is constant."""
        lines = _curves(fleet_arrays, fleet_arrays.head(), selected)
        if np.array_equal(fleet_arrays.statuses, self._head_statuses):
            return self.head.draw(lines)
        self._head_statuses = fleet_arrays.statuses.copy()
        share = 0.55 if fleet_arrays.large_fleet else 0.95
        colours = self.glyphs.colours(fleet_arrays) * share + rgb(self._palette.ground) * (1 - share)
        self.head.draw(lines, np.repeat(colours, lines.shape[1], axis=0))

    def draw_predicted(self, fleet_arrays: FleetArrays, now: float, selected: int | None) -> None:
        """Draw the predicted paths dashed, up to the horizon or 60 s; the selected UAV has its tube instead."""
        vehicles = [v for v in predicted_vehicles(fleet_arrays) if v.uav != selected]
        if not vehicles:
            return self.predicted.draw(NOTHING.legs)
        dashes = DASHES if len(fleet_arrays.uavs) <= SMALL_FLEET else DASHES // 2
        forecasts = [(v, f) for v in vehicles if v.forecast is not None for f in (v.forecast, *v.forecast.alternatives)]
        lines = [cut_at_horizon(f.ahead, f.path, v.data_time(now) - f.t, f.horizon_s, dashes) for v, f in forecasts]
        statuses = fleet_arrays.statuses[[i for v, _ in forecasts if (i := fleet_arrays.index(v.uav)) is not None]]
        tints = 0.35 * self._palette.status_colours() + 0.65 * rgb(self._palette.ink)
        shades = faded(tints, rgb(self._palette.ground), np.linspace(0.9, 0.1, 2 * dashes))[:, ::2]
        self.predicted.draw(np.concatenate(lines), shades[statuses].reshape(-1, 2, 3))

    def draw_stems(self, fleet_arrays: FleetArrays) -> None:
        """Draw vertical stems from aircraft to the ground; none in a large fleet."""
        if fleet_arrays.large_fleet or not fleet_arrays.uavs:
            return self.stems.draw(NOTHING.legs)
        foot = fleet_arrays.at * [1, 1, 0] + [0, 0, self.ground.height + 0.05]
        hexagon = circle(np.zeros(3), 0.3 * self.glyphs.unit, 6)[: 6 if len(fleet_arrays.uavs) <= SMALL_FLEET else 0]
        stems = np.stack([fleet_arrays.at, foot], axis=1)[:, None]
        lines = np.concatenate([stems, foot[:, None, None] + hexagon], axis=1)
        tints = 0.5 * self._palette.status_colours() + 0.5 * rgb(self._palette.ground)
        self.stems.draw(lines.reshape(-1, 2, 3), np.repeat(tints[fleet_arrays.statuses], lines.shape[1], axis=0))

    def draw_alerts(self, fleet_arrays: FleetArrays) -> None:
        """Draw a ground ring and a stem under exceptional UAVs; lost links only in a small fleet."""
        shown = fleet_arrays.statuses == MISMATCH if fleet_arrays.large_fleet else fleet_arrays.exceptions
        at, statuses = fleet_arrays.at[shown], fleet_arrays.statuses[shown]
        foot = at * [1, 1, 0] + [0, 0, self.ground.height + 0.1]
        ring = circle(np.zeros(3), (2.0 if fleet_arrays.large_fleet else 1.1) * self.glyphs.unit, 2 * ALERT_DASHES)[::2]
        lines = np.concatenate([foot[:, None, None] + ring, np.stack([at, foot], axis=1)[:, None]], axis=1)
        colours = np.where((statuses == LOST)[:, None], rgb(self._palette.lost), rgb(self._palette.mismatch))
        self.alert.draw(lines.reshape(-1, 2, 3), np.repeat(colours, ALERT_DASHES + 1, axis=0))

    def draw_routes(self, routes: list[RouteLines]) -> None:
        """Draw the routes of the other UAVs in a muted colour."""
        lines = [part for r in routes for part in (r.legs, r.circles, dash_lines(r.returns, 4.0))]
        self.routes.draw(np.concatenate([*lines, NOTHING.legs]), mix(self._palette.route, self._palette.ground, 0.45))

    def draw_areas(
        self, areas: tuple[Area, ...], fences: tuple[tuple[Item, ...], ...], scene_frame: SceneFrame, heights: Heights
    ) -> None:
        """Draw the outlines of geofence areas and fence items on the ground, no-fly areas in the colour of alerts."""
        key = (areas, fences, scene_frame, self.ground.height)
        if _same(key, self._drawn_areas):
            return
        self._drawn_areas, palette = key, self._palette
        shown = {*areas, *(area for items in fences for area in read_fence_items(items).areas)}
        if self._areas is None and not shown:
            return
        self._areas = self._areas or Strokes(self._scene, "/fleet/areas", 2.0)
        lines = [(area_lines(area, scene_frame, heights, self.ground.height + 0.05), area.exclusion) for area in shown]
        self._areas.draw_parts([(x, rgb(palette.mismatch if out else palette.route)) for x, out in lines])


def _same(key: tuple, other: tuple) -> bool:
    """Return whether areas, fences, frame and height are those drawn; fences are compared by identity, for speed."""
    if not other or key[0] is not other[0] or key[2:] != other[2:] or len(key[1]) != len(other[1]):
        return False
    return all(fence is drawn for fence, drawn in zip(key[1], other[1], strict=True))


def _curves(fleet_arrays: FleetArrays, points: np.ndarray, selected: int | None) -> np.ndarray:
    """Return smooth curves through trails (n, k, 3) as segments; none of the selected UAV, as it has a finer path."""
    if (row := fleet_arrays.index(selected)) is not None:
        points = points.copy()
        points[row] = points[row, :1]
    return chain(smooth_curve(points, _parts(fleet_arrays)))


def _parts(fleet_arrays: FleetArrays) -> int:
    """Return the number of curve points per trail step."""
    return PARTS if len(fleet_arrays.uavs) <= SMALL_FLEET else 1


def predicted_vehicles(fleet_arrays: FleetArrays) -> list[Vehicle]:
    """Return the UAVs with drawn predictions: all, in a large fleet the exceptional ones."""
    if not fleet_arrays.large_fleet:
        return [v for v in fleet_arrays.fleet if v.forecast is not None and fleet_arrays.index(v.uav) is not None]
    return [v for v, _ in fleet_arrays.exceptional if v.forecast is not None]


def cut_at_horizon(
    ahead: np.ndarray, path: np.ndarray, start: float, horizon_s: float, dashes: int = DASHES
) -> np.ndarray:
    """Cut a path (n, 3) at look-aheads `ahead`, (n,) [s], into dashes of equal duration between `start` and horizon.

    Returns:
        (dashes, 2, 3) up to `MAX_AHEAD_S`; zero length beyond the horizon
    """
    at = np.minimum(max(start, 0.0) + np.linspace(0.0, MAX_AHEAD_S, 2 * dashes), horizon_s)
    points = np.stack([np.interp(at, ahead, path[:, i]) for i in range(3)], axis=-1)
    return chain(points)[::2]
