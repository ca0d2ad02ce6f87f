"""Backfill: request earlier telemetry from the gateways once and prepend it to the received path."""

import contextlib
import time

from fleet.bus.bus_protocol import Bus
from fleet.contract import History
from viewer.store.received.inbox import SampleSubset
from viewer.store.store import FleetStore
from viewer.store.vehicle import Vehicle

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
