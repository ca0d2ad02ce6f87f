"""The page: one server, one render thread, one selection."""

import contextlib
import io
import threading
import time

import numpy as np
import viser
from viser import _messages

from fleet.bus import Bus
from viewer.callouts import Callouts
from viewer.camera import Cameras
from viewer.feed import Feed
from viewer.palette import DARK, LIGHT
from viewer.panels import Panels
from viewer.place import UNIT_M, Place
from viewer.routes import home_alt_m, route
from viewer.scene import MINUTE, Scene
from viewer.selected import BEYOND_S, Selection
from viewer.track import placed
from viewer.vehicle import Vehicle

TICK_S = 0.1
NEAR_M = 800.0  # items of the route within this are shown with an aircraft one turns to [m]
ROOM = 1.35  # how much more than what was flown is framed, while it grows [-]
IN_VIEW_M = 20_000.0  # what is farther from the middle of the fleet is not framed [m]
SLOW_S = 10.0  # how often what is missing is asked for again [s]


def serve(host: str, port: int) -> viser.ViserServer:
    """Open the web server on exactly this port, without the public share tunnel.

    Raises:
        OSError: when the port is taken; viser itself would silently take the next one.
    """
    with quiet():
        server = viser.ViserServer(host=host, port=port, verbose=False)
    for share in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
        server._websock_server.unregister_handler(share)
    if server.get_port() != port:
        with quiet():
            server.stop()
        raise OSError(f"--port: found {port} taken by another program, expected a free one; stop it or name another")
    return server


def quiet() -> contextlib.redirect_stdout:
    """Keep the library's own banner off our output."""
    return contextlib.redirect_stdout(io.StringIO())


