"""Viewer process: one store, one render thread, one view per client, backfill of tracks."""

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from functools import partial
from math import isfinite

import numpy as np
import viser

from fleet.bus.session import Bus
from fleet.contract import Approval, History
from fleet.terrain.areas import Area
from viewer.browser.http_server import Browser
from viewer.panels.approval import ApprovalDialog
from viewer.scene.camera import IN_VIEW_M, set_initial_view, within_reach
from viewer.scene.fleet_arrays import TRAIL_AGES_S, FleetArrays
from viewer.scene.routes import home_alt_m
from viewer.scene.selection.selected import BEYOND_S
from viewer.scene.terrain import TerrainLayer
from viewer.server.view import View
from viewer.store.inbox import SampleSubset
from viewer.store.place import UNIT_M
from viewer.store.store import FleetStore
from viewer.store.track import positions_at
from viewer.store.vehicle import Vehicle
from viewer.theme.palette import DARK, LIGHT
from viewer.timeline.recordings import RecordingStore

SMALL_FLEET = 60  # UAVs up to which all are backfilled; in a larger fleet only the selected ones
TIMEOUT_S = 2.0  # wait for a gateway that does not answer [s]
MAX_SAMPLES = 4_000  # newest samples used of one answer


class Backfill:
    """Requests history on its own thread; the render thread takes the results."""

    def __init__(self, bus: Bus, store: FleetStore) -> None:
        self._bus, self._store = bus, store
        self._requested: set[int] = set()
        self._filled: set[int] = set()

    def request(self) -> None:
        """Request the history of UAVs not requested yet, one at a time, as a gateway serves no more."""
        if self._store.scene_frame is None:
            return
        uavs = self._store.uavs
        targets = uavs if len(uavs) <= SMALL_FLEET else uavs & self._store.inbox.full_rate_uavs
        for uav in sorted(targets - self._requested):
            self._requested.add(uav)
            with contextlib.suppress(OSError, RuntimeError):
                for history in self._bus.get_stream(History, uav, b"", TIMEOUT_S):
                    self._prepend_history(history)

    def _prepend_history(self, history: History) -> None:
        """Process a history in a separate vehicle and prepend its path to the received one."""
        scene_frame, past_vehicle = self._store.scene_frame, Vehicle(history.uav)
        if scene_frame is None:
            return
        for sample in sorted(history.samples[-MAX_SAMPLES:], key=lambda item: item.t):
            with contextlib.suppress(ValueError, IndexError, TypeError, OverflowError):  # skip a malformed sample
                subset = SampleSubset(sample.uav, sample.t, sample.attitude, sample.position, sample.air)
                past_vehicle.update_from_sample(subset, scene_frame, time.monotonic())
        vehicle = self._store.get(history.uav)
        if vehicle is None or scene_frame is not self._store.scene_frame:
            return
        with self._store.lock:  # a snapshot shares its histories with the original
            vehicle.track.prepend(past_vehicle.track.rows())
            vehicle.trail.prepend(past_vehicle.trail.rows())
        self._filled.add(history.uav)

    def take_filled(self) -> frozenset[int]:
        """Return the UAVs backfilled since the last call."""
        filled, self._filled = frozenset(self._filled), set()
        return filled


_log = logging.getLogger(__name__)
TICK_S = 0.1
TICKS_PER_S = 10  # ticks of a second
MAX_IMMEDIATE = 50  # UAVs of a large fleet with alerts that are decoded every time
REQUEST_S = 10.0  # interval between requests for missing messages [s]


Approver = tuple[Callable[[Approval], None], str]
"""Publishes an approval with the credentials of an operator, and the name of the person."""


