"""Evaluate HEARTBEAT: aircraft or not, autopilot, vehicle type, mode; and two senders with one id."""

from collections.abc import Hashable
from typing import Any

from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.contract import Alert, AlertKind
from fleet.vehicles import FIXED_WING, HELICOPTER, MULTIROTOR, QUADPLANE, UNKNOWN

AUTOPILOTS = ("generic", "ardupilot", "px4")
_AUTOPILOT = {dialect.MAV_AUTOPILOT_ARDUPILOTMEGA: "ardupilot", dialect.MAV_AUTOPILOT_PX4: "px4"}
_VEHICLE = {
    dialect.MAV_TYPE_FIXED_WING: FIXED_WING,
    dialect.MAV_TYPE_FLAPPING_WING: FIXED_WING,
    dialect.MAV_TYPE_QUADROTOR: MULTIROTOR,
    dialect.MAV_TYPE_COAXIAL: MULTIROTOR,
    dialect.MAV_TYPE_HEXAROTOR: MULTIROTOR,
    dialect.MAV_TYPE_OCTOROTOR: MULTIROTOR,
    dialect.MAV_TYPE_TRICOPTER: MULTIROTOR,
    dialect.MAV_TYPE_DODECAROTOR: MULTIROTOR,
    dialect.MAV_TYPE_DECAROTOR: MULTIROTOR,
    dialect.MAV_TYPE_HELICOPTER: HELICOPTER,
    **dict.fromkeys(range(dialect.MAV_TYPE_VTOL_DUOROTOR, dialect.MAV_TYPE_VTOL_RESERVED5 + 1), QUADPLANE),
    dialect.MAV_TYPE_GENERIC: UNKNOWN,
    dialect.MAV_TYPE_AIRSHIP: UNKNOWN,
    dialect.MAV_TYPE_KITE: UNKNOWN,
    dialect.MAV_TYPE_PARAFOIL: UNKNOWN,
}
"""MAV_TYPE of all aircraft; any other type (ground station, gimbal, camera, ADS-B, rover) is not a UAV."""


def is_aircraft(heartbeat: Any) -> bool:
    """Return whether the sender is the autopilot of an aircraft."""
    return heartbeat.type in _VEHICLE and heartbeat.autopilot != dialect.MAV_AUTOPILOT_INVALID


def vehicle(heartbeat: Any) -> str:
    """Return the vehicle type as in `Status.vehicle`."""
    return _VEHICLE.get(heartbeat.type, UNKNOWN)


def autopilot(heartbeat: Any) -> str:
    """Return the autopilot as in `Status.autopilot`."""
    return _AUTOPILOT.get(heartbeat.autopilot, "generic")


def mode(heartbeat: Any) -> str:
    """Return the autopilot's name of the flight mode, e.g. AUTO (ArduPilot) or MISSION (PX4)."""
    return str(mavutil.mode_string_v10(heartbeat))


def firmware(version: Any) -> str:
    """Return the firmware version of AUTOPILOT_VERSION, e.g. 4.7.0."""
    number = version.flight_sw_version
    return f"{number >> 24}.{number >> 16 & 0xFF}.{number >> 8 & 0xFF}"


def board_id(version: Any) -> str:
    """Return hardware id and firmware version of AUTOPILOT_VERSION, or an empty string."""
    number = bytes(version.uid2).hex().strip("0") or (f"{version.uid:x}" if version.uid else "")
    return f"{number}-{version.flight_sw_version:08x}" if number else ""


CLEAR_AFTER_S = 10.0  # silence of the second sender after which the alert is cleared [s]


class SenderConflict:
    """Second-sender alert of one UAV id."""

    def __init__(self, uav: int) -> None:
        self.uav = uav
        self._senders: tuple[Hashable, Hashable] = (None, None)
        self._first_arrival = self._last_arrival = float("-inf")
        self._raised = False

    def record_conflict(self, arrival: float, first: Hashable, second: Hashable) -> None:
        """Record a message of the second sender; `arrival` is fleet time [s since 1970]."""
        if arrival - self._last_arrival > CLEAR_AFTER_S:
            self._first_arrival = arrival
        self._last_arrival, self._senders = arrival, (first, second)

    def take_alerts(self, now: float) -> list[Alert]:
        """Return the alert changes up to `now` [s since 1970]."""
        active = self._first_arrival <= now <= self._last_arrival + CLEAR_AFTER_S
        if active == self._raised or now < self._first_arrival:
            return []
        self._raised = active
        return [Alert(uav=self.uav, t=now, kind=AlertKind.SECOND_SENDER, active=active, sentence=self._text(active))]

    def _text(self, active: bool) -> str:
        if not active:
            return f"uav-{self.uav}: the second sender of this id is silent"
        first, second = map(_sender_label, self._senders)
        return (
            f"uav-{self.uav}: found a second sender{second} of this id, expected only the first{first}; its messages "
            "are rejected; give every aircraft its own MAVLink system id, or identify the second sender"
        )


def _sender_label(sender: Hashable) -> str:
    """Return a label of the sender, or an empty string."""
    if isinstance(sender, tuple) and len(sender) >= 2:
        return f" ({sender[0]}:{sender[1]})"
    return f" ({sender})" if sender is not None else ""
