"""Forwarding of raw MAVLink between aircraft and other ground stations.

Broadcasts of an aircraft go to every station; its messages to one station go to that station. Messages of a station to
one aircraft go only to the link on which that aircraft was last received; its broadcasts go to all aircraft. Messages
are not forwarded between aircraft, between stations, or back to the sender.
Source: MAVLink routing guide.
"""

from collections import Counter
from collections.abc import Hashable, Iterable, Sequence

import numpy as np

from fleet.telemetry.mavlink.parsing.decode import Frames
from fleet.telemetry.mavlink.parsing.scan import START, STOP
from gateway.forwarding.routes import Port, Routes
from gateway.forwarding.targets import targets
from gateway.links.link import Link

DATAGRAM = 1_400  # size limit of combined messages: below the MTU of common networks [bytes]
ASTRAY = "not forwarded: target unknown"
DOUBLE = "not forwarded: another sender uses this component id"


class Forward:
    """Forwarding between the links of aircraft and the links of stations.

    Args:
        links: all links, those of aircraft first
        stations: number of links to stations, the last ones
        listen_only: send nothing to aircraft
    """

    def __init__(self, links: Sequence[Link], stations: int, listen_only: bool = False) -> None:
        self._links, self._listen_only = links, listen_only
        self._air, self._ground = range(len(links) - stations), range(len(links) - stations, len(links))
        self._aircraft, self._stations = Routes(), Routes()
        self.forwarded = 0  # messages
        self.refused: Counter[str] = Counter()  # by reason

    def take(self, link: int, frames: Frames) -> list[tuple[int, Frames]]:
        """Forward the frames of one link; return those sent to aircraft by stations: (link of the aircraft, frames)."""
        if link in self._ground:
            return self._up(link, frames)
        if self._ground:
            self._down(link, frames)
        return []

    def part(self, link: int, where: Hashable) -> None:
        """Remove a peer that has disconnected."""
        (self._stations if link in self._ground else self._aircraft).part(link, where)

    def tidy(self, now: float) -> None:
        """Remove peers after `ROUTE_TIMEOUT_S` of silence; `now` is fleet time [s since 1970]."""
        self._aircraft.forget(now)
        self._stations.forget(now)

    def _down(self, link: int, frames: Frames) -> None:
        """Forward frames of aircraft to the stations."""
        owned = self._aircraft.learn(link, frames)
        if not owned.all():
            self.refused[DOUBLE] += int((~owned).sum())
        frames = frames.only(owned)
        system, component = targets(frames)
        meant: dict[Port, list[int]] = {}
        for i in np.flatnonzero(system).tolist():
            for port in self._stations.to(int(system[i]), int(component[i])):
                meant.setdefault(port, []).append(i)
        for number in self._ground:
            kept = self._links[number].spec.sieve.keep(frames.at)
            to_all = kept & (system == 0)
            for where in self._ends(number, self._stations):
                mine = to_all.copy()
                mine[[i for i in meant.get(Port(number, where), []) if kept[i]]] = True
                self._send(Port(number, where), frames, np.flatnonzero(mine))

    def _up(self, link: int, frames: Frames) -> list[tuple[int, Frames]]:
        """Forward frames of stations to the aircraft."""
        self._stations.learn(link, frames)
        if self._listen_only:
            return []
        meant: dict[Port, list[int]] = {}
        for i, (system, component) in enumerate(zip(*map(np.ndarray.tolist, targets(frames)), strict=True)):
            ports = self._aircraft.to(system, component) if system else self._everybody()
            if system and not ports:
                self.refused[ASTRAY] += 1
            for port in ports:
                meant.setdefault(port, []).append(i)
        heard: dict[int, set[int]] = {}
        for port, which in meant.items():
            self._send(port, frames, which)
            heard.setdefault(port.link, set()).update(which)
        return [(number, frames.only(np.array(sorted(which)))) for number, which in heard.items()]

    def _everybody(self) -> list[Port]:
        return [Port(number, where) for number in self._air for where in self._ends(number, self._aircraft)]

    def _ends(self, number: int, routes: Routes) -> Iterable[Hashable]:
        spoke = routes.ports(number)
        if self._links[number].spec.kind == "udpbcast" and spoke:
            return spoke  # peers that answered replace the broadcast address
        return dict.fromkeys([*self._links[number].greets, *spoke])

    def _send(self, port: Port, frames: Frames, which: Sequence[int] | np.ndarray) -> None:
        """Send raw frames, several per datagram."""
        waiting, count = bytearray(), 0
        for start, stop in frames.at[np.asarray(which, int)][:, (START, STOP)].tolist():
            if count and len(waiting) + stop - start > DATAGRAM:
                self._links[port.link].send(port.where, bytes(waiting), count)
                waiting, count = bytearray(), 0
            waiting += frames.buf[start:stop].tobytes()
            count += 1
            self.forwarded += 1
        if count:
            self._links[port.link].send(port.where, bytes(waiting), count)
