"""What was flown before the page listened: asked of the gateways once, and laid before what was heard."""

import contextlib
import time

from fleet.bus.bus_protocol import Bus
from fleet.contract import History
from viewer.store.received.inbox import Head
from viewer.store.store import Feed
from viewer.store.vehicle import Vehicle

FEW = 60  # UAVs up to which everybody's past is asked for; of more that of those somebody looks at
ASK_S = 2.0  # with a gateway that does not answer [s]
MOST = 4_000  # samples read of one answer, the newest


class Bygone:
    """Asks on a thread of its own; who draws takes the news."""

    def __init__(self, bus: Bus, feed: Feed) -> None:
        self._bus, self._feed = bus, feed
        self._asked: set[int] = set()
        self._laid: set[int] = set()

    def ask(self) -> None:
        """Ask for the past of those it was not asked of yet, one by one; a gateway gives no more at once."""
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
        """Hear it as if it came now, in a vehicle of its own, and lay that one's path before what was heard."""
        place, early = self._feed.place, Vehicle(said.uav)
        if place is None:
            return
        for sample in sorted(said.samples[-MOST:], key=lambda one: one.t):
            with contextlib.suppress(ValueError, IndexError, TypeError, OverflowError):  # a strange one is left out
                head = Head(sample.uav, sample.t, sample.attitude, sample.position, sample.air)
                early.hear_sample(head, place, time.monotonic())
        found = self._feed.one(said.uav)
        if found is None or place is not self._feed.place:
            return
        with self._feed.lock:  # a copy shares its histories with the one it is of
            found.track.lay_before(early.track.rows())
            found.trail.lay_before(early.trail.rows())
        self._laid.add(said.uav)

    def news(self) -> frozenset[int]:
        """Take those whose past came since this was last asked."""
        laid, self._laid = frozenset(self._laid), set()
        return laid
