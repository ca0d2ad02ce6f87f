"""Routing table: the peer and link of each MAVLink system and component."""

from collections.abc import Hashable
from typing import NamedTuple

import numpy as np

from fleet.telemetry.mavlink.aircraft_link import LOST_S
from fleet.telemetry.mavlink.parsing.decode import Frames
from fleet.telemetry.mavlink.parsing.scan import COMPONENT, SYSTEM

FORGET_S = 60.0  # silence after which a route is removed [s]


class Port(NamedTuple):
    """One peer of one link."""

    link: int
    where: Hashable


class Routes:
    """Routes from received frames; the first sender of a component id owns it until it is silent."""

    def __init__(self) -> None:
        self._of: dict[tuple[int, int], tuple[Port, float]] = {}  # port, and time of its last frame [s since 1970]

    def learn(self, link: int, frames: Frames) -> np.ndarray:
        """Update routes from frames of one link; return whether each sender owns its component id, (n,) bool."""
        key = (frames.sender << 16) + (frames.at[:, SYSTEM] << 8) + frames.at[:, COMPONENT]
        keys, last, number = np.unique(key[::-1], return_index=True, return_inverse=True)
        arrivals = frames.arrival[::-1][last].tolist()
        owns = [
            self._owns(Port(link, frames.senders[one >> 16]), (one >> 8 & 0xFF, one & 0xFF), arrival)
            for one, arrival in zip(keys.tolist(), arrivals, strict=True)
        ]
        return np.array(owns, bool)[number[::-1]]

    def _owns(self, port: Port, who: tuple[int, int], arrival: float) -> bool:
        holder, heard = self._of.get(who, (port, arrival))
        if holder != port and arrival - heard < LOST_S:
            return False
        self._of[who] = port, arrival
        return True

    def to(self, system: int, component: int) -> list[Port]:
        """Return the ports of a component; component 0: of all components of the system."""
        if component:
            return [self._of[system, component][0]] if (system, component) in self._of else []
        return list(dict.fromkeys(port for (one, _), (port, _) in self._of.items() if one == system))

    def ports(self, link: int) -> list[Hashable]:
        """Return the peers of one link that have sent frames."""
        return list(dict.fromkeys(port.where for port, _ in self._of.values() if port.link == link))

    def part(self, link: int, where: Hashable) -> None:
        """Remove the routes of a peer that has disconnected."""
        self._of = {who: held for who, held in self._of.items() if held[0] != Port(link, where)}

    def forget(self, now: float) -> None:
        """Remove routes after `ROUTE_TIMEOUT_S` of silence; `now` is fleet time [s since 1970]."""
        self._of = {who: held for who, held in self._of.items() if now - held[1] <= FORGET_S}
