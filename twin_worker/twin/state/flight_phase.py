"""Detect flight phases and events from telemetry: take-off, landing, touch-down, and a distant local frame."""

from dataclasses import dataclass
from math import hypot, inf, sqrt
from typing import TYPE_CHECKING

import numba as nb
import numpy as np

from fleet.contract import Event
from fleet.frames import Origin, to_ned
from twin_worker.twin.state.events import note, void

if TYPE_CHECKING:
    from twin_worker.twin.state.state import Twin

ROTORS = ("multirotor", "helicopter", "quadplane")
LANDINGS = (21, 85)  # MAV_CMD: NAV_LAND, NAV_VTOL_LAND
_OVER_S = 3.0  # a change of phase must last this long [s]
_STANDS, _FLIES = 1.5, 8.0  # fixed wing: ground speed at standstill, minimum ground speed in flight [m/s]
_HOVERS, _LOW_M = 0.4, 1.5  # rotorcraft: speed at standstill [m/s]; height above ground in flight [m]
_FAR_M = 50_000.0  # the flat-earth frame is valid up to this distance [m]


@dataclass
class Ground:
    """Flight phase of one aircraft, and the ground level.

    Attributes:
        flying: None: unknown
        landed: touched down and not armed again since
        landing: a landing item is active
        armed: newest reported arming state
        ground_down: down coordinate of the last standstill, NED [m]; nan: no standstill observed
    """

    flies: bool | None = None
    landed: bool = False
    landing: bool = False
    armed: bool = False
    height: float = float("nan")


def watch(twin: "Twin", command: int) -> None:
    """Update the flight phase once a second; `command` is the MAV_CMD of the active mission item, 0 unknown."""
    _frame(twin)
    ground, now = twin.ground, twin.history.newest
    armed = twin.status is not None and twin.status.armed
    disarmed = ground.armed and not armed
    if armed and not ground.armed:
        ground.landed = False
    ground.armed = armed
    if command in LANDINGS and not ground.landing and ground.flies:
        note(twin, Event.LANDING, now, "a landing item is active")
    ground.landing = command in LANDINGS
    flies = False if disarmed else _flies(twin)
    if flies is None or flies == ground.flies:
        return
    before, ground.flies = ground.flies, flies
    ground.landed = before is not None and not flies
    if before is not None:
        event, why = (Event.TAKE_OFF, "") if flies else (Event.TOUCH_DOWN, "disarmed" if disarmed else "standstill")
        void(twin, event, now, why)


def _flies(twin: "Twin") -> bool | None:
    """Detect flight from the last seconds of telemetry; None: undetermined."""
    assert twin.origin is not None
    t, v = twin.history.look("velocity", twin.history.newest - _OVER_S)
    _, place = twin.history.look("position", twin.history.newest - _OVER_S)
    if len(t) < 3 or not len(place) or t[-1] - t[0] < 0.6 * _OVER_S:
        return None
    slowest, level, steepest, speed = moves(v)
    if twin.vehicle not in ROTORS and slowest > _FLIES:  # the usual case
        return True
    down = to_ned(twin.origin, *place.T)[:, 2]
    if twin.vehicle in ROTORS:
        high = twin.ground.height - down.max() > _LOW_M  # false for nan
        stands = speed < _HOVERS and not high and (not twin.ground.armed or not np.isnan(twin.ground.height))
        flies = bool(high) or slowest > 2.0
    else:
        _, air = twin.history.look("air", twin.history.newest - _OVER_S)
        still = not len(air) or air[:, 0].max() < _FLIES  # airspeed, because ground speed can be near zero in headwind
        stands, flies = level < _STANDS and steepest < 0.5 and still, False
    if stands:
        twin.ground.height = float(down.mean())
    return True if flies else False if stands else None


@nb.njit(cache=True, nogil=True, _nrt=False)  # type: ignore[call-overload]  # no fastmath
def moves(v: np.ndarray) -> tuple[float, float, float, float]:
    """Return minimum and maximum level speed, maximum vertical speed and maximum speed of velocities, (n, 3) [m/s]."""
    least, level, steepest, most = inf, 0.0, 0.0, 0.0
    for k in range(len(v)):
        over = hypot(v[k, 0], v[k, 1])
        least, level = min(least, over), max(level, over)
        steepest, most = max(steepest, abs(v[k, 2])), max(most, sqrt(v[k, 0] ** 2 + v[k, 1] ** 2 + v[k, 2] ** 2))
    return least, level, steepest, most


def _frame(twin: "Twin") -> None:
    """Move the origin of the local frame to the aircraft if it is far away."""
    assert twin.origin is not None
    _, place = twin.history.look("position", twin.history.newest - 1.0)
    if not len(place):
        return
    north, east, _ = to_ned(twin.origin, *place[-1]).tolist()
    away = hypot(north, east)
    if away > _FAR_M and abs(place[-1, 0]) <= 9e8 and abs(place[-1, 1]) <= 1.8e9:
        twin.origin = Origin(*(int(x) for x in place[-1]))
        twin.ground.height = float("nan")
        twin.record.forget(moved=True)
        twin.contest.forget()
        note(twin, Event.ORIGIN, twin.history.newest, f"{away * 1e-3:.0f} km from the previous origin")
