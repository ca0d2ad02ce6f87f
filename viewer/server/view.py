"""View of one page: selection, display options and camera of one operator."""

import contextlib
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import viser

from fleet.terrain.areas import Area
from viewer.browser.http_server import Browser
from viewer.export import Export
from viewer.panels.approval import ApprovalDialog
from viewer.panels.detail import MAX_TEXT
from viewer.panels.panels import Panels
from viewer.scene.camera import (
    CHASE_ELEVATION,
    EMPTY_VIEW,
    FROM_ABOVE,
    IN_VIEW_M,
    SIDE_ELEVATION,
    Camera,
    direction_from,
    within_reach,
)
from viewer.scene.fleet_arrays import LOST, MISMATCH, FleetArrays, display_status
from viewer.scene.labels import Labels, alert_labels
from viewer.scene.map.world import overview_html
from viewer.scene.measure import Anchor, Measure, pick
from viewer.scene.routes import NOTHING, RouteLines, mission_lines, route_ahead
from viewer.scene.scene import Scene
from viewer.scene.selection.selected import BEYOND_S, Selection, active_seq
from viewer.store.place import UNIT_M, SceneFrame
from viewer.store.profile import Surface, altitude_profile
from viewer.store.store import FleetStore
from viewer.store.vehicle import Vehicle
from viewer.theme.events import clip
from viewer.timeline.deck import Timeline
from viewer.timeline.recordings import RecordingStore

RECOVERY_S = 3.0  # time without an error after which the error text is removed [s]
FOCUS_PATH_S = 40.0  # flown path framed with a focused aircraft [s]
CHASE_BOX = 4.0  # half edge of the box around a chased aircraft [10 m]
FRAME_MARGIN = 1.35  # margin of the frame while the flown path grows [-]


