"""Export buttons of the page: view as PNG, flight as HTML film, data of a UAV as CSV."""

import csv
import io
from collections.abc import Callable
from datetime import UTC, datetime
from html import escape
from typing import Any

import numpy as np
import viser
from PIL import Image

from fleet.frames import to_geodetic
from viewer.browser.http_server import serve, stop_server
from viewer.scene.camera import FOV, IN_VIEW_M, frame, set_initial_view, within_reach
from viewer.scene.fleet_arrays import FleetArrays
from viewer.scene.labels import CameraView, Labels
from viewer.scene.routes import mission_lines
from viewer.scene.scene import Scene
from viewer.scene.selection.selected import Selection
from viewer.store.inbox import is_dated, timestamp
from viewer.store.place import UNIT_M, SceneFrame
from viewer.store.store import FleetStore
from viewer.theme.palette import Palette, rgb
from viewer.timeline.past import PastVehicle, update_past_arrays, vehicle_at
from viewer.timeline.recording import UavRecording
from viewer.timeline.recordings import RecordingStore

MAX_FRAMES, FRAME_S = 400, 0.1  # most frames of an animation, and duration of each [s]
ASPECT = 1.6  # aspect ratio for the camera [-]


def flight_html(
    store: FleetStore,
    recordings: RecordingStore,
    palette: Palette,
    selected: int,
    on_progress: Callable[[float], None] = lambda _: None,
) -> str:
    """Render every frame of the recording on a hidden server; return the scene as HTML, on the clock of one UAV.

    Args:
        store: the UAVs
        recordings: their recordings
        palette: colours
        selected: the UAV
        on_progress: called with the progress, 0..1
    Raises:
        ValueError: when there is no recording of it yet; wait for its first sample.
    """
    fleet = {vehicle.uav: vehicle for vehicle in store.all() if len(recordings.by_uav.get(vehicle.uav, ()))}
    if selected not in fleet:
        raise ValueError(f"export: found no recording of uav-{selected}, expected a flight; wait for its samples")
    span, shift = recordings.playback_range(fleet[selected], list(fleet.values()))
    times = np.linspace(span.begin, span.end, int(np.clip((span.end - span.begin) / 0.5, 2, MAX_FRAMES)))

    def fleet_at(t: float) -> list[PastVehicle]:
        pasts = (vehicle_at(v, recordings.by_uav[uav], t + shift.get(uav, 0.0)) for uav, v in fleet.items())
        return [past for past in pasts if past is not None]

    server = serve("127.0.0.1", 0)
    try:
        scene = _AnimationScene(server, store, palette, selected)
        scene.look_at([past for t in times[[0, len(times) // 2, -1]] for past in fleet_at(float(t))])
        serializer = server.get_scene_serializer()
        for k, t in enumerate(times):
            scene.draw(fleet_at(float(t)))
            serializer.insert_sleep(FRAME_S)
            on_progress((k + 1) / len(times))
        text = serializer.as_html(dark_mode=palette.dark)
    finally:
        stop_server(server)
    return text.replace("<title>Viser</title>", "<title>ParaUAV: a flight</title>", 1)


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
        route = mission_lines(vehicle.mission, scene_frame, ground)
        self._selection.draw_route(vehicle, route, self._camera_view, unit)
        tags = self._selection.tags
        tags[:1] = [tag._replace(text=f"{tag.text} · {timestamp(vehicle.shown_t)}") for tag in tags[:1]]
        self._labels.draw([*tags, *self._selection.marks], self._camera_view)


COLUMNS = (
    *("t_s", "utc", "lat_deg", "lon_deg", "alt_m", "phi_deg", "theta_deg", "psi_deg", "Va_m_s"),
    *("state", "mode", "armed", "link", "fit_percent", "horizon_s", "predicted_at_s", "alerts"),
)
FORMULA = ("=", "+", "-", "@", "\t", "\r")  # first characters of a formula in a spreadsheet


def table(recording: UavRecording, scene_frame: SceneFrame) -> str:
    """Return every recorded row of a UAV with its state as CSV with a header; times [s since 1970], angles [deg]."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    n = len(recording)
    t, x = recording.t[:n].copy(), recording.x[:n].astype(float)
    ned = x[:, [1, 0, 2]] * [UNIT_M, UNIT_M, -UNIT_M]
    for at, row, (lat, lon, alt) in zip(t, x, to_geodetic(scene_frame.origin, ned), strict=True):
        angles_deg = np.degrees(row[3:6])
        when = datetime.fromtimestamp(at, UTC).isoformat(timespec="milliseconds") if is_dated(at) else ""
        where = [f"{at:.3f}", when, f"{lat * 1e-7:.7f}", f"{lon * 1e-7:.7f}", f"{alt * 1e-3:.2f}"]
        motion = [f"{value:.2f}" for value in (*angles_deg, row[6])]
        writer.writerow([*where, *motion, *_state_fields(recording, float(at))])
    return out.getvalue()


def _state_fields(recording: UavRecording, t: float) -> list[str]:
    record = recording.state_at(t)
    forecast = next((prediction for prediction in reversed(recording.predictions) if prediction.t <= t), None)
    horizon = [f"{forecast.horizon_s:.1f}", f"{forecast.t:.3f}"] if forecast is not None else ["", ""]
    if record is None:
        return ["", "", "", "", "", *horizon, ""]
    alerts = "; ".join(alert.sentence for alert in record.alerts.values())
    fit = "" if record.fit is None else f"{record.fit:.0f}"
    fields = [record.state.value, record.mode, "armed" if record.armed else "disarmed", record.link.value, fit]
    return [escape_formula(field) for field in (*fields, *horizon, alerts)]


def escape_formula(text: str) -> str:
    """Prefix received text with an apostrophe when a spreadsheet would read it as a formula."""
    return f"'{text}" if text.startswith(FORMULA) and not text.lstrip("+-").replace(".", "", 1).isdecimal() else text


MAX_SIDE_PX = 2_560  # longest side of an image that browsers render [pixels]
TIMEOUT_S = 20.0  # software rendering is slow [s]


def picture(client: Any, palette: Palette) -> bytes:
    """Request the rendered view of a page as PNG.

    Raises:
        TimeoutError: when the page does not answer; keep it in the foreground.
    """
    camera = client.camera
    width, height = max(camera.image_width, 16), max(camera.image_height, 16)
    share = min(1.0, MAX_SIDE_PX / max(width, height))
    rendered = client.get_render(int(height * share), int(width * share), transport_format="png", timeout=TIMEOUT_S)
    return png(rendered, palette)


def png(rendered: np.ndarray, palette: Palette) -> bytes:
    """Blend a rendered view (h, w, 3 or 4) with the sky and encode it as PNG."""
    top, bottom = rgb(palette.sky[0]), rgb(palette.sky[1])
    w = (np.linspace(0, 1, len(rendered)) ** 1.2)[:, None, None]
    sky = np.broadcast_to(top * (1 - w) + bottom * w, (*rendered.shape[:2], 3))
    alpha = rendered[..., 3:4] / 255.0 if rendered.shape[2] == 4 else np.ones((1, 1, 1))
    mixed = np.rint(rendered[..., :3] * alpha + sky * (1 - alpha)).astype(np.uint8)
    out = io.BytesIO()
    Image.fromarray(mixed).save(out, "PNG", optimize=True)
    return out.getvalue()


class Export:
    """Three buttons on one page; each creates a file and sends it to the browser."""

    def __init__(
        self,
        client: Any,
        store: FleetStore,
        recordings: RecordingStore,
        palette: Palette,
        selected_uav: Callable[[], int | None],
    ) -> None:
        self._client, self._store, self._recordings = client, store, recordings
        self._palette, self._selected_uav = palette, selected_uav
        gui = client.gui
        for label, icon, make in (
            ("View as PNG", viser.Icon.CAMERA, self._picture),
            ("Flight as HTML", viser.Icon.MOVIE, self._film),
            ("Selected UAV as CSV", viser.Icon.TABLE, self._table),
        ):
            gui.add_button(label, icon=icon).on_click(lambda _, make=make: self._export(make))
        self._status = gui.add_html("")

    def _export(self, make: Callable[[], tuple[str, bytes]]) -> None:
        """Create a file and send it; show errors on the page."""
        self._set_status("exporting …")
        try:
            name, data = make()
        except (ValueError, OSError) as error:
            return self._set_status(str(error))
        self._client.send_file_download(name, data, save_immediately=True)
        self._set_status(f"{name}, {len(data) / 1e6:.1f} MB")

    def _set_status(self, text: str) -> None:
        self._status.content = f'<div class="uav soft">{escape(text)}</div>'

    def _uav(self) -> int:
        if (uav := self._selected_uav()) is None:
            raise ValueError("export: found no selection, expected a UAV; click a row or an aircraft")
        return uav

    def _picture(self) -> tuple[str, bytes]:
        return f"{self._name('view')}.png", picture(self._client, self._palette)

    def _film(self) -> tuple[str, bytes]:
        uav = self._uav()

        def on_progress(share: float) -> None:
            self._set_status(f"exporting: {share:.0%}")

        text = flight_html(self._store, self._recordings, self._palette, uav, on_progress)
        return f"{self._name(f'uav-{uav}')}.html", text.encode()

    def _table(self) -> tuple[str, bytes]:
        uav, scene_frame = self._uav(), self._recordings.scene_frame
        recording = self._recordings.by_uav.get(uav)
        if recording is None or scene_frame is None or not len(recording):
            raise ValueError(f"export: found no recording of uav-{uav}, expected a flight; wait for its samples")
        return f"{self._name(f'uav-{uav}')}.csv", table(recording, scene_frame).encode()

    def _name(self, what: str) -> str:
        """Return a file name with its content and the newest data time."""
        recordings = list(self._recordings.by_uav.values())
        newest = max((recording.t[-1] for recording in recordings if len(recording)), default=0.0)
        return f"parauav-{what}-{timestamp(float(newest))}".replace(":", "").replace(" ", "-").replace("+", "")
