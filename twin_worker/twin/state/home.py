"""Home of a mission where the autopilot did not report it: its altitude less its height above home."""

from typing import TYPE_CHECKING

import msgspec
import numpy as np

from fleet.contract import Item
from fleet.frames import Origin

if TYPE_CHECKING:
    from twin_worker.twin.state.state import Twin

_RECENT_S = 5.0  # telemetry used [s]
_SAME_TIME_S = 1e-3  # position and height of one message [s]
_MIN_MOVE_M = 1.0  # smaller changes are rounding [m]
_ABSOLUTE = {3: 0, 6: 5}  # MAV_FRAME: relative to home -> above sea level
_WAYPOINT = 16  # MAV_CMD


def complete_home(twin: "Twin") -> None:
    """Complete the mission with home, where item 0 has no position or altitudes are relative to an unknown home.

    ArduPilot returns zeros for item 0 until it has a home; a PX4 mission does not contain home. In both cases the
    gateway uses HOME_POSITION, and what is left here are aircraft that do not send it.
    """
    mission, items = twin.onboard.mission, twin.onboard.received_items
    if mission is None or not items or twin.telemetry.origin is None:
        return
    contains_home = twin.first_item > 0
    if contains_home and (items[0].seq != 0 or items[0].lat_e7 or items[0].lon_e7):
        return
    if not contains_home and not any(item.frame in _ABSOLUTE for item in items):
        return
    altitude = _home_altitude(twin)
    if altitude is None:
        return
    if contains_home:
        completed = (_home_item(twin, altitude), *items[1:])
        previous = mission.items[0]
        if (previous.lat_e7 or previous.lon_e7) and abs(previous.alt_m - altitude) < _MIN_MOVE_M:
            return
    else:
        completed = tuple(_above_sea_level(item, altitude) for item in items)
        if _same_altitudes(completed, mission.items):
            return
    twin.onboard.complete_mission(completed)


def _home_altitude(twin: "Twin") -> float | None:
    """Return the altitude of home above mean sea level: altitude less height above home; None if unknown [m]."""
    since = twin.telemetry.history.newest - _RECENT_S
    t, position = twin.telemetry.history.rows_since("position", since)
    t_height, height = twin.telemetry.history.rows_since("height", since)
    if not len(t) or not len(t_height):
        return None
    nearest = np.clip(np.searchsorted(t_height, t), 0, len(t_height) - 1)
    same = np.abs(t_height[nearest] - t) < _SAME_TIME_S
    differences = position[same, 2] * 1e-3 - height[nearest[same], 0]
    return float(np.round(np.median(differences), 1)) if len(differences) else None


def _home_item(twin: "Twin", altitude: float) -> Item:
    """Return item 0 at the last disarmed position, else at the origin."""
    assert twin.telemetry.origin is not None
    place: Origin = twin.alerts.home_fallback or twin.telemetry.origin
    return Item(seq=0, command=_WAYPOINT, frame=0, lat_e7=place.lat_e7, lon_e7=place.lon_e7, alt_m=altitude)


def _above_sea_level(item: Item, altitude: float) -> Item:
    if item.frame not in _ABSOLUTE:
        return item
    return msgspec.structs.replace(item, frame=_ABSOLUTE[item.frame], alt_m=item.alt_m + altitude)


def _same_altitudes(items: tuple[Item, ...], others: tuple[Item, ...]) -> bool:
    """Return whether two versions of a mission differ by rounding only."""
    pairs = zip(items, others, strict=True)
    return all(a.frame == b.frame and abs(a.alt_m - b.alt_m) < _MIN_MOVE_M for a, b in pairs)