class View:
    """The page of one client: its scene, its panels, its camera, its selection."""

    def __init__(
        self,
        browser: Browser,
        store: FleetStore,
        recordings: RecordingStore,
        wake: Callable[[], None],
        approvals: ApprovalDialog | None = None,
    ) -> None:
        client, palette = browser.client, browser.palette
        self.client, self.browser, self._store, self.palette, self._wake = client, browser, store, palette, wake
        self.scene = Scene(client.scene, palette, self._on_aircraft)
        self.measure, self._route = Measure(client.scene, palette), NOTHING
        self.heights: Callable[[np.ndarray], np.ndarray] = unknown_heights  # terrain under scene points
        self.areas: tuple[Area, ...] = ()  # geofence areas of the operator
        self._drawn: tuple[tuple[int, ...], np.ndarray] = (), np.zeros((0, 3))  # UAVs and their positions, (n, 3)
        self.selection, self._labels = Selection(client.scene, palette), Labels(client.scene)
        commands = {
            "Camera: show the whole fleet": ("F", self.show_all),
            "Camera: from above": ("T", self.look_from_above),
            "Camera: from the side": ("V", self.look_from_side),
            "Camera: behind the selected aircraft": ("C", self.chase),
            "Next aircraft with an alert": ("N", self.next_exception),
            "Toggle following the selected aircraft": ("L", self.toggle_follow),
            "Measure distance, bearing and altitude difference": ("M", self.toggle_measure),
            "Measure: point in the middle of the view": ("X", self.measure_middle),
        }
        self.panels = Panels(browser, palette, self.focus_on, commands, approvals)
        if approvals is not None:
            approvals.changed = self._redraw
        self.timeline = Timeline(client, store, recordings, palette, self._redraw)
        self.panels.measure_button.on_click(lambda _: self.toggle_measure())
        self.panels.seek = self.timeline.send_code()
        with self.timeline.tab("Export", viser.Icon.DOWNLOAD):
            Export(client, store, recordings, palette, lambda: self.selected)
        self.camera = Camera(browser)
        self.selected: int | None = None
        self.dirty = True  # the selection changed and is not drawn yet
        self.offset = 0  # tick of the second at which slow content is drawn
        self._fleet_points = EMPTY_VIEW  # fleet, paths and route of the last frame, (n, 3) [10 m]
        self._framed_key: tuple = ()
        self._force_framing = False  # frame again even if the camera was moved
        self._framed_box = np.zeros((2, 3))  # corners of the box last framed [10 m]
        self._followed: tuple[int, np.ndarray] | None = None
        self._shown: dict[int, Vehicle] = {}  # snapshots in the panels; the scene shows the same until the next ones
        self._region: SceneFrame | None = None  # scene frame of the overview shown
        self._error, self._error_time = "", 0.0  # last drawing error and its time, monotonic [s]

    def restore(self, previous: "View") -> None:
        """Restore selection, time shown and camera of the view before a theme change."""
        self.selected, self.camera, self.offset = previous.selected, previous.camera, previous.offset
        self.timeline.player = previous.timeline.player
        self._framed_key, self._framed_box = previous._framed_key, previous._framed_box
        self._force_framing = previous._force_framing
        self._followed = previous._followed

    def show_error(self, error: str) -> bool:
        """Show a drawing error on the page; return whether it is new."""
        self._error_time = time.monotonic()
        if error == self._error:
            return False
        self._error = error
        with contextlib.suppress(RuntimeError, AssertionError):  # the page may be closing
            self.panels.show_error(
                f"This page could not be drawn ({clip(error, MAX_TEXT)}) and may show old data; other pages continue. "
                "Reload it; if the error remains, see the log of the viewer."
            )
        return True

    def _redraw(self) -> None:
        """Request an immediate redraw after a change of the time shown."""
        self.dirty, self._shown = True, {}
        self._wake()

    def show_all(self) -> None:
        """Frame everything again, even if the camera was moved."""
        self.panels.follow.value = False
        self._framed_key, self._force_framing = (), True

    def look_from_above(self) -> None:
        """Show the fleet from above, north up."""
        self._look_from(FROM_ABOVE, self._fleet_points)

    def _look_from(self, direction: np.ndarray, points: np.ndarray) -> None:
        """Frame points (n, 3) [10 m] from a direction (3,) in place of any pending framing."""
        self._force_framing = False
        self.camera.look_from(direction, points)

    def look_from_side(self) -> None:
        """Show the fleet from the left of the selected UAV, else from the south, close to the horizontal."""
        vehicle = self.selected_vehicle()
        psi = vehicle.attitude[2] if vehicle is not None else np.pi / 2
        self._look_from(direction_from(psi, -np.pi / 2, SIDE_ELEVATION), self._fleet_points)

    def chase(self) -> None:
        """Follow the selected UAV from behind."""
        vehicle = self.selected_vehicle()
        if vehicle is None or (at := vehicle.position(time.monotonic())) is None:
            return
        near = at + CHASE_BOX * np.array([[1, 1, 1], [-1, -1, -1]])
        self._look_from(direction_from(vehicle.attitude[2], np.pi, CHASE_ELEVATION), near)
        self.panels.follow.value = True

    def next_exception(self) -> None:
        """Focus on the next UAV with an alert, mismatch or lost link, in the order of ids."""
        exceptional = [v.uav for v in self._store.all() if display_status(v, time.monotonic()) in (MISMATCH, LOST)]
        later = [uav for uav in exceptional if self.selected is None or uav > self.selected]
        if exceptional:
            self.focus_on((later or exceptional)[0])

    def toggle_follow(self) -> None:
        """Toggle following the selected UAV."""
        self.panels.follow.value = not self.panels.follow.value

    def _on_aircraft(self, uav: int) -> None:
        """Select a pressed aircraft; while measuring it is a point instead, see `_on_press`."""
        if not self.measure.active:
            self.select(uav)

    def toggle_measure(self) -> None:
        """Start or end measuring: presses in the scene pick points."""
        self.measure.toggle()
        if self.measure.active:
            self.client.scene.on_click()(self._on_press)
        else:
            self.client.scene.remove_click_callback(self._on_press)
        self._redraw_measure()

    def _on_press(self, event: viser.SceneClickEvent) -> None:
        self._pick(np.array(event.ray_origin), np.array(event.ray_direction))

    def measure_middle(self) -> None:
        """Pick the point in the middle of the view, for the keyboard; start measuring if it is off."""
        if not self.measure.active:
            self.toggle_measure()
        view = self.camera.view()
        self._pick(view.position, view.look_at - view.position)

    def _pick(self, start: np.ndarray, direction: np.ndarray) -> None:
        anchors = [Anchor(f"UAV-{uav:03d}", at, uav) for uav, at in zip(*self._drawn, strict=True)]
        route = self._route
        anchors += [Anchor(f"item {n}", at) for n, at in zip(route.items.tolist(), route.points, strict=True)]
        view, level = self.camera.view(), self.scene.ground.height
        self.measure.add(pick((start, direction), anchors, view, self.heights, level))
        self._redraw_measure()

    def _redraw_measure(self) -> None:
        self.panels.show_measure(self.measure.html(self.panels.units))
        self.dirty = True
        self._wake()

    def selected_vehicle(self) -> Vehicle | None:
        """Return the selected UAV as the panels show it, at its newest pose; None when there is none."""
        newest = self.timeline.vehicle(self.selected) if self.selected is not None else None
        shown = self._shown.get(newest.uav) if newest is not None else None
        return newest if newest is None or shown is None else shown.at_pose_of(newest, time.monotonic())

    def select(self, uav: int) -> None:
        """Select a known UAV and draw it immediately."""
        if self._store.get(uav) is not None:
            self.selected, self.dirty = uav, True
            self.browser.uav = None
            self.panels.show(self.selected_vehicle(), time.monotonic())  # before the slower 3-D content
            self.client.flush()
            self._wake()

    def focus_on(self, uav: int, t: float | None = None) -> None:
        """Select a UAV, move the camera to it and, if given, show its data time `t` [s since 1970]."""
        if t is not None:
            self.timeline.show(self._store.all(), uav, t)
        self.select(uav)
        vehicle, scene_frame = self.timeline.vehicle(uav), self._store.scene_frame
        if vehicle is None or scene_frame is None or (at := vehicle.position(time.monotonic())) is None:
            return
        forecast, track = vehicle.forecast, self._store.track(vehicle)
        horizon_s = max(forecast.horizon_s, BEYOND_S) if forecast is not None else 0.0
        ahead = [forecast.position_at(np.linspace(0, horizon_s, 40))] if forecast is not None else []
        points = np.vstack([at, *ahead, track[track[:, 0] > vehicle.data_time(time.monotonic()) - FOCUS_PATH_S, 1:]])
        self.camera.fly_to(np.vstack([points, points * [1, 1, 0] + [0, 0, self.scene.ground.height]]))

    def draw_moving(self, fleet_arrays: FleetArrays, now: float, tick: int) -> None:
        """Draw moving content: aircraft at the full rate, trail heads, stems and the selected UAV more slowly."""
        with self.client.atomic():
            fleet_arrays = self.timeline.fleet_arrays(fleet_arrays, self.selected, now)
            self.scene.glyphs.draw(fleet_arrays)
            if tick % (10 if fleet_arrays.large_fleet else 2) == 0:
                self.scene.draw_heads(fleet_arrays, self.selected)
                self.scene.draw_stems(fleet_arrays)
                self.scene.draw_alerts(fleet_arrays)
            if tick % 5 == 0 and not self.timeline.player.live:
                self.timeline.draw(self.selected)
        with self.client.atomic():  # of its own: a long block arrives in parts, between which labels would overlap
            if tick % 2 == 0:
                self._draw_labels(fleet_arrays, now)
            self._follow(now)

    def draw_selection(self, fleet_arrays: FleetArrays, now: float, ground: float) -> None:
        """Draw the selected UAV immediately: path, route, tube, labels; at another time the panels too."""
        fleet_arrays = self.timeline.fleet_arrays(fleet_arrays, self.selected, now)
        if not self._shown:
            self._draw_records(fleet_arrays, now)
        with self.client.atomic():
            self._draw_selected(now, ground)
            self._draw_labels(fleet_arrays, now)
        self.client.flush()

    def _draw_records(self, fleet_arrays: FleetArrays, now: float) -> None:
        """Draw state, fit, horizon and ages in panels, labels and ring, from one record of each UAV."""
        self._shown = {vehicle.uav: vehicle for vehicle in fleet_arrays.fleet}
        self.panels.draw(
            fleet_arrays.fleet,
            self._store,
            fleet_arrays.now,
            self.selected,
            scene=partial(self._draw_labels, fleet_arrays, now) if fleet_arrays.uavs else lambda: None,
        )

    def _draw_labels(self, fleet_arrays: FleetArrays, now: float) -> None:
        """Draw the selected UAV, scale the aircraft to the camera distance and draw the labels."""
        camera_view, scene = self.camera.view(), self.scene
        scene.glyphs.draw(fleet_arrays)  # another time may have other UAVs
        size = self.panels.glyph.value
        scene.glyphs.update_appearance(fleet_arrays, camera_view, selected=self.selected, size=size)
        vehicle = self.selected_vehicle()
        if vehicle is None:
            self.selection.clear()
        else:
            self.selection.draw(vehicle, self._store, now, ground=scene.ground.height, unit=scene.glyphs.unit)
        self._drawn = fleet_arrays.uavs, fleet_arrays.at
        self.measure.draw(fleet_arrays.position, scene.ground.height, scene.glyphs.unit, self.panels.units)
        tags, marks = [*self.measure.tags, *self.selection.tags], self.selection.marks
        alerts = alert_labels(fleet_arrays, self._shown, self.selected, scene.glyphs.unit)
        self._labels.draw([*tags, *marks[:1], *alerts, *marks[1:]], camera_view)
        self.selection.move_numbers(self._labels.boxes, camera_view)

    def draw_slow(self, fleet_arrays: FleetArrays, now: float, ground: float) -> None:
        """Draw slow content once per second and on a new selection: trails, predictions, routes, panels."""
        fleet_arrays = self.timeline.fleet_arrays(fleet_arrays, self.selected, now)
        self.dirty = False
        self._restore_selection(fleet_arrays)
        self._draw_records(fleet_arrays, now)  # first, as a long block is sent in parts
        self.timeline.draw(self.selected)
        shown = self._shown.get(self.selected) if self.selected is not None else None
        self.panels.charts.draw(shown, self._store, fleet_arrays.now, self.panels.units)
        self.panels.show_measure(self.measure.html(self.panels.units))
        if (scene_frame := self._store.scene_frame) is not None and fleet_arrays.uavs:
            with self.client.atomic():
                self._draw(fleet_arrays, now, scene_frame, ground)
        if self._error and time.monotonic() - self._error_time > RECOVERY_S:
            self._error = ""
            self.panels.show_error("")

    def _draw(self, fleet_arrays: FleetArrays, now: float, scene_frame: SceneFrame, ground: float) -> None:
        options, scene = self.panels, self.scene
        if self._region is not scene_frame:
            self._region, options.region.content = scene_frame, overview_html(scene_frame, self.palette)
        scene.ground.raise_to(ground)
        scene.draw_trails(fleet_arrays, self.selected)
        scene.draw_predicted(fleet_arrays, now, self.selected if options.tube.value else None)
        scene.predicted.show(options.predicted.value)
        scene.stems.show(options.stems.value)
        for strokes in (*scene.trails, scene.head):
            strokes.show(options.trails.value)
        others = [v for v in fleet_arrays.fleet if v.uav != self.selected] if options.routes.value else []
        scene.draw_routes([mission_lines(v.mission, scene_frame, ground) for v in others])
        fences = tuple(v.mission.fence for v in fleet_arrays.fleet if v.mission is not None and v.mission.fence)
        scene.draw_areas(self.areas, fences, scene_frame, self.heights)
        self.selection.tube = options.tube.value
        self._draw_selected(now, ground)

    def _restore_selection(self, fleet_arrays: FleetArrays) -> None:
        """Restore the selection of the browser; without one, select the first UAV with a prediction."""
        browser = self.browser
        if fleet_arrays.index(browser.uav) is not None:
            self.selected, browser.uav = browser.uav, None
        drawn = [v for v in fleet_arrays.fleet if fleet_arrays.index(v.uav) is not None]
        if self.selected is None and drawn:
            self.selected = max(drawn, key=lambda v: (v.forecast is not None, -v.uav)).uav
        browser.save(self.selected)

    def _draw_selected(self, now: float, ground: float) -> None:
        """Draw the selected UAV's flown path and mission."""
        vehicle, scene_frame = self.selected_vehicle(), self._store.scene_frame
        if vehicle is None or scene_frame is None:
            self._route = NOTHING
            return self.panels.charts.draw_profile(None)
        self.selection.draw_flight(vehicle, self._store.track(vehicle), now, self.scene.glyphs.unit)
        lines = mission_lines(vehicle.mission, scene_frame, ground)
        self.selection.draw_route(vehicle, lines, self.camera.view(), self.scene.glyphs.unit)
        self._route = lines
        self._draw_profile(vehicle, lines, Surface(self.heights, ground, scene_frame.origin.alt_mm * 1e-3), now)

    def _draw_profile(self, vehicle: Vehicle, route: RouteLines, surface: Surface, now: float) -> None:
        """Draw the altitude profile ahead of the selected UAV."""
        if (at := vehicle.position(now)) is None:
            return self.panels.charts.draw_profile(None)
        way, forecast = route_ahead(route, active_seq(vehicle), at), vehicle.forecast
        begin = max(vehicle.data_time(now) - forecast.t, 0.0) if forecast is not None else 0.0
        span = begin, vehicle.record(now).horizon_s
        self.panels.charts.draw_profile(altitude_profile(way, forecast, span, surface), self.panels.units)

    def frame_fleet(self, points: np.ndarray, key: tuple, ground: float) -> None:
        """Frame the fleet when its content, its extent or the aspect ratio changes.

        Args:
            points: fleet and predicted paths, (n, 3) [10 m]
            key: values whose change requires new framing
            ground: height of the ground [10 m]
        """
        if not self.timeline.player.live:
            return
        vehicle, scene_frame = self.selected_vehicle(), self._store.scene_frame
        lines, track = NOTHING, NOTHING.points
        if vehicle is not None and scene_frame is not None:
            lines, track = mission_lines(vehicle.mission, scene_frame, ground), self._store.track(vehicle)[:, 1:]
        content = np.vstack([points, lines.points, lines.circles.reshape(-1, 3), track])
        points = within_reach(content, IN_VIEW_M / UNIT_M)
        self._fleet_points = points
        key = (*key, bool(len(lines.points)), round(self.camera.aspect, 1), round(self.camera.bottom_share, 1))
        if key == self._framed_key and not outgrown(points, self._framed_box):
            return
        grown, self._framed_key = key == self._framed_key, key
        self._framed_box = np.stack([points.min(axis=0), points.max(axis=0)])
        if grown:  # a growing path gets a margin, so that the camera does not move every second
            points = points.mean(axis=0) + (points - points.mean(axis=0)) * [FRAME_MARGIN, FRAME_MARGIN, 1.0]
        with self.client.atomic():
            self.camera.show(np.vstack([points, points * [1, 1, 0] + [0, 0, ground]]), force=self._force_framing)
        self._force_framing = False

    def _follow(self, now: float) -> None:
        vehicle = self.selected_vehicle() if self.panels.follow.value else None
        at = vehicle.position(now) if vehicle is not None else None
        if vehicle is None or at is None:
            self._followed = None
            return
        if self._followed is not None and self._followed[0] == vehicle.uav:
            self.camera.follow(at - self._followed[1])
        self._followed = vehicle.uav, at


def unknown_heights(points: np.ndarray) -> np.ndarray:
    """Return the height of unknown terrain under points (n, 2 or 3): NaN, (n,)."""
    return np.full(len(points), np.nan)


def outgrown(points: np.ndarray, box: np.ndarray) -> bool:
    """Return whether points (n, 3) leave a box, corners (2, 3), by more than its margin."""
    spare = 0.4 * (FRAME_MARGIN - 1) * max(float(np.linalg.norm(box[1] - box[0])), 10.0)
    return bool(((box[0] - points.min(axis=0)) > spare).any() or ((points.max(axis=0) - box[1]) > spare).any())
