"""Backfill: request earlier telemetry from the gateways once and prepend it to the received path."""

import contextlib
import time

from fleet.bus.bus_protocol import Bus
from fleet.contract import History
from viewer.store.received.inbox import Head
from viewer.store.store import Feed
from viewer.store.vehicle import Vehicle

FEW = 60  # UAVs up to which all are backfilled; in a larger fleet only the selected ones
ASK_S = 2.0  # wait for a gateway that does not answer [s]
MOST = 4_000  # newest samples used of one answer


class Bygone:
    """Requests history on its own thread; the render thread takes the results."""

    def __init__(self, bus: Bus, feed: Feed) -> None:
        self._bus, self._feed = bus, feed
        self._asked: set[int] = set()
        self._laid: set[int] = set()

    def ask(self) -> None:
        """Request the history of UAVs not requested yet, one at a time, as a gateway serves no more."""
        if self._feed.place is None:
            return
        known = self._feed.known
        wanted = known if len(known) <= FEW else known & self._feed.inbox.keen
        for uav in sorted(wanted - self._asked):
            self._asked.add(uav)
            with contextlib.suppress(OSError, RuntimeError):
                for said in self._bus.gather(History, uav, b"", ASK_S):
                    self._lay(said)

    def _lay(self, said: History) -> None:
        """Process a history in a separate vehicle and prepend its path to the received one."""
        place, early = self._feed.place, Vehicle(said.uav)
        if place is None:
            return
        for sample in sorted(said.samples[-MOST:], key=lambda one: one.t):
            with contextlib.suppress(ValueError, IndexError, TypeError, OverflowError):  # skip a malformed sample
                head = Head(sample.uav, sample.t, sample.attitude, sample.position, sample.air)
                early.hear_sample(head, place, time.monotonic())
        found = self._feed.one(said.uav)
        if found is None or place is not self._feed.place:
            return
        with self._feed.lock:  # a snapshot shares its histories with the original
            found.track.lay_before(early.track.rows())
            found.trail.lay_before(early.trail.rows())
        self._laid.add(said.uav)

    def news(self) -> frozenset[int]:
        """Return the UAVs backfilled since the last call."""
        laid, self._laid = frozenset(self._laid), set()
        return laid
