"""Export a flight as one self-contained HTML file with the 3-D scene."""

from collections.abc import Callable
from typing import Any

import numpy as np

from viewer.browser.http_server import quiet, serve
from viewer.scene.camera import FOV, IN_VIEW_M, frame, near, start_at
from viewer.scene.fleet_arrays import Flock
from viewer.scene.labels import Labels, Sight
from viewer.scene.routes import route
from viewer.scene.scene import Scene
from viewer.scene.selection.selected import Selection
from viewer.store.place import UNIT_M
from viewer.store.received.datatime import stamp
from viewer.store.store import Feed
from viewer.theme.palette import Palette
from viewer.timeline.past import Past, as_it_was, remember
from viewer.timeline.recordings import Tapes

FRAMES, FRAME_S = 400, 0.1  # most frames of an animation, and duration of each [s]
ASPECT = 1.6  # aspect ratio for the camera [-]


class Film:
    """Render every frame on a hidden server and serialise the scene."""

    def __init__(self, feed: Feed, tapes: Tapes, palette: Palette) -> None:
        self._feed, self._tapes, self._palette = feed, tapes, palette

    def html(self, selected: int, told: Callable[[float], None] = lambda _: None) -> str:
        """Return the recording as HTML, on the clock of one UAV.

        Args:
            selected: the UAV
            on_progress: called with the progress, 0..1
        Raises:
            ValueError: when there is no recording of it yet; wait for its first sample.
        """
        fleet = [one for one in self._feed.all() if len(self._tapes.of.get(one.uav, ()))]
        lead = next((one for one in fleet if one.uav == selected), None)
        if lead is None:
            raise ValueError(f"export: found no recording of uav-{selected}, expected a flight; wait for its samples")
        span, shift = self._tapes.measure(lead, fleet)
        times = np.linspace(span.begin, span.end, int(np.clip((span.end - span.begin) / 0.5, 2, FRAMES)))
        server = serve("127.0.0.1", 0)
        try:
            stage = _Stage(server, self._feed, self._palette, selected)
            frames = [self._pasts(fleet, shift, t) for t in times[[0, len(times) // 2, -1]]]
            stage.look_at([past for pasts in frames for past in pasts])
            serializer = server.get_scene_serializer()
            for k, t in enumerate(times):
                stage.draw(self._pasts(fleet, shift, float(t)))
                serializer.insert_sleep(FRAME_S)
                told((k + 1) / len(times))
            text = serializer.as_html(dark_mode=self._palette.dark)
        finally:
            with quiet():
                server.stop()
        return text.replace("<title>Viser</title>", "<title>ParaUAV: a flight</title>", 1)

    def _pasts(self, fleet: list[Any], shift: dict[int, float], t: float) -> list[Past]:
        found = (as_it_was(one, self._tapes.of[one.uav], t + shift.get(one.uav, 0.0)) for one in fleet)
        return [past for past in found if past is not None]


class _Stage:
    """Scene of the animation."""

    def __init__(self, server: Any, feed: Feed, palette: Palette, selected: int) -> None:
        self._server, self._feed, self._selected = server, feed, selected
        self._scene, self._flock = Scene(server.scene, palette, lambda _: None), Flock()
        self._selection, self._labels = Selection(server.scene, palette), Labels(server.scene)
        self._sight = Sight(np.zeros(3), np.ones(3), float(FOV), ASPECT)

    def look_at(self, pasts: list[Past]) -> None:
        """Frame all positions and paths."""
        paths = [past.tape.path(-np.inf, np.inf)[:, 1:] for past in pasts]
        cloud = near(np.vstack([*paths, np.zeros((0, 3))]), IN_VIEW_M / UNIT_M)
        ground = min(float(cloud[:, 2].min()) - 0.5, 0.0)
        self._scene.ground.raise_to(ground)
        cloud = np.vstack([cloud, cloud * [1, 1, 0] + [0, 0, ground]])
        start_at(self._server, cloud)
        self._sight = Sight(*frame(cloud, ASPECT), float(FOV), ASPECT)

    def draw(self, pasts: list[Past]) -> None:
        """Draw one frame."""
        flock, scene, sight = self._flock, self._scene, self._sight
        remember(flock, pasts, 0.0)
        if not flock.uavs:
            return
        scene.glyphs.draw(flock)
        scene.glyphs.look(flock, sight, selected=self._selected, size=1.0)
        scene.draw_trails(flock, self._selected)
        scene.draw_heads(flock, self._selected)
        scene.draw_stems(flock)
        scene.draw_alerts(flock)
        scene.draw_predicted(flock, 0.0, self._selected)
        self._draw_chosen(next((past for past in pasts if past.uav == self._selected), None))

    def _draw_chosen(self, chosen: Past | None) -> None:
        place, unit, ground = self._feed.place, self._scene.glyphs.unit, self._scene.ground.height
        if chosen is None or place is None:
            return self._selection.clear()
        self._selection.draw(chosen, self._feed, 0.0, ground=ground, unit=unit)
        self._selection.draw_flight(chosen, self._feed.track(chosen), 0.0, unit)
        self._selection.draw_route(chosen, route(chosen.mission, place, ground), self._sight, unit)
        tags = self._selection.tags
        tags[:1] = [tag._replace(text=f"{tag.text} · {stamp(chosen.then)}") for tag in tags[:1]]
        self._labels.draw([*tags, *self._selection.marks], self._sight)
