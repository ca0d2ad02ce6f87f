"""Forwarding of raw MAVLink between aircraft and other ground stations.

Broadcasts of an aircraft go to every station; its messages to one station go to that station. Messages of a station to
one aircraft go only to the link on which that aircraft was last received; its broadcasts go to all aircraft. Messages
are not forwarded between aircraft, between stations, or back to the sender.
Source: MAVLink routing guide.
"""

from collections import Counter
from collections.abc import Hashable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.telemetry.mavlink.aircraft_link import LINK_LOST_S
from fleet.telemetry.mavlink.parsing.decode import Frames, layout
from fleet.telemetry.mavlink.parsing.scan import COMPONENT, EXTRA, ID, PAYLOAD, SIZE, START, STOP, SYSTEM
from gateway.links.link import Endpoint

ROUTE_TIMEOUT_S = 60.0  # silence after which a route is removed [s]


class Port(NamedTuple):
    """One peer of one link."""

    link: int
    where: Hashable


class Routes:
    """Routes from received frames; the first sender of a component id owns it until it is silent."""

    def __init__(self) -> None:
        self._routes: dict[tuple[int, int], tuple[Port, float]] = {}  # port, and time of its last frame [s since 1970]

    def update(self, link: int, frames: Frames) -> np.ndarray:
        """Update routes from frames of one link; return whether each sender owns its component id, (n,) bool."""
        key = (frames.sender << 16) + (frames.headers[:, SYSTEM] << 8) + frames.headers[:, COMPONENT]
        keys, last, number = np.unique(key[::-1], return_index=True, return_inverse=True)
        arrivals = frames.arrival[::-1][last].tolist()
        owns = [
            self._claim(Port(link, frames.senders[one >> 16]), (one >> 8 & 0xFF, one & 0xFF), arrival)
            for one, arrival in zip(keys.tolist(), arrivals, strict=True)
        ]
        return np.array(owns, bool)[number[::-1]]

    def _claim(self, port: Port, component_key: tuple[int, int], arrival: float) -> bool:
        owner, last_t = self._routes.get(component_key, (port, arrival))
        if owner != port and arrival - last_t < LINK_LOST_S:
            return False
        self._routes[component_key] = port, arrival
        return True

    def ports_of(self, system: int, component: int) -> list[Port]:
        """Return the ports of a component; component 0: of all components of the system."""
        if component:
            return [self._routes[system, component][0]] if (system, component) in self._routes else []
        return list(dict.fromkeys(port for (owner, _), (port, _) in self._routes.items() if owner == system))

    def peers(self, link: int) -> list[Hashable]:
        """Return the peers of one link that have sent frames."""
        return list(dict.fromkeys(port.where for port, _ in self._routes.values() if port.link == link))

    def remove_peer(self, link: int, where: Hashable) -> None:
        """Remove the routes of a peer that has disconnected."""
        self._routes = {key: route for key, route in self._routes.items() if route[0] != Port(link, where)}

    def remove_silent(self, now: float) -> None:
        """Remove routes after `ROUTE_TIMEOUT_S` of silence; `now` is fleet time [s since 1970]."""
        self._routes = {key: route for key, route in self._routes.items() if now - route[1] <= ROUTE_TIMEOUT_S}


ABSENT = -1


def _field_offsets(field: str) -> np.ndarray:
    offsets = np.full(len(EXTRA), ABSENT)
    for number, kind in dialect.mavlink_map.items():
        if field in kind.fieldnames:
            offsets[number] = layout(kind.msgname).fields[field][1]  # type: ignore[index]
    return offsets


_SYSTEM, _COMPONENT = _field_offsets("target_system"), _field_offsets("target_component")


def targets(frames: Frames) -> tuple[np.ndarray, np.ndarray]:
    """Return the target system and component of every frame, (n,) each; 0: broadcast."""
    return _read_field(frames, _SYSTEM), _read_field(frames, _COMPONENT)


def _read_field(frames: Frames, offsets: np.ndarray) -> np.ndarray:
    frame_offsets, values = offsets[frames.headers[:, ID]], np.zeros(len(frames.headers), np.int64)
    sent = frame_offsets < frames.headers[:, SIZE]  # trailing zeros are not
    present = np.flatnonzero((frame_offsets != ABSENT) & sent)
    values[present] = frames.buf[frames.headers[present, PAYLOAD] + frame_offsets[present]]
    return values


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