class App:
    """Draw the store: aircraft at 10 Hz, in a large fleet at 5 Hz, everything else more slowly."""

    def __init__(
        self,
        bus: Bus,
        server: viser.ViserServer,
        *,
        light: bool = False,
        terrain_layer: TerrainLayer | None = None,
        areas: tuple[Area, ...] = (),
        approver: Approver | None = None,
    ) -> None:
        self._palette, self._approver = LIGHT if light else DARK, approver
        self.store, self.fleet_arrays, self._server = FleetStore(bus), FleetArrays(), server
        self._backfill = Backfill(bus, self.store)
        self.recordings, self._terrain_layer = RecordingStore(), terrain_layer or TerrainLayer(None, None)
        self.views: dict[int, View] = {}  # by client
        self._areas = areas
        self._failed_clients: set[int] = set()  # clients whose page could not be opened
        self._wake = threading.Event()
        self._ground_height, self._framing_points = 0.0, np.zeros((0, 3))
        set_initial_view(server)

    def run(self, stop: threading.Event) -> None:
        """Draw until `stop` is set."""
        requester = threading.Thread(target=self._request_loop, args=(stop,), name="viewer-ask", daemon=True)
        requester.start()
        tick, due = 0, time.monotonic()
        while not stop.is_set():
            self.tick(tick)
            tick, due = tick + 1, due + TICK_S
            if (late := time.monotonic() - due) > TICK_S:
                due += late
            while (remaining_s := due - time.monotonic()) > 0:
                if self._wake.wait(remaining_s):
                    self._wake.clear()
                    self.draw_selections()
        requester.join(timeout=5)

    def _request_loop(self, stop: threading.Event) -> None:
        """Request messages published before the start, repeatedly while some are missing."""
        while not stop.is_set():
            fleet = self.store.all()
            if not fleet or any(v.mission is None or v.model is None for v in fleet):
                with contextlib.suppress(OSError, RuntimeError):
                    self.store.request_latest()
            for _ in range(int(REQUEST_S)):
                self._backfill.request()
                if stop.wait(1.0):
                    return

    def tick(self, tick: int) -> None:
        """Draw the content due at this tick."""
        if not (self.fleet_arrays.large_fleet and tick % 2):
            self.store.poll()
        self._update_clients()
        if tick % TICKS_PER_S and not self.views:
            return  # no client: 1 Hz is enough for the trails
        now = time.monotonic()
        if tick % TICKS_PER_S == 0 or not self.fleet_arrays.uavs:
            self._update_fleet(now)
        elif tick % 2 == 0 and self.fleet_arrays.uavs and not self.fleet_arrays.large_fleet:
            self.recordings.record(self.store, self.store.all, now)
        if self.fleet_arrays.large_fleet and tick % 2:
            return
        self.fleet_arrays.update_poses(self.store, now)
        for view in list(self.views.values()):
            draw_guarded(view, partial(self._draw, view, now, tick))

    def _draw(self, view: View, now: float, tick: int) -> None:
        """Draw the content due on one page."""
        if tick % TICKS_PER_S == view.offset or view.dirty:
            self._terrain_layer.show(view.client, self.store.scene_frame, view.palette, self._ground_height)
            self._terrain_layer.show_world(view.client.client_id, view.panels.world.value)
            view.panels.ground_error = self._terrain_layer.sentence
            view.scene.ground.grid.show(not self._terrain_layer.available)
            view.draw_slow(self.fleet_arrays, now, self._ground_height)
            if len(self._framing_points):
                view.frame_fleet(self._framing_points, self._framing_key(), self._ground_height)
        if self.fleet_arrays.uavs:
            view.draw_moving(self.fleet_arrays, now, tick)

    def draw_selections(self) -> None:
        """Draw new selections immediately; lists and charts follow at the next tick."""
        now = time.monotonic()
        for view in list(self.views.values()):
            if view.dirty:
                draw_guarded(view, partial(view.draw_selection, self.fleet_arrays, now, self._ground_height))

    def _update_clients(self) -> None:
        """Open views for new clients, remove those of closed clients, redraw after a theme change."""
        clients = self._server.get_clients()
        for departed in self.views.keys() - clients.keys():
            del self.views[departed]
            self._terrain_layer.reset_client(departed)
        self._failed_clients &= clients.keys()
        for client_id in clients.keys() - self.views.keys() - self._failed_clients:
            self._open_view(client_id, Browser(clients[client_id], self._palette, self._wake.set))
        for client_id, view in list(self.views.items()):
            if view.browser.palette is not view.palette:
                self._open_view(client_id, view.browser, view)

    def _open_view(self, client_id: int, browser: Browser, previous: View | None = None) -> None:
        """Open a view, or replace one; after a failure the page stays closed until it reconnects."""
        try:
            with browser.client.atomic():
                if previous is not None:
                    browser.client.scene.reset()
                    browser.client.gui.reset()
                    self._terrain_layer.reset_client(client_id)
                approvals = None if self._approver is None else ApprovalDialog(self.store, *self._approver)
                view = View(browser, self.store, self.recordings, self._wake.set, approvals)
        except Exception:  # an error on one page must not end the others
            self._failed_clients.add(client_id)
            self.views.pop(client_id, None)
            _log.exception("page %d could not be opened; other pages continue; reload it", client_id)
            return
        view.heights, view.areas = self._terrain_layer.heights, self._areas
        view.offset = client_id * 4 % TICKS_PER_S
        if previous is not None:
            view.restore(previous)
        self.views[client_id] = view

    def _update_fleet(self, now: float) -> None:
        """Update the fleet, its states and trails; called once per second."""
        fleet, scene_frame = self.store.all(), self.store.scene_frame
        self.recordings.record(self.store, lambda: fleet, now)
        if not self.fleet_arrays.uavs:
            self.fleet_arrays.update_fleet(fleet, now)
            self.fleet_arrays.update_poses(self.store, now)
        exceptional = [self.fleet_arrays.uavs[i] for i in np.flatnonzero(self.fleet_arrays.exceptions)[:MAX_IMMEDIATE]]
        selected = [view.selected for view in self.views.values() if view.selected is not None]
        self.store.inbox.full_rate_uavs = frozenset(selected)
        self.store.immediate_uavs = frozenset((*exceptional, *selected))
        backfilled, is_small = self._backfill.take_filled(), len(fleet) <= SMALL_FLEET
        played = [(v, rows) for v in fleet if v.recorded and len(rows := self.store.track(v))]
        uneven = [v for v in fleet if not v.recorded and (v.uav in backfilled or (is_small and v.time.rate != 1.0))]
        tracks = [*played, *((v, rows) for v in uneven if len(rows := self.store.track(v)))]
        self.fleet_arrays.extend_trails({v.uav: positions_at(rows, v.t - TRAIL_AGES_S, np.inf) for v, rows in tracks})
        self.fleet_arrays.update_fleet(fleet, now)
        if scene_frame is None or not self.fleet_arrays.uavs:
            return
        self._ground_height = estimate_ground(fleet, scene_frame.origin.alt_mm * 1e-3, self._ground_height)
        forecasts = [] if self.fleet_arrays.large_fleet else [v.forecast for v in fleet if v.forecast is not None]
        paths = [f.position_at(np.linspace(0, max(f.horizon_s, BEYOND_S), 8)) for f in forecasts]
        paths += [rows[:, 1:] for _, rows in played]
        self._framing_points = within_reach(np.vstack([self.fleet_arrays.at, *paths]), IN_VIEW_M / UNIT_M)
        if not self.views:
            set_initial_view(self._server, self._framing_points)

    def _framing_key(self) -> tuple:
        """Return the values whose change requires new framing."""
        fleet, scene_frame = self.fleet_arrays.fleet, self.store.scene_frame
        counts = len(self.fleet_arrays.uavs), sum(v.forecast is not None for v in fleet), sum(v.ended for v in fleet)
        return scene_frame.origin if scene_frame else None, *counts


def draw_guarded(view: View, draw: Callable[[], None]) -> None:
    """Draw on one page; show and log an error there without affecting other pages."""
    try:
        draw()
    except Exception as error:
        if view.show_error(f"{type(error).__name__}: {error}"):
            _log.exception("page %d could not be drawn; other pages continue", view.client.client_id)


def estimate_ground(fleet: list[Vehicle], origin_m: float, previous: float) -> float:
    """Estimate ground height: lowest home, else lowest disarmed height, else 60 m below all, scene [10 m]."""
    homes = [alt for vehicle in fleet if (alt := home_alt_m(vehicle.mission)) is not None]
    if homes:
        return (min(homes) - origin_m) / UNIT_M
    if floors := [vehicle.floor for vehicle in fleet if isfinite(vehicle.floor)]:
        return min([*floors, *(float(v.at[2]) for v in fleet if v.at is not None)]) - 0.05
    return min([previous, *(float(v.at[2]) - 6.0 for v in fleet if v.at is not None)])
