"""The way to the bus: what was given to a router, what nobody got, and what may not have arrived."""

import logging
import time
from collections import deque
from collections.abc import Callable, Sequence

from fleet.bus.bus_protocol import Bus
from fleet.bus.codec import Stamp, Wire

LEASE_S = 1.0  # a router that stops answering is missed after this long [s]

_log = logging.getLogger(__name__)


class Way:
    """Send packed messages and count what becomes of them.

    Args:
        bus: where to
        clock: any that only goes forward [s]
    """

    def __init__(self, bus: Bus, clock: Callable[[], float] = time.monotonic) -> None:
        self._router = bus.router
        self.published = 0  # given to a router that was there
        self.unsent = 0  # nobody was there
        self.unsure = 0  # of those published: within a lease before a router was missed
        self._bus, self._clock = bus, clock
        if not self._router:
            _log.warning("no router is there yet: what is not on the bus is counted, everything else goes on")
        self._marks: deque[tuple[float, int]] = deque([(clock(), 0)])  # when so many had been published

    @property
    def joined(self) -> bool:
        """Return whether a router was there at the last look."""
        return bool(self._router)

    def look(self) -> bool:
        """Return whether a router has come since the last look; ask a few times a second."""
        now, before = self._clock(), self._router
        self._router = self._bus.router
        if before and self._router != before:
            self.unsure += self.published - self._marks[0][1]
            _log.warning("the router is away: what is not on the bus is counted, everything else goes on")
        came = bool(self._router) and self._router != before
        if came:
            _log.warning("the router is there; %d messages so far found none", self.unsent)
        self._marks.append((now, self.published))
        while len(self._marks) > 1 and self._marks[1][0] <= now - LEASE_S:
            self._marks.popleft()
        return came

    def send(self, wires: Sequence[Wire], stamp: Stamp | None = None) -> None:
        """Send messages, or count that nobody was there."""
        if not self._router:
            self.unsent += len(wires)
            return
        for wire in wires:
            self._bus.put(wire, stamp)
        self.published += len(wires)
