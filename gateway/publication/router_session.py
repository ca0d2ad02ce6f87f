"""Session with the bus router: counters of messages published, unsent and unconfirmed."""

import logging
import time
from collections import deque
from collections.abc import Callable, Sequence

from fleet.bus.bus_protocol import Bus
from fleet.bus.codec import EncodedMessage, Stamp

LEASE_S = 1.0  # time after which an unresponsive router counts as lost [s]

_log = logging.getLogger(__name__)


class RouterSession:
    """Send packed messages and count the published and the unsent ones.

    Args:
        bus: destination
        clock: any monotonic clock [s]
    """

    def __init__(self, bus: Bus, clock: Callable[[], float] = time.monotonic) -> None:
        self._router = bus.router
        self.published = 0  # sent to a connected router
        self.unsent = 0  # no router was connected
        self.unconfirmed = 0  # of those published: within a lease before the router was lost
        self._bus, self._clock = bus, clock
        if not self._router:
            _log.warning("no router is connected yet: unsent messages are counted, everything else continues")
        self._published_at: deque[tuple[float, int]] = deque([(clock(), 0)])  # time, and messages published until then

    @property
    def connected(self) -> bool:
        """Return whether a router was connected at the last poll."""
        return bool(self._router)

    def poll(self) -> bool:
        """Return whether a router has connected since the last poll; call it a few times a second."""
        now, previous = self._clock(), self._router
        self._router = self._bus.router
        if previous and self._router != previous:
            self.unconfirmed += self.published - self._published_at[0][1]
            _log.warning("the router is disconnected: unsent messages are counted, everything else continues")
        reconnected = bool(self._router) and self._router != previous
        if reconnected:
            _log.warning("the router is connected; %d messages were unsent so far", self.unsent)
        self._published_at.append((now, self.published))
        while len(self._published_at) > 1 and self._published_at[1][0] <= now - LEASE_S:
            self._published_at.popleft()
        return reconnected

    def send(self, wires: Sequence[EncodedMessage], stamp: Stamp | None = None) -> None:
        """Send messages, or count them as unsent without a router."""
        if not self._router:
            self.unsent += len(wires)
            return
        for wire in wires:
            self._bus.put(wire, stamp)
        self.published += len(wires)
