"""View of one page: selection, display options and camera of one operator."""

import contextlib
import time
from collections.abc import Callable

import numpy as np
import viser

from viewer.browser.browser import Browser
from viewer.export.panel import Export
from viewer.panels.detail import clip
from viewer.panels.panels import Panels
from viewer.scene.alert_labels import callouts
from viewer.scene.camera import IN_VIEW_M, Camera, near
from viewer.scene.fleet_arrays import LOST, MISMATCH, Flock, look
from viewer.scene.labels import Labels
from viewer.scene.routes import NOTHING, route
from viewer.scene.scene import Scene
from viewer.scene.selection.selected import BEYOND_S, Selection
from viewer.store.place import UNIT_M, Place
from viewer.store.store import Feed
from viewer.store.vehicle import Vehicle
from viewer.theme.palette import Palette
from viewer.timeline.deck import Timeline
from viewer.timeline.recordings import Tapes

WHOLE_S = 3.0  # time without an error after which the error text is removed [s]
SINCE_S = 40.0  # flown path framed with a focused aircraft [s]
ROOM = 1.35  # margin of the frame while the flown path grows [-]


class View:
    """The page of one client: its scene, its panels, its camera, its selection."""

    def __init__(self, browser: Browser, feed: Feed, tapes: Tapes, palette: Palette, wake: Callable[[], None]) -> None:
        client = browser.client
        self.client, self.browser, self._feed, self.palette, self._wake = client, browser, feed, palette, wake
        self.scene = Scene(client.scene, palette, self.choose)
        self.selection, self._labels = Selection(client.scene, palette), Labels(client.scene)
        self.panels = Panels(browser, palette, self.visit, self._actions())
        self.timeline = Timeline(client, feed, tapes, palette, self._stir)
        self.panels.seek = self.timeline.sender()
        with self.timeline.tab("Export", viser.Icon.DOWNLOAD):
            Export(client, feed, tapes, palette, lambda: self.selected)
        self.camera = Camera(client)
        self.selected: int | None = None
        self.dirty = True  # the selection changed and is not drawn yet
        self.offset = 0  # tick of the second at which slow content is drawn
        self._seen: tuple = ()
        self._again = False  # frame again even if the camera was moved
        self._framed = np.zeros((2, 3))  # corners of the box last framed [10 m]
        self._followed: tuple[int, np.ndarray] | None = None
        self._defect, self._stumbled = "", 0.0  # last drawing error and its time, monotonic [s]

    def carry(self, before: "View") -> None:
        """Restore selection, time shown and camera of the view before a theme change."""
        self.selected, self.camera, self.offset = before.selected, before.camera, before.offset
        self.timeline.player = before.timeline.player
        self._seen, self._framed, self._followed = before._seen, before._framed, before._followed

    def stumble(self, defect: str) -> bool:
        """Show a drawing error on the page; return whether it is new."""
        self._stumbled = time.monotonic()
        if defect == self._defect:
            return False
        self._defect = defect
        with contextlib.suppress(RuntimeError, AssertionError):  # the page may be closing
            self.panels.say_broken(
                f"This page could not be drawn ({clip(defect)}) and may show old data; other pages continue. "
                "Reload it; if the error remains, see the log of the viewer."
            )
        return True

    def _recover(self) -> None:
        """Remove the error text once everything is drawn again."""
        if self._defect and time.monotonic() - self._stumbled > WHOLE_S:
            self._defect = ""
            self.panels.say_broken("")

    def _stir(self) -> None:
        """Request an immediate redraw after a change of the time shown."""
        self.dirty = True
        self._wake()

    def _actions(self) -> dict[str, Callable[[], None]]:
        """Return the commands of the palette other than selection."""
        return {
            "Show the whole fleet": self.show_all,
            "Next aircraft with an alert": self.next_exception,
            "Toggle following the selected aircraft": self.toggle_follow,
        }

    def show_all(self) -> None:
        """Frame everything again, even if the camera was moved."""
        self.panels.follow.value = False
        self._seen, self._again = (), True

    def next_exception(self) -> None:
        """Focus on the next UAV with an alert, mismatch or lost link, in the order of ids."""
        needy = [v.uav for v in self._feed.all() if look(v, time.monotonic()) in (MISMATCH, LOST)]
        later = [uav for uav in needy if self.selected is None or uav > self.selected]
        if needy:
            self.visit((later or needy)[0])

    def toggle_follow(self) -> None:
        """Toggle following the selected UAV."""
        self.panels.follow.value = not self.panels.follow.value

    def chosen(self) -> Vehicle | None:
        """Return the selected UAV at the time shown; None when there is none."""
        return self.timeline.one(self.selected) if self.selected is not None else None

    def choose(self, uav: int) -> None:
        """Select a known UAV and draw it immediately."""
        if self._feed.one(uav) is not None:
            self.selected, self.dirty = uav, True
            self.browser.remembered.uav = None
            self.panels.show(self.chosen(), time.monotonic())  # before the slower 3-D content
            self.client.flush()
            self._wake()

    def visit(self, uav: int, t: float | None = None) -> None:
        """Select a UAV, move the camera to it and, if given, show its data time `t` [s since 1970]."""
        if t is not None:
            self.timeline.show(self._feed.all(), uav, t)
        self.choose(uav)
        vehicle, place = self.timeline.one(uav), self._feed.place
        if vehicle is None or place is None or (at := vehicle.where(time.monotonic())) is None:
            return
        told, flown = vehicle.forecast, self._feed.track(vehicle)
        until = max(told.until, BEYOND_S) if told is not None else 0.0
        ahead = [told.at(np.linspace(0, until, 40))] if told is not None else []
        around = np.vstack([at, *ahead, flown[flown[:, 0] > vehicle.clock(time.monotonic()) - SINCE_S, 1:]])
        self.camera.fly_to(np.vstack([around, around * [1, 1, 0] + [0, 0, self.scene.ground.height]]))

    def move(self, flock: Flock, now: float, tick: int) -> None:
        """Draw moving content: aircraft at the full rate, trail heads, stems and the selected UAV more slowly."""
        with self.client.atomic():
            self._move(self.timeline.flock(flock, self.selected, now), now, tick)

    def _move(self, flock: Flock, now: float, tick: int) -> None:
        self.scene.glyphs.draw(flock)
        if tick % (10 if flock.crowd else 2) == 0:
            self.scene.draw_heads(flock, self.selected)
            self.scene.draw_stems(flock)
            self.scene.draw_alerts(flock)
        if tick % 5 == 0 and not self.timeline.player.live:
            self.timeline.draw(self.selected)
        if tick % 2 == 0:
            self._point(flock, now)
        self._follow(now)

    def turn(self, flock: Flock, now: float, ground: float) -> None:
        """Draw the selected UAV immediately: path, route, tube, labels."""
        with self.client.atomic():
            self._draw_chosen(now, ground)
            self._point(self.timeline.flock(flock, self.selected, now), now)
        self.client.flush()

    def _point(self, flock: Flock, now: float) -> None:
        """Draw the selected UAV, scale the aircraft to the camera distance and draw the labels."""
        sight, scene = self.camera.sight(), self.scene
        scene.glyphs.draw(flock)  # another time may have other UAVs
        size = self.panels.glyph.value
        scene.glyphs.look(flock, sight, selected=self.selected, size=size)
        chosen = self.chosen()
        if chosen is None:
            self.selection.clear()
        else:
            self.selection.draw(chosen, self._feed, now, ground=scene.ground.height, unit=scene.glyphs.unit)
        said = [*self.selection.tags, *self.selection.marks[:1], *callouts(flock, self.selected, scene.glyphs.unit)]
        self._labels.draw([*said, *self.selection.marks[1:]], sight)

    def settle(self, flock: Flock, now: float, ground: float) -> None:
        """Draw slow content once per second and on a new selection: trails, predictions, routes, panels."""
        flock = self.timeline.flock(flock, self.selected, now)
        self.dirty = False
        self._recall(flock)
        self.timeline.draw(self.selected)
        self.panels.draw(flock.fleet, self._feed, flock.now, self.selected)
        if (place := self._feed.place) is not None and flock.uavs:
            with self.client.atomic():
                self._draw(flock, now, place, ground)
        self._recover()

    def _draw(self, flock: Flock, now: float, place: Place, ground: float) -> None:
        options, scene = self.panels, self.scene
        scene.ground.raise_to(ground)
        scene.draw_trails(flock, self.selected)
        scene.draw_predicted(flock, now, self.selected if options.tube.value else None)
        scene.predicted.show(options.predicted.value)
        scene.stems.show(options.stems.value)
        for strokes in (*scene.trails, scene.head):
            strokes.show(options.trails.value)
        others = [v for v in flock.fleet if v.uav != self.selected] if options.routes.value else []
        scene.draw_routes([route(v.mission, place, ground) for v in others])
        self.selection.tube = options.tube.value
        self._draw_chosen(now, ground)

    def _recall(self, flock: Flock) -> None:
        """Restore the selection of the browser; without one, select the first UAV with a prediction."""
        remembered = self.browser.remembered
        if flock.index(remembered.uav) is not None:
            self.selected, remembered.uav = remembered.uav, None
        if self.selected is None and (known := [v for v in flock.fleet if flock.index(v.uav) is not None]):
            self.selected = max(known, key=lambda v: (v.forecast is not None, -v.uav)).uav
        remembered.keep(self.selected)

    def _draw_chosen(self, now: float, ground: float) -> None:
        """Draw the selected UAV's flown path and mission."""
        chosen, place = self.chosen(), self._feed.place
        if chosen is None or place is None:
            return
        self.selection.draw_flight(chosen, self._feed.track(chosen), now, self.scene.glyphs.unit)
        own = route(chosen.mission, place, ground)
        self.selection.draw_route(chosen, own, self.camera.sight(), self.scene.glyphs.unit)

    def frame(self, cloud: np.ndarray, seen: tuple, ground: float) -> None:
        """Frame the fleet when its content, its extent or the aspect ratio changes.

        Args:
            points: fleet and predicted paths, (n, 3) [10 m]
            key: values whose change requires new framing
            ground: height of the ground [10 m]
        """
        if not self.timeline.player.live:
            return
        chosen, place = self.chosen(), self._feed.place
        own = route(chosen.mission, place, ground) if chosen is not None and place is not None else NOTHING
        flown = self._feed.track(chosen)[:, 1:] if chosen is not None else NOTHING.points
        cloud = near(np.vstack([cloud, own.points, own.circles.reshape(-1, 3), flown]), IN_VIEW_M / UNIT_M)
        seen = (*seen, bool(len(own.points)), round(self.camera.aspect, 1))
        if seen == self._seen and not outgrown(cloud, self._framed):
            return
        grown, self._seen = seen == self._seen, seen
        self._framed = np.stack([cloud.min(axis=0), cloud.max(axis=0)])
        if grown:  # a growing path gets a margin, so that the camera does not move every second
            cloud = cloud.mean(axis=0) + (cloud - cloud.mean(axis=0)) * [ROOM, ROOM, 1.0]
        with self.client.atomic():
            self.camera.show(np.vstack([cloud, cloud * [1, 1, 0] + [0, 0, ground]]), again=self._again)
        self._again = False

    def _follow(self, now: float) -> None:
        vehicle = self.chosen() if self.panels.follow.value else None
        at = vehicle.where(now) if vehicle is not None else None
        if vehicle is None or at is None:
            self._followed = None
            return
        if self._followed is not None and self._followed[0] == vehicle.uav:
            self.camera.follow(at - self._followed[1])
        self._followed = vehicle.uav, at


def outgrown(cloud: np.ndarray, framed: np.ndarray) -> bool:
    """Return whether points (n, 3) leave a box, corners (2, 3), by more than its margin."""
    spare = 0.4 * (ROOM - 1) * max(float(np.linalg.norm(framed[1] - framed[0])), 10.0)
    return bool(((framed[0] - cloud.min(axis=0)) > spare).any() or ((cloud.max(axis=0) - framed[1]) > spare).any())
