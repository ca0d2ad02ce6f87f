"""Identify the aircraft of a DataFlash log: system id, vehicle type and firmware."""

import re

from fleet.telemetry.mavlink.heartbeat import FIXED_WING, HELICOPTER, MULTIROTOR, QUADPLANE, UNKNOWN
from fleet.telemetry.mavlink.onboard_log import Said
from fleet.telemetry.onboard_logs.dataflash.records import Records

_FIRMWARE = re.compile(r"\b(?:Ardu|APM:)(Plane|Copter|Rover|Sub)\b.*V?\d")
_PLANE_HAS = {"TRIM_ARSPD_CM", "AIRSPEED_CRUISE", "LIM_ROLL_CD", "ROLL_LIMIT_DEG", "TECS_CLMB_MAX"}
_COPTER_HAS = {"FRAME", "FRAME_CLASS", "ANGLE_MAX", "PILOT_THR_FILT", "WPNAV_SPEED"}
_TELLING = {"MAV_SYSID", "SYSID_THISMAV", "Q_ENABLE"} | _PLANE_HAS | _COPTER_HAS


class Identity:
    """Collect the identity of the aircraft from records and events."""

    def __init__(self) -> None:
        self._params: dict[str, float] = {}
        self._kind = ""
        self._frame = ""
        self._names: set[str] = set()
        self.firmware = ""

    def look(self, block: list[Records], said: list[Said]) -> None:
        """Evaluate a block."""
        self._names.update(
            f"{r.form.name}.{c}" for r in block for c in r.form.columns if r.form.name in ("CTUN", "MOT")
        )
        for s in said:
            if s.what == "param" and s.value[0] in _TELLING:
                self._params[s.value[0]] = s.value[1]
            elif s.what == "text":
                self._hear(s.value[1])

    @property
    def system(self) -> int:
        """Return the MAVLink system id, 1 if not in the log."""
        value = self._params.get("MAV_SYSID", self._params.get("SYSID_THISMAV", 1.0))
        return int(value) if 1 <= value <= 255 else 1

    @property
    def vehicle(self) -> str:
        """Return the vehicle type as in `Status.vehicle`."""
        kind = self._kind or self._guess()
        if kind == "Plane":
            return QUADPLANE if self._params.get("Q_ENABLE", 0.0) > 0 else FIXED_WING
        if kind == "Copter":
            return HELICOPTER if "HELI" in self._frame.upper() else MULTIROTOR
        return UNKNOWN

    def _hear(self, text: str) -> None:
        if (found := _FIRMWARE.search(text)) and not self.firmware:
            self._kind, self.firmware = found[1], text
        if text.startswith("Frame:") and not self._frame:
            self._frame = text

    def _guess(self) -> str:
        """Derive the vehicle type from its specific log columns and parameters."""
        if "CTUN.NavRoll" in self._names or self._params.keys() & _PLANE_HAS:
            return "Plane"
        copter = any(name.startswith("MOT.") for name in self._names) or "CTUN.ThrIn" in self._names
        return "Copter" if copter or "CTUN.ABst" in self._names or self._params.keys() & _COPTER_HAS else ""
