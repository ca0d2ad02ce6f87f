"""Recordings of all UAVs, shared by all pages."""

from collections.abc import Callable

import numpy as np

from viewer.store.place import Place
from viewer.store.store import Feed
from viewer.store.vehicle import Vehicle
from viewer.timeline.player import Span
from viewer.timeline.recording import GAP_S, KEPT_S, TOLD_S, Tape

APART_S = 3600.0  # recordings that start farther apart are shown as simultaneous [s]
FEW, CROWD = 50, 300  # UAVs up to which rows are recorded at 5 Hz; at 1 Hz, with predictions every 5 s
FEW_S, MANY_S = 0.15, 0.9  # shortest time between two records [s]
NO_TRAIL = np.zeros((0, 5))


class Tapes:
    """Recording of every UAV."""

    def __init__(self) -> None:
        self.of: dict[int, Tape] = {}
        self.place: Place | None = None
        self.apart_s = TOLD_S  # between two recorded predictions of one UAV [s]
        self._due, self._turn = -np.inf, False

    def take(self, feed: Feed, copies: Callable[[], list[Vehicle]], now: float) -> None:
        """Record all UAVs at a rate that depends on their number; `copies` returns snapshots."""
        if feed.place is not self.place:
            self.place = feed.place
            self.of.clear()
        if now < self._due:
            return
        fleet = copies()
        self._due = now + (FEW_S if len(fleet) <= FEW else MANY_S)
        self.apart_s = TOLD_S * max(len(fleet) / CROWD, 1.0)  # bounded memory for a large fleet
        self._turn, crowd = not self._turn, len(fleet) > CROWD
        for vehicle in fleet[self._turn :: 2] if crowd else fleet:
            tape = self.of.setdefault(vehicle.uav, Tape())
            behind = not crowd and (not len(tape) or vehicle.t - tape.t[-1] > GAP_S)
            tape.take(vehicle, feed.trail(vehicle) if behind else NO_TRAIL, now, self.apart_s)

    def nbytes(self) -> int:
        """Return the size of all recordings [bytes]."""
        return sum(tape.nbytes() for tape in list(self.of.values()))

    def measure(self, lead: Vehicle, fleet: list[Vehicle]) -> tuple[Span, dict[int, float]]:
        """Compute the available time range on the clock of one UAV.

        Args:
            clock_vehicle: UAV whose clock is used
            fleet: UAVs with a recording
        Returns:
            the range, and the clock offsets of recordings of other days [s]
        """
        tapes = {one.uav: self.of[one.uav] for one in fleet}
        zero = tapes[lead.uav].t[0]
        ahead = {one.uav: float(tapes[one.uav].t[0] - zero) for one in fleet if one.recorded}
        shift = {uav: t for uav, t in ahead.items() if abs(t) > APART_S}
        end = max(tape.t[-1] - shift.get(uav, 0.0) for uav, tape in tapes.items())
        begin = min(tape.t[0] - shift.get(uav, 0.0) for uav, tape in tapes.items())
        return Span(float(begin if lead.recorded else max(begin, end - KEPT_S)), float(end)), shift
