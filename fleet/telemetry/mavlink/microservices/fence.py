"""Collect the fence items on board from downloads, by the mission protocol with mission type 1.

An upload by any ground station is seen by its acknowledgement; the items are then downloaded again.
Source: MAVLink "Mission Protocol", MAV_MISSION_TYPE_FENCE.
"""

from typing import Any

from fleet.contract import MAX_ITEMS, Item
from fleet.telemetry.mavlink.microservices.route import read_item

FENCE_TYPE = 1  # MAV_MISSION_TYPE_FENCE
_ACCEPTED, _UNSUPPORTED = 0, 3  # MAV_MISSION_RESULT


class FenceCollector:
    """Fence items of one aircraft.

    Attributes:
        items: of the last complete download
        needs_download: the list has to be requested
        supported: the autopilot has not refused fence items
    """

    def __init__(self) -> None:
        self.items: tuple[Item, ...] = ()
        self.needs_download, self.supported = True, True
        self._count: int | None = None  # of the download in progress
        self._received: dict[int, Item] = {}
        self._opaque_id = 0  # identifies the list on board, where the autopilot reports it

    def process(self, message: Any, *, is_upload: bool) -> None:
        """Process one message of mission type 1; `is_upload` if a ground station sent it."""
        name = message.get_type()
        if name == "MISSION_CLEAR_ALL" and is_upload:
            self.needs_download = True
        if is_upload:
            return
        if name == "MISSION_COUNT":
            self._start(message.count, getattr(message, "opaque_id", 0))
        elif name in ("MISSION_ITEM", "MISSION_ITEM_INT") and self._count is not None:
            if message.seq < self._count:
                self._received[message.seq] = read_item(message)[0]
            self._finish_if_complete()
        elif name == "MISSION_ACK":
            self.supported &= message.type != _UNSUPPORTED
            self.needs_download |= message.type == _ACCEPTED

    def missing(self) -> list[int]:
        """Return the missing sequence numbers of the download in progress; empty without one."""
        return [] if self._count is None else [seq for seq in range(self._count) if seq not in self._received]

    def abort_download(self) -> None:
        """Discard a stalled download."""
        self._count = None

    def _start(self, count: int, opaque_id: int) -> None:
        if count > MAX_ITEMS:
            self.needs_download = False
            return
        if opaque_id and opaque_id == self._opaque_id and count == len(self.items):
            self.needs_download = False
            return
        if count != self._count:
            self._count, self._received = count, {}
        self._opaque_id = opaque_id
        self._finish_if_complete()

    def _finish_if_complete(self) -> None:
        if self._count is None or len(self._received) < self._count:
            return
        self.items = tuple(self._received[seq] for seq in range(self._count))
        self.needs_download, self._count, self._received = False, None, {}
