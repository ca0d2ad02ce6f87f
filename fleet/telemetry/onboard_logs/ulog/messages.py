"""Extract identity, modes, transitions and date of a ULog."""

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np

from fleet import vehicles
from fleet.telemetry.mavlink import heartbeat
from fleet.telemetry.mavlink.onboard_log import OnboardEvent
from fleet.telemetry.onboard_logs.topic import Topic
from fleet.telemetry.tables.ulog import ARMED, AUTOSTART, TRANSITIONS, VEHICLE_TYPE, mode_name

_MIN_UTC_US, _MAX_UTC_US = 1.2e15, 4e15  # plausible GPS time: 2008 to 2096
_RELEASE_TYPES = ((192, " RC"), (128, " beta"), (64, " alpha"))  # last byte of ver_sw_release; 255 is a release
_INFO = 6  # severity of generated texts

Topics = Mapping[str, Topic]


def system_id(params: Mapping[str, float], topics: Topics) -> int:
    """Return the MAVLink system id, 1 if not in the log."""
    value = params.get("MAV_SYS_ID", _most_common(topics, "system_id"))
    return int(value) if value is not None and 1 <= value <= 255 else 1


def vehicle_kind(params: Mapping[str, float], topics: Topics) -> str:
    """Return the vehicle type as in `Status.vehicle`."""
    if _most_common(topics, "is_vtol"):
        return vehicles.QUADPLANE
    for mav_type in (_most_common(topics, "system_type"), params.get("MAV_TYPE")):
        kind = heartbeat.vehicle(SimpleNamespace(type=int(mav_type or 0)))
        if kind != vehicles.UNKNOWN:
            return kind
    rotary = _most_common(topics, "is_rotary_wing")  # until 1.8
    if rotary is not None:
        return vehicles.MULTIROTOR if rotary else vehicles.FIXED_WING
    by_type = VEHICLE_TYPE.get(int(_most_common(topics, "vehicle_type") or 0))
    autostart = int(params.get("SYS_AUTOSTART", 0))
    return by_type or next((kind for ids, kind in AUTOSTART if autostart in ids), vehicles.UNKNOWN)


def release(info: Mapping[str, Any]) -> tuple[int, int]:
    """Return the PX4 release, (major, minor); (99, 0) if not in the log."""
    number = info.get("ver_sw_release")
    return (number >> 24 & 0xFF, number >> 16 & 0xFF) if isinstance(number, int) and number > 0 else (99, 0)


def firmware_text(info: Mapping[str, Any]) -> str:
    """Return the firmware text, or an empty string."""
    number = info.get("ver_sw_release")
    if isinstance(number, int) and number > 0:
        suffix = next((name for threshold, name in _RELEASE_TYPES if threshold <= number & 0xFF < 255), "")
        return f"PX4 v{number >> 24 & 0xFF}.{number >> 16 & 0xFF}.{number >> 8 & 0xFF}{suffix}"
    return f"PX4 {info['ver_sw'][:10]}" if info.get("ver_sw") else ""


def gps_epoch(topics: Topics) -> float | None:
    """Return fleet time minus log time [s] from GPS time; late by the receiver delay of 0.1 s.

    `time_ref_utc` is not usable: it is the time zone of the logger.
    """
    for name in ("vehicle_gps_position", "sensor_gps"):
        if name in topics and hasattr(topics[name], "time_utc_usec"):
            utc = topics[name].time_utc_usec
            valid = (utc > _MIN_UTC_US) & (utc < _MAX_UTC_US)
            if valid.any():
                return float(np.median(utc[valid] * 1e-6 - topics[name].t[valid]))
    return None


def topic_events(topics: Topics, version: tuple[int, int]) -> list[OnboardEvent]:
    """Return the changes of mode, arming and VTOL state."""
    events: list[OnboardEvent] = []
    status = topics.get("vehicle_status")
    if status is not None and hasattr(status, "nav_state"):
        events += [
            OnboardEvent(t, "mode", mode_name(int(state), version)) for t, state in _changes(status.t, status.nav_state)
        ]
    if status is not None and hasattr(status, "arming_state"):
        events += [
            OnboardEvent(t, "armed", bool(is_armed)) for t, is_armed in _changes(status.t, status.arming_state == ARMED)
        ]
    vtol = topics.get("vtol_vehicle_status")
    if vtol is not None:
        changes = _changes(vtol.t, _phase(vtol))
        events += [
            OnboardEvent(t, "text", (_INFO, f"VTOL: {TRANSITIONS[int(phase)]}"))
            for t, phase in changes
            if int(phase) in TRANSITIONS
        ]
    return events


def _phase(vtol: Topic) -> np.ndarray:
    if hasattr(vtol, "vehicle_vtol_state"):  # since 1.13
        return vtol.vehicle_vtol_state
    if not all(hasattr(vtol, name) for name in ("vtol_in_rw_mode", "vtol_in_trans_mode", "in_transition_to_fw")):
        return np.zeros(len(vtol))
    moving = np.where(vtol.in_transition_to_fw != 0, 1, 2)
    return np.where(vtol.vtol_in_trans_mode != 0, moving, np.where(vtol.vtol_in_rw_mode != 0, 3, 4))


def _changes(t: np.ndarray, values: np.ndarray) -> list[tuple[float, Any]]:
    indices = np.flatnonzero(np.concatenate([[True], values[1:] != values[:-1]])) if len(t) else np.array([], int)
    return [(float(t[i]), values[i]) for i in indices[:_MAX_CHANGES]]


_MAX_CHANGES = 1000  # maximum events of one kind per log


def _most_common(topics: Topics, field: str) -> float | None:
    """Return the most common value of a vehicle_status field, to ignore damaged rows."""
    status = topics.get("vehicle_status")
    if status is None or not hasattr(status, field):
        return None
    values, counts = np.unique(getattr(status, field), return_counts=True)
    return float(values[np.argmax(counts)])
