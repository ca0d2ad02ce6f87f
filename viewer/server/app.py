"""Viewer process: one store, one render thread and one view per client."""

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import viser

from fleet.bus.bus_protocol import Bus
from viewer.browser.browser import Browser
from viewer.scene.camera import IN_VIEW_M, near, start_at
from viewer.scene.fleet_arrays import MINUTE, Flock
from viewer.scene.routes import home_alt_m
from viewer.scene.selection.selected import BEYOND_S
from viewer.scene.terrain.land import Land
from viewer.server.view import View
from viewer.store.backfill import FEW, Bygone
from viewer.store.place import UNIT_M
from viewer.store.store import Feed
from viewer.store.track import placed
from viewer.store.vehicle import Vehicle
from viewer.theme.palette import DARK, LIGHT
from viewer.timeline.recordings import Tapes

_log = logging.getLogger(__name__)
TICK_S = 0.1
SECOND = 10  # ticks of a second
MOST_CLOSE = 50  # UAVs of a large fleet with alerts that are decoded every time
SLOW_S = 10.0  # interval between requests for missing messages [s]


class App:
    """Draw the store: aircraft at 10 Hz, in a large fleet at 5 Hz, everything else more slowly."""

    def __init__(self, bus: Bus, server: viser.ViserServer, *, light: bool = False, land: Land | None = None) -> None:
        self._palette = LIGHT if light else DARK
        self.feed, self.flock, self._server = Feed(bus), Flock(), server
        self._bygone = Bygone(bus, self.feed)
        self.tapes, self._land = Tapes(), land or Land(None, None)
        self.views: dict[int, View] = {}  # by client
        self._unfit: set[int] = set()  # clients whose page could not be opened
        self._wake = threading.Event()
        self._ground, self._cloud = 0.0, np.zeros((0, 3))
        start_at(server)

    def run(self, stop: threading.Event) -> None:
        """Draw until `stop` is set."""
        asker = threading.Thread(target=self._ask, args=(stop,), name="viewer-ask", daemon=True)
        asker.start()
        tick, due = 0, time.monotonic()
        while not stop.is_set():
            self.tick(tick)
            tick, due = tick + 1, due + TICK_S
            if (late := time.monotonic() - due) > TICK_S:
                due += late
            while (left := due - time.monotonic()) > 0:
                if self._wake.wait(left):
                    self._wake.clear()
                    self.answer()
        asker.join(timeout=5)

    def _ask(self, stop: threading.Event) -> None:
        """Request messages published before the start, repeatedly while some are missing."""
        while not stop.is_set():
            fleet = self.feed.all()
            if not fleet or any(v.mission is None or v.model is None for v in fleet):
                with contextlib.suppress(OSError, RuntimeError):
                    self.feed.catch_up()
            for _ in range(int(SLOW_S)):
                self._bygone.ask()
                if stop.wait(1.0):
                    return

    def tick(self, tick: int) -> None:
        """Draw the content due at this tick."""
        if not (self.flock.crowd and tick % 2):
            self.feed.listen()
        self._welcome()
        if tick % SECOND and not self.views:
            return  # no client: 1 Hz is enough for the trails
        now = time.monotonic()
        if tick % SECOND == 0 or not self.flock.uavs:
            self._second(now)
        elif tick % 2 == 0 and self.flock.uavs and not self.flock.crowd:
            self.tapes.take(self.feed, self.feed.all, now)
        if self.flock.crowd and tick % 2:
            return
        self.flock.pose(self.feed, now)
        for view in list(self.views.values()):
            guarded(view, partial(self._draw, view, now, tick))

    def _draw(self, view: View, now: float, tick: int) -> None:
        """Draw the content due on one page."""
        if tick % SECOND == view.offset or view.dirty:
            self._settle(view, now)
        if self.flock.uavs:
            view.move(self.flock, now, tick)

    def _settle(self, view: View, now: float) -> None:
        """Draw the slow content of one page."""
        self._land.show(view.client, self.feed.place, view.palette, self._ground)
        view.panels.ground_said = self._land.sentence
        view.scene.ground.grid.show(not self._land.lies)
        view.settle(self.flock, now, self._ground)
        if len(self._cloud):
            view.frame(self._cloud, self._news(), self._ground)

    def answer(self) -> None:
        """Draw new selections immediately; lists and charts follow at the next tick."""
        now = time.monotonic()
        for view in list(self.views.values()):
            if view.dirty:
                guarded(view, partial(view.turn, self.flock, now, self._ground))

    def _welcome(self) -> None:
        """Open views for new clients, remove those of closed clients, redraw after a theme change."""
        clients = self._server.get_clients()
        for gone in self.views.keys() - clients.keys():
            del self.views[gone]
        self._unfit &= clients.keys()
        for number in clients.keys() - self.views.keys() - self._unfit:
            self._open(number, Browser(clients[number], self._palette, self._wake.set))
        for number, view in list(self.views.items()):
            if view.browser.palette is not view.palette:
                self._open(number, view.browser, view)

    def _open(self, number: int, browser: Browser, before: View | None = None) -> None:
        """Open a view, or replace one; after a failure the page stays closed until it reconnects."""
        try:
            with browser.client.atomic():
                if before is not None:
                    browser.client.scene.reset()
                    browser.client.gui.reset()
                    self._land.forget(number)
                view = View(browser, self.feed, self.tapes, browser.palette, self._wake.set)
        except Exception:  # an error on one page must not end the others
            self._unfit.add(number)
            self.views.pop(number, None)
            _log.exception("page %d could not be opened; other pages continue; reload it", number)
            return
        view.offset = number * 4 % SECOND
        if before is not None:
            view.carry(before)
        self.views[number] = view

    def _second(self, now: float) -> None:
        """Update the fleet, its states and trails; called once per second."""
        fleet, place = self.feed.all(), self.feed.place
        self.tapes.take(self.feed, lambda: fleet, now)
        if not self.flock.uavs:
            self.flock.meet(fleet, now)
            self.flock.pose(self.feed, now)
        needy = [self.flock.uavs[i] for i in np.flatnonzero(self.flock.exceptions)[:MOST_CLOSE]]
        chosen = [view.selected for view in self.views.values() if view.selected is not None]
        self.feed.inbox.keen, self.feed.close = frozenset(chosen), frozenset((*needy, *chosen))
        played = [(v, rows) for v in fleet if v.recorded and len(rows := self.feed.track(v))]
        self.flock.beat({v.uav: placed(rows, v.t - MINUTE, np.inf) for v, rows in [*played, *self._off_beat(fleet)]})
        self.flock.meet(fleet, now)
        if place is None or not self.flock.uavs:
            return
        self._ground = guess_ground(fleet, place.origin.alt_mm * 1e-3, self._ground)
        told = [] if self.flock.crowd else [v.forecast for v in fleet if v.forecast is not None]
        ahead = [one.at(np.linspace(0, max(one.until, BEYOND_S), 8)) for one in told]
        paths = [rows[:, 1:] for _, rows in played]
        self._cloud = near(np.vstack([self.flock.at, *ahead, *paths]), IN_VIEW_M / UNIT_M)
        if not self.views:
            start_at(self._server, self._cloud)

    def _off_beat(self, fleet: list[Vehicle]) -> list[tuple[Vehicle, np.ndarray]]:
        """Return the tracks of UAVs that are not in real time or were just backfilled."""
        early, few = self._bygone.news(), len(fleet) <= FEW
        found = [v for v in fleet if not v.recorded and (v.uav in early or (few and v.time.pace != 1.0))]
        return [(v, rows) for v in found if len(rows := self.feed.track(v))]

    def _news(self) -> tuple:
        """Return the values whose change requires new framing."""
        fleet, place = self.flock.fleet, self.feed.place
        told = sum(v.forecast is not None for v in fleet)
        return place.origin if place else None, len(self.flock.uavs), told, sum(v.ended for v in fleet)


def guarded(view: View, draw: Callable[[], None]) -> None:
    """Draw on one page; show and log an error there without affecting other pages."""
    try:
        draw()
    except Exception as error:
        if view.stumble(f"{type(error).__name__}: {error}"):
            _log.exception("page %d could not be drawn; other pages continue", view.client.client_id)


def guess_ground(fleet: list[Vehicle], origin_m: float, before: float) -> float:
    """Estimate ground height: lowest home, else lowest disarmed height, else 60 m below all, scene [10 m]."""
    homes = [alt for vehicle in fleet if (alt := home_alt_m(vehicle.mission)) is not None]
    if homes:
        return (min(homes) - origin_m) / UNIT_M
    if floors := [vehicle.floor for vehicle in fleet if np.isfinite(vehicle.floor)]:
        return min([*floors, *(float(v.at[2]) for v in fleet if v.at is not None)]) - 0.05
    return min([before, *(float(v.at[2]) - 6.0 for v in fleet if v.at is not None)])
