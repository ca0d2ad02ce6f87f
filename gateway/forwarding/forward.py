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
from gateway.forwarding.routes import Port, Routes, targets
from gateway.links.link import Endpoint

MAX_DATAGRAM = 1_400  # size limit of combined messages: below the MTU of common networks [bytes]
NO_TARGET = "not forwarded: target unknown"
DUPLICATE_SENDER = "not forwarded: another sender uses this component id"


class FrameForwarder:
    """Forwarding between the links of aircraft and the links of stations.

    Args:
        links: all links, those of aircraft first
        stations: number of links to stations, the last ones
        listen_only: send nothing to aircraft
    """

    def __init__(self, links: Sequence[Endpoint], stations: int, listen_only: bool = False) -> None:
        self._links, self._listen_only = links, listen_only
        self._air, self._ground = range(len(links) - stations), range(len(links) - stations, len(links))
        self._aircraft, self._stations = Routes(), Routes()
        self.forwarded = 0  # messages
        self.refused: Counter[str] = Counter()  # by reason

    def forward(self, link: int, frames: Frames) -> list[tuple[int, Frames]]:
        """Forward the frames of one link; return those sent to aircraft by stations: (link of the aircraft, frames)."""
        if link in self._ground:
            return self._to_aircraft(link, frames)
        if self._ground:
            self._to_stations(link, frames)
        return []

    def remove_peer(self, link: int, where: Hashable) -> None:
        """Remove a peer that has disconnected."""
        (self._stations if link in self._ground else self._aircraft).remove_peer(link, where)

    def remove_silent(self, now: float) -> None:
        """Remove peers after `ROUTE_TIMEOUT_S` of silence; `now` is fleet time [s since 1970]."""
        self._aircraft.remove_silent(now)
        self._stations.remove_silent(now)

    def _to_stations(self, link: int, frames: Frames) -> None:
        """Forward frames of aircraft to the stations."""
        owned = self._aircraft.update(link, frames)
        if not owned.all():
            self.refused[DUPLICATE_SENDER] += int((~owned).sum())
        frames = frames.subset(owned)
        system, component = targets(frames)
        addressed: dict[Port, list[int]] = {}
        for i in np.flatnonzero(system).tolist():
            for port in self._stations.ports_of(int(system[i]), int(component[i])):
                addressed.setdefault(port, []).append(i)
        for number in self._ground:
            passed = self._links[number].spec.message_filter.passes(frames.headers)
            to_all = passed & (system == 0)
            for where in self._peers(number, self._stations):
                selected = to_all.copy()
                selected[[i for i in addressed.get(Port(number, where), []) if passed[i]]] = True
                self._send(Port(number, where), frames, np.flatnonzero(selected))

    def _to_aircraft(self, link: int, frames: Frames) -> list[tuple[int, Frames]]:
        """Forward frames of stations to the aircraft."""
        self._stations.update(link, frames)
        if self._listen_only:
            return []
        addressed: dict[Port, list[int]] = {}
        for i, (system, component) in enumerate(zip(*map(np.ndarray.tolist, targets(frames)), strict=True)):
            ports = self._aircraft.ports_of(system, component) if system else self._all_aircraft()
            if system and not ports:
                self.refused[NO_TARGET] += 1
            for port in ports:
                addressed.setdefault(port, []).append(i)
        received: dict[int, set[int]] = {}
        for port, which in addressed.items():
            self._send(port, frames, which)
            received.setdefault(port.link, set()).update(which)
        return [(number, frames.subset(np.array(sorted(which)))) for number, which in received.items()]

    def _all_aircraft(self) -> list[Port]:
        return [Port(number, where) for number in self._air for where in self._peers(number, self._aircraft)]

    def _peers(self, number: int, routes: Routes) -> Iterable[Hashable]:
        senders = routes.peers(number)
        if self._links[number].spec.kind == "udpbcast" and senders:
            return senders  # peers that answered replace the broadcast address
        return dict.fromkeys([*self._links[number].known_peers, *senders])

    def _send(self, port: Port, frames: Frames, which: Sequence[int] | np.ndarray) -> None:
        """Send raw frames, several per datagram."""
        datagram, count = bytearray(), 0
        for start, stop in frames.headers[np.asarray(which, int)][:, (START, STOP)].tolist():
            if count and len(datagram) + stop - start > MAX_DATAGRAM:
                self._links[port.link].send(port.where, bytes(datagram), count)
                datagram, count = bytearray(), 0
            datagram += frames.buf[start:stop].tobytes()
            count += 1
            self.forwarded += 1
        if count:
            self._links[port.link].send(port.where, bytes(datagram), count)
