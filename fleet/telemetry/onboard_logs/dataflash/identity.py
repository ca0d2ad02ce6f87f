"""Identify the aircraft of a DataFlash log: system id, vehicle type and firmware."""

import re

from fleet.telemetry.mavlink.heartbeat import FIXED_WING, HELICOPTER, MULTIROTOR, QUADPLANE, UNKNOWN
from fleet.telemetry.mavlink.onboard_log import OnboardEvent
from fleet.telemetry.onboard_logs.dataflash.records import Records

_FIRMWARE = re.compile(r"\b(?:Ardu|APM:)(Plane|Copter|Rover|Sub)\b.*V?\d")
_PLANE_PARAMS = {"TRIM_ARSPD_CM", "AIRSPEED_CRUISE", "LIM_ROLL_CD", "ROLL_LIMIT_DEG", "TECS_CLMB_MAX"}
_COPTER_PARAMS = {"FRAME", "FRAME_CLASS", "ANGLE_MAX", "PILOT_THR_FILT", "WPNAV_SPEED"}
_IDENTIFYING_PARAMS = {"MAV_SYSID", "SYSID_THISMAV", "Q_ENABLE"} | _PLANE_PARAMS | _COPTER_PARAMS


class Identity:
    """Collect the identity of the aircraft from records and events."""

    def __init__(self) -> None:
        self._params: dict[str, float] = {}
        self._kind = ""
        self._frame = ""
        self._names: set[str] = set()
        self.firmware = ""

    def update(self, block: list[Records], events: list[OnboardEvent]) -> None:
        """Evaluate a block."""
        self._names.update(
            f"{records.format_.name}.{column}"
            for records in block
            for column in records.format_.columns
            if records.format_.name in ("CTUN", "MOT")
        )
        for event in events:
            if event.kind == "param" and event.value[0] in _IDENTIFYING_PARAMS:
                self._params[event.value[0]] = event.value[1]
            elif event.kind == "text":
                self._update_from_text(event.value[1])

    @property
    def system(self) -> int:
        """Return the MAVLink system id, 1 if not in the log."""
        value = self._params.get("MAV_SYSID", self._params.get("SYSID_THISMAV", 1.0))
        return int(value) if 1 <= value <= 255 else 1

    @property
    def vehicle(self) -> str:
        """Return the vehicle type as in `Status.vehicle`."""
        kind = self._kind or self._kind_from_columns()
        if kind == "Plane":
            return QUADPLANE if self._params.get("Q_ENABLE", 0.0) > 0 else FIXED_WING
        if kind == "Copter":
            return HELICOPTER if "HELI" in self._frame.upper() else MULTIROTOR
        return UNKNOWN

    def _update_from_text(self, text: str) -> None:
        if (match := _FIRMWARE.search(text)) and not self.firmware:
            self._kind, self.firmware = match[1], text
        if text.startswith("Frame:") and not self._frame:
            self._frame = text

    def _kind_from_columns(self) -> str:
        """Derive the vehicle type from its specific log columns and parameters."""
        if "CTUN.NavRoll" in self._names or self._params.keys() & _PLANE_PARAMS:
            return "Plane"
        copter = any(name.startswith("MOT.") for name in self._names) or "CTUN.ThrIn" in self._names
        return "Copter" if copter or "CTUN.ABst" in self._names or self._params.keys() & _COPTER_PARAMS else ""
