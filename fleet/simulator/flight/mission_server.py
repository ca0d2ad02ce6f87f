"""Mission protocol of a simulated autopilot: download, and upload as ArduPilot and PX4 receive it.

ArduPilot shortens its mission at MISSION_COUNT and writes every item in place; it repeats a request after 1 s and ends
an upload after 8 s of silence, which leaves a mixture of both missions. Item 0 is home and not written. PX4 stores the
items aside and replaces its mission when all have arrived; it repeats a request after 0.25 s and gives up after 5 s.
Source: MAVLink services, "Mission Protocol"; ArduPilot `MissionItemProtocol`; PX4 `MavlinkMissionManager`.
"""

from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.contract import Item

MAX_STORED_ITEMS = 700  # items that fit the storage of the autopilot


class UploadedMission(NamedTuple):
    """A received mission, and the item that the sender marked as the current one; None: none."""

    items: tuple[Item, ...]
    seq: int | None


class _Upload:
    """An upload in progress."""

    def __init__(self, count: int, partner: tuple[int, int], now: float) -> None:
        self.count, self.partner = count, partner
        self.items: list[Item] = []
        self.current: int | None = None
        self.received_t = self.requested_t = now


class MissionServer:
    """Mission storage of one autopilot with its protocol.

    Args:
        items: the mission on board
        is_px4: as PX4, otherwise as ArduPilot
    """

    def __init__(self, items: tuple[Item, ...], is_px4: bool) -> None:
        self.items, self._is_px4 = items, is_px4
        self.fence: tuple[Item, ...] = ()
        self._upload: _Upload | None = None
        self._retry_s, self._timeout_s = (0.25, 5.0) if is_px4 else (1.0, 8.0)
        self._received: UploadedMission | None = None

    def take_upload(self) -> UploadedMission | None:
        """Return the mission that was received completely since the last call; None: none."""
        received, self._received = self._received, None
        return received

    def poll(self, now: float) -> list[Any]:
        """Return repeated requests and the end of an upload at `now` [s]."""
        upload = self._upload
        if upload is None:
            return []
        if now - upload.received_t > self._timeout_s:
            self._upload = None
            return [] if self._is_px4 else [_ack(upload.partner, mav.MAV_MISSION_OPERATION_CANCELLED)]
        if now - upload.requested_t < self._retry_s:
            return []
        return [self._request(upload, now)]

    def receive(self, message: Any, now: float) -> list[Any]:
        """Process one message of the mission protocol at `now` [s] and return the replies."""
        name, sender = message.get_type(), (message.get_srcSystem(), message.get_srcComponent())
        if message.mission_type != 0:  # fence items can be read, rally points there are none
            stored = self.fence if message.mission_type == mav.MAV_MISSION_TYPE_FENCE else ()
            if name == "MISSION_REQUEST_LIST":
                return [mav.MAVLink_mission_count_message(*sender, len(stored), message.mission_type)]
            if name == "MISSION_REQUEST_INT" and message.seq < len(stored):
                return [_item_message(stored[message.seq], message, sender)]
            return [_ack(sender, mav.MAV_MISSION_UNSUPPORTED, message.mission_type)]
        if name == "MISSION_COUNT":
            return self._start(message.count, sender, now)
        if name in ("MISSION_ITEM_INT", "MISSION_ITEM"):
            return self._add(message, sender, now)
        if name == "MISSION_REQUEST_LIST":
            return self._count(sender)
        return self._item(message, sender)

    def _count(self, sender: tuple[int, int]) -> list[Any]:
        if self._upload is not None:
            return [] if self._is_px4 else [_ack(sender, mav.MAV_MISSION_DENIED)]
        return [mav.MAVLink_mission_count_message(*sender, len(self.items), 0)]

    def _item(self, message: Any, sender: tuple[int, int]) -> list[Any]:
        if message.seq >= len(self.items):
            return [_ack(sender, mav.MAV_MISSION_INVALID_SEQUENCE)]
        return [_item_message(self.items[message.seq], message, sender)]

    def _start(self, count: int, sender: tuple[int, int], now: float) -> list[Any]:
        upload = self._upload
        if upload is not None and upload.partner != sender:
            return [_ack(sender, mav.MAV_MISSION_DENIED)]
        if count > MAX_STORED_ITEMS:
            return [_ack(sender, mav.MAV_MISSION_NO_SPACE)]
        if upload is not None and self._is_px4 and upload.items:
            return []
        self._upload = _Upload(count, sender, now)
        if not self._is_px4:
            self.items = self.items[: max(count, 1)]
        return [self._request(self._upload, now)] if count else self._finish(self._upload)

    def _request(self, upload: _Upload, now: float) -> Any:
        upload.requested_t = now
        make = mav.MAVLink_mission_request_int_message if self._is_px4 else mav.MAVLink_mission_request_message
        return make(*upload.partner, len(upload.items), 0)

    def _add(self, message: Any, sender: tuple[int, int], now: float) -> list[Any]:
        upload = self._upload
        if upload is None or upload.partner != sender:
            return [_ack(sender, mav.MAV_MISSION_ERROR)]
        if message.seq != len(upload.items):
            return [] if self._is_px4 else [_ack(sender, mav.MAV_MISSION_INVALID_SEQUENCE)]
        item = _read(message)
        upload.items.append(item)
        upload.received_t = now
        if message.current == 1:
            upload.current = item.seq
        if not self._is_px4 and item.seq:  # in place; item 0 is home
            self.items = (*self.items[: item.seq], item, *self.items[item.seq + 1 :])
        return [self._request(upload, now)] if len(upload.items) < upload.count else self._finish(upload)

    def _finish(self, upload: _Upload) -> list[Any]:
        if self._is_px4:
            self.items = tuple(upload.items)
        self._received, self._upload = UploadedMission(self.items, upload.current), None
        text = mav.MAVLink_statustext_message(mav.MAV_SEVERITY_INFO, b"Flight plan received")
        return [_ack(upload.partner, mav.MAV_MISSION_ACCEPTED), *([] if self._is_px4 else [text])]


def _ack(to: tuple[int, int], result: int, mission_type: int = 0) -> Any:
    return mav.MAVLink_mission_ack_message(*to, result, mission_type)


def _item_message(item: Item, request: Any, to: tuple[int, int]) -> Any:
    """Return an item as requested, with coordinates as integers or floats."""
    head = (*to, item.seq, item.frame, item.command, 0, 1, item.param1, item.param2, item.param3, item.param4)
    if request.get_type() == "MISSION_REQUEST_INT":
        position = (item.lat_e7, item.lon_e7, item.alt_m)
        return mav.MAVLink_mission_item_int_message(*head, *position, request.mission_type)
    return mav.MAVLink_mission_item_message(*head, item.lat_e7 * 1e-7, item.lon_e7 * 1e-7, item.alt_m)


def _read(message: Any) -> Item:
    scale = 1 if message.get_type() == "MISSION_ITEM_INT" else 1e7
    params = {f"param{i}": getattr(message, f"param{i}") for i in range(1, 5)}
    place = {"lat_e7": round(message.x * scale), "lon_e7": round(message.y * scale), "alt_m": float(message.z)}
    return Item(seq=message.seq, command=message.command, frame=message.frame, **params, **place)
