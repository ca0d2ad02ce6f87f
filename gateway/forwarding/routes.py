"""Routing table: the peer and link of each MAVLink system and component."""

from collections.abc import Hashable
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.telemetry.mavlink.aircraft_link import LINK_LOST_S
from fleet.telemetry.mavlink.parsing.decode import Frames, layout
from fleet.telemetry.mavlink.parsing.scan import COMPONENT, EXTRA, ID, PAYLOAD, SIZE, SYSTEM

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
            self._claim(
                Port(link, frames.senders[packed_key >> 16]), (packed_key >> 8 & 0xFF, packed_key & 0xFF), arrival
            )
            for packed_key, arrival in zip(keys.tolist(), arrivals, strict=True)
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
        return list(
            dict.fromkeys(port for (owner_system, _), (port, _) in self._routes.items() if owner_system == system)
        )

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
    present = np.flatnonzero(
        (frame_offsets != ABSENT) & (frame_offsets < frames.headers[:, SIZE])
    )  # trailing zeros are not transmitted
    values[present] = frames.buf[frames.headers[present, PAYLOAD] + frame_offsets[present]]
    return values