class App:
    """Draws what the feed knows: vehicles ten times a second, the rest more slowly."""

    def __init__(self, bus: Bus, server: viser.ViserServer, *, light: bool = False) -> None:
        palette = LIGHT if light else DARK
        self.feed, self._server = Feed(bus), server
        self.scene, self.selection = Scene(server, palette), Selection(server, palette)
        self.panels = Panels(server, palette, self.visit)
        self.cameras, self.callouts = Cameras(server), Callouts(server)
        self.scene.on_click(self.choose)
        self.selected: int | None = None
        self._dirty = threading.Event()
        self._seen: tuple = ()
        self._framed = np.zeros((2, 3))  # corners of what the cameras were last framed on [10 m]
        self._followed: tuple[int, np.ndarray] | None = None
        self._life = 1.2  # how much larger than life an aircraft of size 1 is drawn

    def choose(self, uav: int) -> None:
        """Select a UAV; the next tick shows it."""
        if uav in self.feed.vehicles:
            self.selected = uav
            self._dirty.set()

    def visit(self, uav: int) -> None:
        """Select a UAV that may be out of sight, and turn the cameras to it."""
        self.choose(uav)
        vehicle, place = self.feed.one(uav), self.feed.place
        if vehicle is None or place is None or (at := vehicle.where(time.monotonic())) is None:
            return
        told = [vehicle.forecast.path] if vehicle.forecast is not None else []
        around = route(vehicle.mission, place, self.scene.ground).points[1:]
        close = around[np.linalg.norm(around - at, axis=1) < NEAR_M / UNIT_M]
        self.cameras.fly_to(np.vstack([at, *told, close]))

    def run(self, stop: threading.Event) -> None:
        """Draw until told to stop."""
        asker = threading.Thread(target=self._ask, args=(stop,), name="viewer-ask", daemon=True)
        asker.start()
        tick, due = 0, time.monotonic()
        while not stop.is_set():
            with self._server.atomic():
                self.tick(tick)
            tick, due = tick + 1, due + TICK_S
            if (late := time.monotonic() - due) > TICK_S:
                due += late
            stop.wait(max(due - time.monotonic(), 0.0))
        asker.join(timeout=5)

    def _ask(self, stop: threading.Event) -> None:
        """Ask for what was said before we came, and again while something is missing."""
        while not stop.is_set():
            fleet = self.feed.all()
            if not fleet or any(v.mission is None or v.model is None for v in fleet):
                with contextlib.suppress(OSError, RuntimeError):
                    self.feed.catch_up()
            stop.wait(SLOW_S)

    def tick(self, tick: int) -> None:
        """Draw what is due at this tick; selection changes are drawn at once."""
        if tick % 10 and not self._server.get_clients():
            return  # nobody looks: once a second keeps the trails
        now, fleet, place = time.monotonic(), self.feed.all(), self.feed.place
        if changed := self._dirty.is_set():
            self._dirty.clear()
        if self.selected is None and (known := [v for v in fleet if v.where(now) is not None]):
            self.selected, changed = max(known, key=lambda v: (v.forecast is not None, -v.uav)).uav, True
        if tick % 10 == 0 or changed:
            self.panels.draw(fleet, self.feed, now, self.selected)
        if not fleet or place is None:
            return
        self.scene.vehicles(fleet, now, self.selected)
        if tick % 10 == 0 or changed:
            self._slowly(fleet, now, place, tick)
        if tick % (2 if len(fleet) <= 300 else 10) == 0:
            where = {vehicle.uav: vehicle.at for vehicle in fleet}
            self.scene.heads([where[uav] for uav in self.scene.uavs])
            if self.panels.stems.value:
                self.scene.draw_stems(fleet, now)
        if tick % 2 == 0:
            self.callouts.draw(fleet, now, selected=self.selected, size=self.scene.glyph)
        chosen = self._chosen(fleet)
        if chosen is not None and (tick % 2 == 0 or changed):
            self.selection.draw(chosen, self.feed, now, ground=self.scene.ground, size=self.scene.glyph)
        self._follow(chosen, now)

    def _chosen(self, fleet: list[Vehicle]) -> Vehicle | None:
        return next((vehicle for vehicle in fleet if vehicle.uav == self.selected), None)

    def _slowly(self, fleet: list[Vehicle], now: float, place: Place, tick: int) -> None:
        """Draw trails, predicted paths, routes, ground and camera: once a second, and when the selection changes."""
        options, scene, chosen = self.panels, self.scene, self._chosen(fleet)
        paths = {v.uav: self.feed.track(v) for v in fleet if v.recorded or v is chosen}
        scene.set_ground(_ground(fleet, place, scene.ground))
        if tick % 10 == 0:
            scene.beat(
                fleet,
                {v.uav: placed(paths[v.uav], v.t - MINUTE, np.inf) for v in fleet if v.recorded and len(paths[v.uav])},
            )
        scene.draw_predicted(fleet, now, self.selected if options.tube.value else None)
        scene.predicted.show(options.predicted.value)
        scene.stems.show(options.stems.value)
        for strokes in (*scene.trails, scene.head):
            strokes.show(options.trails.value)
        others = [v for v in fleet if v is not chosen] if options.routes.value else []
        scene.draw_routes([route(v.mission, place, scene.ground) for v in others])
        self.selection.tube = options.tube.value
        if chosen is not None:
            self.selection.draw_flight(chosen, paths[chosen.uav], now, scene.glyph)
        own = route(chosen.mission if chosen else None, place, scene.ground)
        self.selection.draw_route(own, scene.glyph)
        round_route = own.circles.reshape(-1, 3)
        self._frame(fleet, now, place, [own.points, round_route, *(rows[:, 1:] for rows in paths.values())])
        scene.glyph = options.glyph.value * self._life

    def _frame(self, fleet: list[Vehicle], now: float, place: Place, paths: list[np.ndarray]) -> None:
        """Frame fleet, routes, flown and predicted paths when one of them is new or outgrows the frame, or who looks.

        Args:
            fleet: all UAVs
            now: monotonic time [s]
            place: the scene's frame
            paths: the route first, then what was flown, each (n, 3) [10 m]
        """
        at = [spot for v in fleet if (spot := v.where(now)) is not None]
        if not at:
            return
        told = [
            v.forecast.at(np.linspace(0, max(v.forecast.until, BEYOND_S), 8)) for v in fleet if v.forecast is not None
        ]
        cloud = near(np.vstack([np.array(at), *told, *paths]), IN_VIEW_M / UNIT_M)
        seen = (
            place.origin,
            len(at),
            len(told),
            bool(len(paths[0])),
            sum(v.ended for v in fleet),
            self.cameras.watchers(),
        )
        if seen == self._seen and not outgrown(cloud, self._framed):
            return
        grown, self._seen = seen == self._seen, seen
        self._framed = np.stack([cloud.min(axis=0), cloud.max(axis=0)])
        if grown:  # it will go on growing: make room, rather than move the picture every second
            cloud = cloud.mean(axis=0) + (cloud - cloud.mean(axis=0)) * [ROOM, ROOM, 1.0]
        span = float(np.linalg.norm(np.ptp(cloud, axis=0)))
        self._life = float(np.clip(span / 42, 0.25, 12.0))
        self.cameras.show(np.vstack([cloud, cloud * [1, 1, 0] + [0, 0, self.scene.ground]]))

    def _follow(self, chosen: Vehicle | None, now: float) -> None:
        at = chosen.where(now) if chosen is not None and self.panels.follow.value else None
        if chosen is None or at is None:
            self._followed = None
            return
        if self._followed is not None and self._followed[0] == chosen.uav:
            self.cameras.follow(at - self._followed[1])
        self._followed = chosen.uav, at


def near(points: np.ndarray, reach: float) -> np.ndarray:
    """Keep the points (n, 3) within `reach` of the most central one: never none [10 m]."""
    centre = points[np.argmin(np.linalg.norm(points - np.median(points, axis=0), axis=1))]
    return points[np.linalg.norm(points - centre, axis=1) < reach]


def outgrown(cloud: np.ndarray, framed: np.ndarray) -> bool:
    """Tell whether points (n, 3) have left a framed box (2, 3), its corners, by more than what was left free."""
    spare = 0.4 * (ROOM - 1) * max(float(np.linalg.norm(framed[1] - framed[0])), 10.0)
    return bool(((framed[0] - cloud.min(axis=0)) > spare).any() or ((cloud.max(axis=0) - framed[1]) > spare).any())


def _ground(fleet: list[Vehicle], place: Place, before: float) -> float:
    """Guess the ground: the lowest home, else where the lowest stood, else 60 m below all, scene [10 m]."""
    homes = [alt for vehicle in fleet if (alt := home_alt_m(vehicle.mission)) is not None]
    if homes:
        return (min(homes) - place.origin.alt_mm * 1e-3) / UNIT_M
    if floors := [vehicle.floor for vehicle in fleet if np.isfinite(vehicle.floor)]:
        return min([*floors, *(float(v.at[2]) for v in fleet if v.at is not None)]) - 0.05
    return min([before, *(float(v.at[2]) - 6.0 for v in fleet if v.at is not None)])
