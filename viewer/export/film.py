"""Export a flight as one self-contained HTML file with the 3-D scene."""

from collections.abc import Callable
from typing import Any

import numpy as np

from viewer.browser.http_server import serve, without_stdout
from viewer.scene.camera import FOV, IN_VIEW_M, frame, set_initial_view, within_reach
from viewer.scene.fleet_arrays import FleetArrays
from viewer.scene.labels import CameraView, Labels
from viewer.scene.routes import mission_lines
from viewer.scene.scene import Scene
from viewer.scene.selection.selected import Selection
from viewer.store.place import UNIT_M
from viewer.store.received.datatime import timestamp
from viewer.store.store import FleetStore
from viewer.theme.palette import Palette
from viewer.timeline.past import PastVehicle, update_past_arrays, vehicle_at
from viewer.timeline.recordings import RecordingStore

MAX_FRAMES, FRAME_S = 400, 0.1  # most frames of an animation, and duration of each [s]
ASPECT = 1.6  # aspect ratio for the camera [-]


class FlightAnimation:
    """Render every frame on a hidden server and serialise the scene."""

    def __init__(self, store: FleetStore, recordings: RecordingStore, palette: Palette) -> None:
        self._store, self._recordings, self._palette = store, recordings, palette

    def html(self, selected: int, on_progress: Callable[[float], None] = lambda _: None) -> str:
        """Return the recording as HTML, on the clock of one UAV.

        Args:
            selected: the UAV
            on_progress: called with the progress, 0..1
        Raises:
            ValueError: when there is no recording of it yet; wait for its first sample.
        """
        fleet = [vehicle for vehicle in self._store.all() if len(self._recordings.by_uav.get(vehicle.uav, ()))]
        clock_vehicle = next((vehicle for vehicle in fleet if vehicle.uav == selected), None)
        if clock_vehicle is None:
            raise ValueError(f"export: found no recording of uav-{selected}, expected a flight; wait for its samples")
        span, shift = self._recordings.playback_range(clock_vehicle, fleet)
        times = np.linspace(span.begin, span.end, int(np.clip((span.end - span.begin) / 0.5, 2, MAX_FRAMES)))
        server = serve("127.0.0.1", 0)
        try:
            scene = _AnimationScene(server, self._store, self._palette, selected)
            frames = [self._pasts(fleet, shift, t) for t in times[[0, len(times) // 2, -1]]]
            scene.look_at([past for pasts in frames for past in pasts])
            serializer = server.get_scene_serializer()
            for k, t in enumerate(times):
                scene.draw(self._pasts(fleet, shift, float(t)))
                serializer.insert_sleep(FRAME_S)
                on_progress((k + 1) / len(times))
            text = serializer.as_html(dark_mode=self._palette.dark)
        finally:
            with without_stdout():
                server.stop()
        return text.replace("<title>Viser</title>", "<title>ParaUAV: a flight</title>", 1)

    def _pasts(self, fleet: list[Any], shift: dict[int, float], t: float) -> list[PastVehicle]:
        pasts = (
            vehicle_at(vehicle, self._recordings.by_uav[vehicle.uav], t + shift.get(vehicle.uav, 0.0))
            for vehicle in fleet
        )
        return [past for past in pasts if past is not None]


class _AnimationScene:
    """Scene of the animation."""

    def __init__(self, server: Any, store: FleetStore, palette: Palette, selected: int) -> None:
        self._server, self._store, self._selected = server, store, selected
        self._scene, self._fleet_arrays = Scene(server.scene, palette, lambda _: None), FleetArrays()
        self._selection, self._labels = Selection(server.scene, palette), Labels(server.scene)
        self._camera_view = CameraView(np.zeros(3), np.ones(3), float(FOV), ASPECT)

    def look_at(self, pasts: list[PastVehicle]) -> None:
        """Frame all positions and paths."""
        paths = [past.recording.path(-np.inf, np.inf)[:, 1:] for past in pasts]
        points = within_reach(np.vstack([*paths, np.zeros((0, 3))]), IN_VIEW_M / UNIT_M)
        ground = min(float(points[:, 2].min()) - 0.5, 0.0)
        self._scene.ground.raise_to(ground)
        points = np.vstack([points, points * [1, 1, 0] + [0, 0, ground]])
        set_initial_view(self._server, points)
        self._camera_view = CameraView(*frame(points, ASPECT), float(FOV), ASPECT)

    def draw(self, pasts: list[PastVehicle]) -> None:
        """Draw one frame."""
        fleet_arrays, scene, camera_view = self._fleet_arrays, self._scene, self._camera_view
        update_past_arrays(fleet_arrays, pasts, 0.0)
        if not fleet_arrays.uavs:
            return
        scene.glyphs.draw(fleet_arrays)
        scene.glyphs.update_appearance(fleet_arrays, camera_view, selected=self._selected, size=1.0)
        scene.draw_trails(fleet_arrays, self._selected)
        scene.draw_heads(fleet_arrays, self._selected)
        scene.draw_stems(fleet_arrays)
        scene.draw_alerts(fleet_arrays)
        scene.draw_predicted(fleet_arrays, 0.0, self._selected)
        self._draw_selected(next((past for past in pasts if past.uav == self._selected), None))

    def _draw_selected(self, vehicle: PastVehicle | None) -> None:
        scene_frame, unit, ground = self._store.scene_frame, self._scene.glyphs.unit, self._scene.ground.height
        if vehicle is None or scene_frame is None:
            return self._selection.clear()
        self._selection.draw(vehicle, self._store, 0.0, ground=ground, unit=unit)
        self._selection.draw_flight(vehicle, self._store.track(vehicle), 0.0, unit)
        self._selection.draw_route(
            vehicle, mission_lines(vehicle.mission, scene_frame, ground), self._camera_view, unit
        )
        tags = self._selection.tags
        tags[:1] = [tag._replace(text=f"{tag.text} · {timestamp(vehicle.shown_t)}") for tag in tags[:1]]
        self._labels.draw([*tags, *self._selection.marks], self._camera_view)
