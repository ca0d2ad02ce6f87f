"""What is kept of everyone, once for all who look."""

from collections.abc import Callable

import numpy as np

from viewer.store.place import Place
from viewer.store.store import Feed
from viewer.store.vehicle import Vehicle
from viewer.timeline.player import Span
from viewer.timeline.recording import GAP_S, KEPT_S, TOLD_S, Tape

APART_S = 3600.0  # recordings that begin farther apart are of different days, and are laid beside each other [s]
FEW, CROWD = 50, 300  # UAVs up to which five rows a second are kept; one a second, and predictions 5 s apart
FEW_S, MANY_S = 0.15, 0.9  # least time between two looks [s]
NO_TRAIL = np.zeros((0, 5))


class Tapes:
    """A tape for every UAV."""

    def __init__(self) -> None:
        self.of: dict[int, Tape] = {}
        self.place: Place | None = None
        self.apart_s = TOLD_S  # between two predictions kept of one UAV [s]
        self._due, self._turn = -np.inf, False

    def take(self, feed: Feed, copies: Callable[[], list[Vehicle]], now: float) -> None:
        """Keep how everyone is now, as often as their number allows; `copies` gives them."""
        if feed.place is not self.place:
            self.place = feed.place
            self.of.clear()
        if now < self._due:
            return
        fleet = copies()
        self._due = now + (FEW_S if len(fleet) <= FEW else MANY_S)
        self.apart_s = TOLD_S * max(len(fleet) / CROWD, 1.0)  # of a crowd fewer, in the same memory
        self._turn, crowd = not self._turn, len(fleet) > CROWD
        for vehicle in fleet[self._turn :: 2] if crowd else fleet:
            tape = self.of.setdefault(vehicle.uav, Tape())
            behind = not crowd and (not len(tape) or vehicle.t - tape.t[-1] > GAP_S)
            tape.take(vehicle, feed.trail(vehicle) if behind else NO_TRAIL, now, self.apart_s)

    def nbytes(self) -> int:
        """Count what is kept."""
        return sum(tape.nbytes() for tape in list(self.of.values()))

    def measure(self, lead: Vehicle, fleet: list[Vehicle]) -> tuple[Span, dict[int, float]]:
        """Find what can be shown, on the clock of one UAV.

        Args:
            lead: whose clock it is
            fleet: everyone with a tape
        Returns:
            the span, and by how much the clocks of recordings of other days are ahead of it [s]
        """
        tapes = {one.uav: self.of[one.uav] for one in fleet}
        zero = tapes[lead.uav].t[0]
        ahead = {one.uav: float(tapes[one.uav].t[0] - zero) for one in fleet if one.recorded}
        shift = {uav: t for uav, t in ahead.items() if abs(t) > APART_S}
        end = max(tape.t[-1] - shift.get(uav, 0.0) for uav, tape in tapes.items())
        begin = min(tape.t[0] - shift.get(uav, 0.0) for uav, tape in tapes.items())
        return Span(float(begin if lead.recorded else max(begin, end - KEPT_S)), float(end)), shift
