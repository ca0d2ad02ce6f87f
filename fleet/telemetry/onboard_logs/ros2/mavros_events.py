"""Events of a MAVROS bag: mode and arming, mission, parameters, texts, home."""

from math import isfinite
from typing import Any

from fleet.contract import MAX_ITEMS, Item
from fleet.telemetry.mavlink.onboard_log import OnboardEvent

_MAX_EVENTS = 20_000
_PX4_MODES = ("AUTO.", "STABILIZED", "POSCTL", "ALTCTL", "OFFBOARD")
_TEXT_LENGTH = 200


class MavrosEvents:
    """Collector of events, message by message."""

    def __init__(self) -> None:
        self.events: list[OnboardEvent] = []
        self.autopilot = "ardupilot"
        self._latest: dict[str, Any] = {}

    def add(self, topic: str, t: float, message: Any) -> None:
        """Add a message; one with other fields than MAVROS's is ignored.

        Args:
            topic: name after `mavros/`
            t: log time [s]
            message: decoded message
        """
        try:
            for kind, value in self._read(topic, message):
                key = kind if kind != "param" else f"param {value[0]}"
                if len(self.events) < _MAX_EVENTS and (kind == "text" or self._latest.get(key) != value):
                    self._latest[key] = value
                    self.events.append(OnboardEvent(t, kind, value))
        except (AttributeError, TypeError, ValueError, OverflowError):
            return

    def _read(self, topic: str, message: Any) -> list[tuple[str, Any]]:
        if topic == "state":
            mode = str(message.mode)[:_TEXT_LENGTH]
            if mode.startswith(_PX4_MODES):
                self.autopilot = "px4"
            return [("mode", mode), ("armed", bool(message.armed))]
        if topic == "mission/waypoints":
            items = tuple(_item(seq, waypoint) for seq, waypoint in enumerate(message.waypoints[:MAX_ITEMS]))
            return [("mission", items)] if items else []
        if topic == "param/event":
            value = message.value
            number = float(value.double_value if value.type == 3 else value.integer_value)  # ParameterType
            return [("param", (str(message.param_id)[:16], number))] if isfinite(number) else []
        if topic == "home_position/home":
            return []  # above the ellipsoid: of no use to altitudes above sea level
        return [("text", (int(message.severity), str(message.text)[:_TEXT_LENGTH]))]


def _item(seq: int, waypoint: Any) -> Item:
    logged = (waypoint.param1, waypoint.param2, waypoint.param3, waypoint.param4)
    params = [float(value) if isfinite(value) else 0.0 for value in logged]
    lat, lon, alt = float(waypoint.x_lat), float(waypoint.y_long), float(waypoint.z_alt)
    if not (abs(lat) <= 90 and abs(lon) <= 180 and isfinite(alt)):
        raise ValueError(f"mission item {seq}: found {lat}, {lon}, {alt}, expected a position on earth")
    return Item.at((lat, lon, alt), seq=seq, command=int(waypoint.command), frame=int(waypoint.frame), params=params)
