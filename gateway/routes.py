"""Who is where: which far end of which link speaks for a MAVLink system and component."""

from collections.abc import Hashable
from typing import NamedTuple

import numpy as np

from fleet.telemetry.craft import LOST_S
from fleet.telemetry.decode import Frames
from fleet.telemetry.scan import COMPONENT, SYSTEM

FORGET_S = 60.0  # silence after which a far end is forgotten [s]
MOST = 8192  # far ends remembered


class Port(NamedTuple):
    """One far end of one link."""

    link: int
    where: Hashable


class Routes:
    """Routes learned from what is heard; the first to speak for a component keeps it until it is silent."""

    def __init__(self) -> None:
        self._of: dict[tuple[int, int], Port] = {}
        self._heard: dict[tuple[int, int], float] = {}  # fleet time [s since 1970]
        self._ports: dict[Port, float] = {}

    def learn(self, link: int, frames: Frames) -> np.ndarray:
        """Learn from frames of one link; tells of each whether its sender speaks for its component, (n,) bool."""
        key = (frames.sender << 16) + (frames.at[:, SYSTEM] << 8) + frames.at[:, COMPONENT]
        keys, last, number = np.unique(key[::-1], return_index=True, return_inverse=True)
        arrivals = frames.arrival[::-1][last].tolist()
        owns = [
            self._owns(Port(link, frames.senders[one >> 16]), (one >> 8 & 0xFF, one & 0xFF), arrival)
            for one, arrival in zip(keys.tolist(), arrivals, strict=True)
        ]
        return np.array(owns, bool)[number[::-1]]

    def _owns(self, port: Port, who: tuple[int, int], arrival: float) -> bool:
        self._ports[port] = arrival
        holder = self._of.get(who)
        if holder is not None and holder != port and arrival - self._heard[who] < LOST_S:
            return False
        self._of[who], self._heard[who] = port, arrival
        return True

    def to(self, system: int, component: int) -> list[Port]:
        """Give where a component is, all of a system's for component 0."""
        if component:
            found = self._of.get((system, component))
            return [] if found is None else [found]
        return list(dict.fromkeys(port for (one, _), port in self._of.items() if one == system))

    def ports(self, link: int) -> list[Hashable]:
        """Give the far ends of one link that speak."""
        return [port.where for port in self._ports if port.link == link]

    def part(self, link: int, where: Hashable) -> None:
        """Forget a far end that took its leave."""
        gone = Port(link, where)
        self._ports.pop(gone, None)
        self._of = {who: port for who, port in self._of.items() if port != gone}

    def forget(self, now: float) -> None:
        """Forget who has been silent for long; `now` is fleet time [s since 1970]."""
        old = sorted(self._ports.items(), key=lambda item: -item[1])
        for port, _ in old[MOST:] + [item for item in old[:MOST] if now - item[1] > FORGET_S]:
            self.part(*port)
