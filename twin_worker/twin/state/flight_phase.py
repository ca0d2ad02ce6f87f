"""Detect flight phases and events from telemetry: take-off, landing, touch-down, and a distant local frame."""

from dataclasses import dataclass
from math import hypot, inf, sqrt
from typing import TYPE_CHECKING

import numba as nb
import numpy as np

from fleet.contract import Event
from fleet.frames import Origin, to_ned
from twin_worker.twin.state.events import invalidate_prediction, record_event

if TYPE_CHECKING:
    from twin_worker.twin.state.state import Twin

LANDING_COMMANDS = (21, 85)  # MAV_CMD: NAV_LAND, NAV_VTOL_LAND
_CONFIRM_S = 3.0  # a change of phase must last this long [s]
_STANDSTILL_SPEED, _FLYING_SPEED = (
    1.5,
    8.0,
)  # fixed wing: ground speed at standstill, minimum ground speed in flight [m/s]
_ROTOR_STANDSTILL_SPEED, _AIRBORNE_HEIGHT_M = (
    0.4,
    1.5,
)  # rotorcraft: speed at standstill [m/s]; height above ground in flight [m]
_MAX_ORIGIN_DISTANCE_M = 50_000.0  # the flat-earth frame is valid up to this distance [m]


@dataclass
class FlightPhase:
    """Flight phase of one aircraft, and the ground level.

    Attributes:
        flying: None: unknown
        landed: touched down and not armed again since
        landing: a landing item is active
        armed: newest reported arming state
        ground_down: down coordinate of the last standstill, NED [m]; nan: no standstill observed
    """

    flying: bool | None = None
    landed: bool = False
    landing: bool = False
    armed: bool = False
    ground_down: float = float("nan")


def update_flight_phase(twin: "Twin", command: int) -> None:
    """Update the flight phase once a second; `command` is the MAV_CMD of the active mission item, 0 unknown."""
    _recentre_origin(twin)
    phase, newest = twin.environment.flight_phase, twin.telemetry.history.newest
    armed = twin.onboard.status is not None and twin.onboard.status.armed
    disarmed = phase.armed and not armed
    if armed and not phase.armed:
        phase.landed = False
    phase.armed = armed
    if command in LANDING_COMMANDS and not phase.landing and phase.flying:
        record_event(twin, Event.LANDING, newest, "a landing item is active")
    phase.landing = command in LANDING_COMMANDS
    flying = False if disarmed else _is_flying(twin)
    if flying is None or flying == phase.flying:
        return
    was_flying, phase.flying = phase.flying, flying
    phase.landed = was_flying is not None and not flying
    if was_flying is not None:
        event, reason = (Event.TAKE_OFF, "") if flying else (Event.TOUCH_DOWN, "disarmed" if disarmed else "standstill")
        invalidate_prediction(twin, event, newest, reason)


def _is_flying(twin: "Twin") -> bool | None:
    """Detect flight from the last seconds of telemetry; None: undetermined."""
    assert twin.telemetry.origin is not None
    t, v = twin.telemetry.history.rows_since("velocity", twin.telemetry.history.newest - _CONFIRM_S)
    _, positions = twin.telemetry.history.rows_since("position", twin.telemetry.history.newest - _CONFIRM_S)
    if len(t) < 3 or not len(positions) or t[-1] - t[0] < 0.6 * _CONFIRM_S:
        return None
    min_level, max_level, max_vertical, max_speed = speed_extremes(v)
    if not twin.vehicle_class.can_hover and min_level > _FLYING_SPEED:  # the usual case
        return True
    down = to_ned(twin.telemetry.origin, *positions.T)[:, 2]
    if twin.vehicle_class.can_hover:
        airborne = twin.environment.flight_phase.ground_down - down.max() > _AIRBORNE_HEIGHT_M  # false for nan
        standing = (
            max_speed < _ROTOR_STANDSTILL_SPEED
            and not airborne
            and (not twin.environment.flight_phase.armed or not np.isnan(twin.environment.flight_phase.ground_down))
        )
        flying = bool(airborne) or min_level > 2.0
    else:
        _, air_rows = twin.telemetry.history.rows_since("air", twin.telemetry.history.newest - _CONFIRM_S)
        airspeed_low = (
            not len(air_rows) or air_rows[:, 0].max() < _FLYING_SPEED
        )  # airspeed, because ground speed can be near zero in headwind
        standing, flying = max_level < _STANDSTILL_SPEED and max_vertical < 0.5 and airspeed_low, False
    if standing:
        twin.environment.flight_phase.ground_down = float(down.mean())
    return True if flying else False if standing else None


@nb.njit(cache=True, nogil=True, _nrt=False)  # type: ignore[call-overload]  # no fastmath
def speed_extremes(v: np.ndarray) -> tuple[float, float, float, float]:
    """Return minimum and maximum level speed, maximum vertical speed and maximum speed of velocities, (n, 3) [m/s]."""
    min_level, max_level, max_vertical, max_speed = inf, 0.0, 0.0, 0.0
    for k in range(len(v)):
        level_speed = hypot(v[k, 0], v[k, 1])
        min_level, max_level = min(min_level, level_speed), max(max_level, level_speed)
        max_vertical, max_speed = (
            max(max_vertical, abs(v[k, 2])),
            max(max_speed, sqrt(v[k, 0] ** 2 + v[k, 1] ** 2 + v[k, 2] ** 2)),
        )
    return min_level, max_level, max_vertical, max_speed


def _recentre_origin(twin: "Twin") -> None:
    """Move the origin of the local frame to the aircraft if it is far away."""
    assert twin.telemetry.origin is not None
    _, positions = twin.telemetry.history.rows_since("position", twin.telemetry.history.newest - 1.0)
    if not len(positions):
        return
    north, east, _ = to_ned(twin.telemetry.origin, *positions[-1]).tolist()
    distance = hypot(north, east)
    if distance > _MAX_ORIGIN_DISTANCE_M and abs(positions[-1, 0]) <= 9e8 and abs(positions[-1, 1]) <= 1.8e9:
        twin.telemetry.set_origin(Origin(*(int(x) for x in positions[-1])))
        twin.environment.flight_phase.ground_down = float("nan")
        twin.confidence.tracker.censor_open(frame_changed=True)
        twin.prediction.selector.clear()
        record_event(
            twin, Event.ORIGIN, twin.telemetry.history.newest, f"{distance * 1e-3:.0f} km from the previous origin"
        )
