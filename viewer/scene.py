"""The fleet in 3-D: about twenty nodes whatever its size, never one per UAV."""

from collections.abc import Callable
from typing import Any

import numpy as np

from fleet.contract import State
from viewer.palette import Palette, mesh_colour, mix, rgb, triple
from viewer.place import UNIT_M, scene_quat
from viewer.routes import NOTHING, Route, circle
from viewer.shapes import aircraft, rotorcraft
from viewer.strokes import Strokes, chain, dash_lines, faded
from viewer.vehicle import Vehicle

CHUNKS, STEPS = 5, 12  # the trail: immutable chunks of 12 s, and a head of up to 12 s, one point a second
MINUTE = np.arange(float(CHUNKS + 1) * STEPS, -1.0, -1.0)  # how long ago each point of the trail is, (73,) [s]
DASHES = 28  # dashes of one predicted path
CROWD = 300  # above this many, stems go and only exceptions keep their predicted path
LEAP_M = 1_000.0  # farther within a second is no flight but another one (a recording begun anew): a new trail [m]
HOVER = ("multirotor", "helicopter")  # kinds of vehicle drawn with rotors
RINGS_M = (500, 1000, 2000)


class Scene:
    """The shared nodes: ground, vehicles, trails, predicted paths, stems, routes."""

    def __init__(self, server: Any, palette: Palette) -> None:
        self._server, self._scene, self._palette = server, server.scene, palette
        self.ground = 0.0  # height of the ground, scene [10 m]
        self.glyph = 1.0  # how much larger than life aircraft are drawn
        self._vehicles: list[Any] = []  # a batch for each shape; those of another shape have no size in it
        self._on_click: Callable[[int], None] = lambda _: None
        self.uavs: tuple[int, ...] = ()  # instance index -> UAV
        self._selected: int | None = None  # has its own, finer path
        self._colours = np.zeros((0, 3))
        self._hover = np.zeros(0, bool)  # who has rotors instead of wings
        self._ring = np.zeros((0, 0, 3))
        self._beat = 0
        self._ground_node = self._environment()
        self.trails = [Strokes(self._scene, f"/fleet/trail{i}", 2.0) for i in range(CHUNKS)]
        self.head = Strokes(self._scene, "/fleet/head", 2.0)
        self.predicted = Strokes(self._scene, "/fleet/predicted", 1.8)
        self.stems = Strokes(self._scene, "/fleet/stems", 1.2)
        self.routes = Strokes(self._scene, "/fleet/routes", 1.4)

    def on_click(self, clicked: Callable[[int], None]) -> None:
        """Call `clicked(uav)` when an aircraft is clicked in 3-D."""
        self._on_click = clicked

    def _environment(self) -> Any:
        """Lay the ground: grid, range rings, sky; returns the node that carries them."""
        p, scene = self._palette, self._scene
        top, bottom = rgb(p.sky[0]), rgb(p.sky[1])
        w = (np.linspace(0, 1, 256) ** 1.2)[:, None, None]
        scene.set_background_image(np.repeat(top * (1 - w) + bottom * w, 2, axis=1).astype(np.uint8), format="png")
        scene.configure_default_lights(True, cast_shadow=False)
        # No fog: with it the client fails to draw the outline of an aircraft under the mouse, and then the whole frame.
        node = scene.add_frame("/env", show_axes=False)
        scene.add_grid(
            "/env/grid",
            width=3000.0,
            height=3000.0,
            cell_size=10.0,
            section_size=50.0,
            cell_color=triple(p.grid),
            section_color=triple(p.section),
            cell_thickness=0.6,
            section_thickness=1.0,
            plane_color=triple(p.ground),
            plane_opacity=0.92,
            fade_distance=900.0,
            fade_strength=1.2,
            shadow_opacity=0.0,
            position=(0.0, 0.0, -0.05),
        )
        rings = np.concatenate([circle(np.array([0, 0, 0.02]), m / UNIT_M, 128) for m in RINGS_M])
        Strokes(scene, "/env/rings", 1.2).draw(rings, rgb(p.ring))
        for m in RINGS_M[1:]:
            scene.add_label(f"/env/{m}", f"{m / 1000:g} km", position=(0.0, -m / UNIT_M, 0.3), font_screen_scale=0.7)
        return node

    def set_ground(self, height: float) -> None:
        """Move the ground to a height [10 m]."""
        if abs(height - self.ground) > 0.05:
            self.ground = height
            self._ground_node.position = (0.0, 0.0, height)

    def vehicles(self, fleet: list[Vehicle], now: float, selected: int | None) -> None:
        """Place every aircraft; call it at the full rate."""
        shown = [(vehicle, at) for vehicle in fleet if (at := vehicle.where(now)) is not None]
        if not shown:
            return
        at = np.array([place for _, place in shown])
        quat = scene_quat(*np.array([vehicle.attitude for vehicle, _ in shown]).T)
        colours = np.array([rgb(self._palette.state(vehicle.state(now))) for vehicle, _ in shown])
        size = np.array([self.glyph * (1.25 if vehicle.uav == selected else 1.0) for vehicle, _ in shown])
        uavs, before, self._selected = tuple(vehicle.uav for vehicle, _ in shown), self._selected, selected
        hover = np.array([v.status is not None and v.status.vehicle in HOVER for v, _ in shown])
        if uavs != self.uavs or not np.array_equal(hover, self._hover):
            self._enlist(uavs, at, colours, hover)
        elif before != selected:
            self._redraw()
        for batch, own in zip(self._vehicles, (~hover, hover), strict=False):
            batch.batched_positions, batch.batched_wxyzs = at, quat
            batch.batched_scales = np.where(own, size, 0.0).astype(np.float32)
            if not np.array_equal(colours, self._colours):
                batch.batched_colors = mesh_colour(colours * 0.85)
        self._colours = colours

    def _enlist(self, uavs: tuple[int, ...], at: np.ndarray, colours: np.ndarray, hover: np.ndarray) -> None:
        """Start the batches anew for another set of UAVs; those who stay keep their trails."""
        old = {uav: i for i, uav in enumerate(self.uavs)}
        ring = np.repeat(at[:, None], (CHUNKS + 1) * STEPS + 1, axis=1)
        for i, uav in enumerate(uavs):
            if uav in old:
                ring[i] = self._ring[old[uav]]
        self._ring, self.uavs, self._colours, self._hover = ring, uavs, colours, hover
        for batch in self._vehicles[1:]:
            batch.remove()
        self._vehicles = [self._batch("/fleet/vehicles", *aircraft())]
        if hover.any():
            self._vehicles.append(self._batch("/fleet/rotors", *rotorcraft()))
        self._redraw()

    def _batch(self, name: str, vertices: np.ndarray, faces: np.ndarray) -> Any:
        """Make a batch of one shape with room for every UAV, so that an index in it names one."""
        n = len(self.uavs)
        batch = self._scene.add_batched_meshes_simple(
            name,
            vertices,
            faces,
            np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
            np.zeros((n, 3)),
            batched_scales=np.zeros(n, np.float32),
            batched_colors=mesh_colour(self._colours * 0.85),
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
            flat_shading=True,
        )
        batch.on_click(lambda event: self._clicked(event.instance_index))
        return batch

    def _clicked(self, index: int | None) -> None:
        if index is not None and 0 <= index < len(self.uavs):
            self._on_click(self.uavs[index])

    def beat(self, fleet: list[Vehicle], played: dict[int, np.ndarray]) -> None:
        """Remember where everyone is, once a second; every twelfth call closes a chunk of trail.

        Args:
            fleet: all UAVs
            played: of UAVs whose seconds are others than ours, the places `MINUTE` ago, (n, 3) [10 m]
        """
        if not self.uavs:
            return
        where = {vehicle.uav: vehicle.at for vehicle in fleet}
        now = [where.get(uav) for uav in self.uavs]
        self._ring = np.roll(self._ring, -1, axis=1)
        self._ring[:, -1] = [self._ring[i, -2] if at is None else at for i, at in enumerate(now)]
        leapt = np.linalg.norm(self._ring[:, -1] - self._ring[:, -2], axis=1) > LEAP_M / UNIT_M
        self._ring[leapt] = self._ring[leapt, -1:]
        for i, uav in enumerate(self.uavs):
            if uav in played:
                self._ring[i] = played[uav]
        self._beat += 1
        if self._beat % STEPS == 0 or leapt.any() or played:
            self._redraw()

    def _redraw(self) -> None:
        for age in range(CHUNKS):
            self._chunk(age)

    def _others(self, points: np.ndarray) -> np.ndarray:
        """Take away the trail of the selected UAV, points (n, k, 3): it has its own, finer path."""
        if self._selected not in self.uavs:
            return points
        bare, i = points.copy(), self.uavs.index(self._selected)
        bare[i] = bare[i, :1]
        return bare

    def _chunk(self, age: int) -> None:
        """Draw one closed chunk; `age` 0 is the newest."""
        last = self._ring.shape[1] - 1 - self._beat % STEPS - age * STEPS
        points = self._others(self._ring[:, last - STEPS : last + 1])
        shares = np.interp(age * STEPS + np.arange(STEPS, -1, -1), [-STEPS, CHUNKS * STEPS], [0.95, 0.03])
        colours = faded(self._colours, rgb(self._palette.ground), shares)
        self.trails[age].draw(chain(points), colours.reshape(-1, 2, 3))

    def heads(self, now: list[np.ndarray | None]) -> None:
        """Draw the newest stretch of every trail up to where the aircraft is: an array of fixed size."""
        if not self.uavs or len(now) != len(self.uavs):
            return
        run = self._beat % STEPS
        points = self._ring[:, self._ring.shape[1] - 1 - run :]
        tip = np.array([self._ring[i, -1] if at is None else at for i, at in enumerate(now)])
        padded = np.concatenate([points, np.repeat(tip[:, None], STEPS + 1 - run, axis=1)], axis=1)
        colours = np.repeat(self._colours[:, None] * 0.95 + rgb(self._palette.ground) * 0.05, STEPS + 1, axis=1)
        self.head.draw(chain(self._others(padded)), colours.reshape(-1, 3))

    def draw_predicted(self, fleet: list[Vehicle], now: float, selected: int | None) -> None:
        """Draw every predicted path dashed, from now to its horizon; the selected one has its tube instead."""
        lines, colours = [], []
        for vehicle in fleet:
            told = vehicle.forecast
            exceptional = bool(vehicle.alerts) or vehicle.state(now) is State.LINK_LOST
            if told is None or vehicle.uav == selected or (len(fleet) > CROWD and not exceptional):
                continue
            cut = cut_at_horizon(told.ahead, told.path, vehicle.clock(now) - told.t, told.until)
            colour = 0.35 * rgb(self._palette.state(vehicle.state(now))) + 0.65 * rgb(self._palette.ink)
            lines.append(cut)
            colours.append(faded(colour, rgb(self._palette.ground), np.linspace(0.85, 0.3, 2 * DASHES))[::2])
        self.predicted.draw(
            np.concatenate(lines) if lines else NOTHING.legs, np.concatenate(colours) if lines else None
        )

    def draw_stems(self, fleet: list[Vehicle], now: float) -> None:
        """Drop a stem from every aircraft to a small foot on the ground."""
        shown = [(v, at) for v in fleet if (at := v.where(now)) is not None] if len(fleet) <= CROWD else []
        if not shown:
            return self.stems.draw(NOTHING.legs)
        at = np.array([place for _, place in shown])
        foot = at * [1, 1, 0] + [0, 0, self.ground + 0.05]
        hexagon = circle(np.zeros(3), 0.35 * self.glyph, 6)
        lines = np.concatenate([np.stack([at, foot], axis=1)[:, None], foot[:, None, None] + hexagon], axis=1)
        tint = np.array([mix(self._palette.state(v.state(now)), self._palette.ground, 0.5) for v, _ in shown])
        self.stems.draw(lines.reshape(-1, 2, 3), np.repeat(tint, 7, axis=0))

    def draw_routes(self, routes: list[Route]) -> None:
        """Draw routes of others than the selected UAV, faintly."""
        lines = [part for r in routes for part in (r.legs, r.circles, dash_lines(r.back, 4.0))]
        self.routes.draw(np.concatenate([*lines, NOTHING.legs]), mix(self._palette.route, self._palette.ground, 0.45))


def cut_at_horizon(ahead: np.ndarray, path: np.ndarray, start: float, until: float) -> np.ndarray:
    """Cut a path into dashes between two look-aheads.

    Args:
        ahead: look-ahead of each point, rising, (n,) [s]
        path: positions, (n, 3)
        start, until: where drawing begins, and the horizon where it must end [s]
    Returns:
        (DASHES, 2, 3); without length where nothing may be claimed any more
    """
    at = np.linspace(min(max(start, 0.0), until), until, 2 * DASHES)
    points = np.stack([np.interp(at, ahead, path[:, i]) for i in range(3)], axis=-1)
    return chain(points)[::2]
