"""Routes that no mission describes: of the present mode, and of the failsafe after a link loss."""

from collections.abc import Sequence
from dataclasses import replace
from math import atan2, isfinite
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from fleet.autopilots.control_law import eas2tas
from fleet.autopilots.failsafe import link_loss_steps
from fleet.autopilots.modes import (
    COURSE_LOCK_S,
    HEADING_HOLD_MODES,
    TARGET_MODES,
    ModeEntry,
    ModeSituation,
    after_steering,
    hold_bank,
    mode_route,
)
from fleet.contract import Event
from fleet.frames import Origin, to_geodetic, to_ned
from fleet.mission import FIRST_ITEM, KIND, LOITER_UNLIMITED, RADIUS, Route, unroll_route
from twin_worker.prediction.autopilot_identification import LAW_OF_AUTOPILOT
from twin_worker.prediction.failsafe_route import FailsafePlan
from twin_worker.prediction.multirotor.rollout import item_in_force
from twin_worker.twin.state.events import discard_prediction, invalidate_prediction

if TYPE_CHECKING:
    from twin_worker.twin.state.state import Twin

ROUTE_MODES = ("AUTO", "MISSION", "AUTO.MISSION")
_MAX_ENTRY_AGE_S = 2.0  # maximum age of the position where a mode was entered [s]
HEARTBEAT_S = 2.0  # the mode is reported once a second; one heartbeat may be lost [s]
_BANK_S = 10.0  # commanded banks before the change, in which none is unusual [s]
_ERROR_ROUNDING_M = 1.0  # of the reported path errors [m]
_TARGET_MOVED_M = 2.0  # a guidance target that moves further is a new one [m]
_CIRCLING = 0.3  # largest median crosstrack error on a circle, in radii [-]
_RADIUS_S, _MIN_RADIUS_ROWS = 20.0, 10  # newest flight, and reports in it, that tell the radius of a circle [s]
_MIN_RADIUS, _RADIUS_SPREAD = 10.0, 0.1  # smallest radius [m], and largest median deviation from it [-]
_FAILSAFE_PARAMETERS = {"arduplane": ("FS_LONG_ACTN", "FS_GCS_ENABL"), "px4": ("NAV_DLL_ACT",)}


def present_route(twin: "Twin") -> Route | None:
    """Return the route of a mode without mission; None in a mission, under manual control, or in a what-if."""
    entry, origin = twin.onboard.entry, twin.telemetry.origin
    if origin is None or twin.prediction.override is not None or twin.mode in ROUTE_MODES:
        return None
    if twin.environment.flight_phase.flying is False:  # on the ground
        return None
    if twin.vehicle_class.is_rotorcraft or (twin.mode == "RTL" and twin.received_params.get("Q_RTL_MODE", 0.0) != 0):
        return None
    law = LAW_OF_AUTOPILOT.get(twin.autopilot, "")
    if entry is not None:
        target = twin.onboard.target
        entered = _situation(twin, entry.ned(origin), entry.course, None if target is None else _ned(origin, target))
        situation = _course_hold(twin, entered) if twin.mode in HEADING_HOLD_MODES else entered
        route = None if situation is None else mode_route(law, twin.mode, situation, twin.received_params)
        if route is not None:
            return _with_radius(route, identified_radius(twin))
    return _manual_until_failsafe(twin, law)


def _with_radius(route: Route, radius: float) -> Route:
    """Return the route with a radius [m] for circles that have none of their own; nan: unchanged."""
    if not isfinite(radius):
        return route
    legs = route.legs.copy()
    legs[(legs[:, KIND] == LOITER_UNLIMITED) & (legs[:, RADIUS] == 0.0), RADIUS] = radius
    return replace(route, legs=legs)


def identified_radius(twin: "Twin") -> float:
    """Return the radius of the circle that ArduPlane flies about its target, positive clockwise; nan: unknown [m].

    The reported crosstrack error is the distance to the target minus the radius, which grows with the square of true
    over equivalent airspeed. On the circle, the sign is that of the commanded banks; before, that of WP_LOITER_RAD.
    """
    target, entry, newest = twin.onboard.target, twin.onboard.entry, twin.telemetry.history.newest
    if twin.mode not in TARGET_MODES or twin.autopilot != "ardupilot" or target is None or entry is None:
        return float("nan")
    assert twin.telemetry.origin is not None
    t, commands = twin.telemetry.history.rows_since("command", max(newest - _RADIUS_S, entry.t))
    t_p, positions = twin.telemetry.history.rows_since("position", newest - _RADIUS_S - 1.0)
    if len(t) < _MIN_RADIUS_ROWS or len(t_p) < 2 or not np.isfinite(commands[:, 2]).all():
        return float("nan")
    offset = to_ned(twin.telemetry.origin, *positions.T)[:, :2] - _ned(twin.telemetry.origin, target)[:2]
    radius = np.interp(t, t_p, np.linalg.norm(offset, axis=1)) - commands[:, 2]
    middle = float(np.median(radius))
    if middle < _MIN_RADIUS or np.median(np.abs(radius - middle)) > _RADIUS_SPREAD * middle:  # no circle about it
        return float("nan")
    widened = eas2tas(target[2] * 1e-3) ** 2
    sign = twin.received_params.get("WP_LOITER_RAD", 1.0)
    if np.median(np.abs(commands[:, 2])) < _CIRCLING * middle:  # on the way to the circle its banks are not yet known
        sign = float(np.median(commands[:, 0]))
    return float(np.copysign(middle / widened, sign))


def _course_hold(twin: "Twin", situation: ModeSituation) -> ModeSituation | None:
    """Return the situation of a heading-hold mode now; None while the pilot steers, or without attitude."""
    velocity, attitude, command = (_newest(twin, name) for name in ("velocity", "attitude", "command"))
    if velocity is None or attitude is None:
        return None
    height_error = float("nan") if command is None else float(command[3])
    return after_steering(situation, atan2(velocity[1], velocity[0]), float(attitude[0]), height_error)


def _manual_until_failsafe(twin: "Twin", law: str) -> Route | None:
    """Return the present bank as route of a hand-flown mode, if a failsafe ends it; else None."""
    if not twin.telemetry.link_lost or not link_loss_steps(law, twin.mode, twin.received_params):
        return None
    assert twin.telemetry.origin is not None
    position, attitude = (_newest(twin, name) for name in ("position", "attitude"))
    if position is None or attitude is None:
        return None
    here = _ned(twin.telemetry.origin, position)
    return hold_bank(_situation(twin, here, 0.0, None), float(attitude[0]))


def failsafe_plan(twin: "Twin") -> FailsafePlan | None:
    """Return the mode changes after a link loss; None while the link is up."""
    if not twin.telemetry.link_lost or twin.vehicle_class.is_rotorcraft or twin.prediction.override is not None:
        return None
    law, params = LAW_OF_AUTOPILOT.get(twin.autopilot, ""), twin.received_params
    if not any(name in params for name in _FAILSAFE_PARAMETERS.get(law, ())):
        return FailsafePlan((), _no_route, "failsafe parameters not received: the mode is assumed to continue")
    steps = link_loss_steps(law, twin.mode, params)
    if not steps:
        return FailsafePlan((), _no_route, f"failsafe: {twin.mode} continues by the parameters")

    def route_of(mode: str, p: np.ndarray, course: float) -> Route | None:
        if mode in ROUTE_MODES:
            return _mission_from_here(twin)
        return mode_route(law, mode, _situation(twin, p, course, None), params, failsafe=True)

    return FailsafePlan(steps, route_of, "(assumes that every radio link is lost)", twin.telemetry.history.newest)


def route_of_mode(twin: "Twin", mode: str, p: np.ndarray, course: float) -> Route | None:
    """Return the route of a mode that is entered later; None for a mode that is flown by hand or not known.

    Args:
        twin: source of home, mission and parameters
        mode: as in `Status.mode`
        p: position at the entry, NED from the twin's origin, (3,) [m]
        course: over ground at the entry [rad]
    """
    law = LAW_OF_AUTOPILOT.get(twin.autopilot, "")
    return mode_route(law, mode, _situation(twin, p, course, None), twin.received_params)


def _no_route(mode: str, p: np.ndarray, course: float) -> None:
    return None


def _mission_from_here(twin: "Twin") -> Route | None:
    mission = twin.onboard.mission
    seq = item_in_force(twin.telemetry.history.newest, twin.telemetry.history.rows_since("leg"), mission)
    if mission is None or not isfinite(seq):
        return None
    assert twin.telemetry.origin is not None
    first = FIRST_ITEM.get(twin.autopilot, 1)
    params = twin.received_params
    return unroll_route(mission.items, seq=int(seq), origin=twin.telemetry.origin, params=params, first=first)


def _situation(twin: "Twin", entry: np.ndarray, course: float, target: np.ndarray | None) -> ModeSituation:
    origin, home, position = twin.telemetry.origin, twin.home, _newest(twin, "position")
    assert origin is not None
    return ModeSituation(
        origin,
        entry,
        course,
        entry if position is None else _ned(origin, position),
        None if home is None else _ned(origin, (home.lat_e7, home.lon_e7, home.alt_mm)),
        target,
        twin.onboard.mission.items if twin.onboard.mission else (),
    )


def _newest(twin: "Twin", name: str) -> np.ndarray | None:
    """Return the newest row of one kind, if it is recent."""
    _, rows = twin.telemetry.history.rows_since(name, twin.telemetry.history.newest - _MAX_ENTRY_AGE_S)
    return rows[-1] if len(rows) else None


def _ned(origin: Origin, position: Sequence[float] | np.ndarray) -> np.ndarray:
    return to_ned(origin, *(np.array([x], float) for x in position))[0]


def mode_change_time(twin: "Twin", t: float) -> float:
    """Return when a mode began that a heartbeat reports at `t` [s since 1970].

    The reported crosstrack and height errors jump with the route, by more than the aircraft can have flown between two
    reports. Without them, the commanded bank first moves by more than between any two reports of the seconds before.
    Without either the time is that of the report.
    """
    since = t - HEARTBEAT_S
    t_c, command = twin.telemetry.history.rows_since("command", since - _BANK_S)
    velocity = _newest(twin, "velocity")
    if len(t_c) < 2 or velocity is None:
        return t
    if not np.isfinite(command[:, 2:4]).any():
        return _first_unusual_bank(t_c, command[:, 0], since, t)
    jump = np.nan_to_num(np.abs(np.diff(command[:, 2:4], axis=0))).max(axis=1)
    reach = 2.0 * float(np.linalg.norm(velocity)) * np.diff(t_c)  # errors to both sides of a line
    candidates = np.where((t_c[1:] >= since) & (t_c[1:] <= t) & (jump > reach + _ERROR_ROUNDING_M), jump - reach, 0.0)
    k = int(candidates.argmax())
    return float(t_c[k : k + 2].mean()) if candidates[k] > 0.0 else t


def _first_unusual_bank(t_c: np.ndarray, banks: np.ndarray, since: float, t: float) -> float:
    """Return when the commanded bank first moves faster than ever before `since`; `t` if it does not [s since 1970]."""
    rates = np.abs(np.diff(np.nan_to_num(banks))) / np.maximum(np.diff(t_c), 1e-3)
    before = rates[t_c[1:] < since]
    unusual = np.flatnonzero((t_c[1:] >= since) & (t_c[1:] <= t) & (rates > (before.max() if len(before) else np.inf)))
    return float(t_c[unusual[0] : unusual[0] + 2].mean()) if len(unusual) else t


def mode_entry(twin: "Twin", t: float) -> ModeEntry | None:
    """Return position and course at `t`, from the rows next before it, as the entry of a mode; None without either."""
    t_p, positions = twin.telemetry.history.rows_since("position", t - _MAX_ENTRY_AGE_S)
    t_v, velocities = twin.telemetry.history.rows_since("velocity", t - _MAX_ENTRY_AGE_S)
    if not len(t_p) or not len(velocities) or twin.telemetry.origin is None:
        return None
    row, v = _row_before(t_p, t), velocities[_row_before(t_v, t)]
    since = min(t - float(t_p[row]), _MAX_ENTRY_AGE_S)
    lat, lon, alt = to_geodetic(Origin(*(int(x) for x in positions[row])), v * since)
    return ModeEntry(t, (float(lat), float(lon), float(alt)), atan2(v[1], v[0]))


def _row_before(times: np.ndarray, t: float) -> int:
    """Return the number of the last row until `t`, else of the first."""
    return max(int(np.searchsorted(times, t, side="right")) - 1, 0)


def lock_course(twin: "Twin") -> None:
    """Move the line of a heading-hold mode to where the autopilot locks its course; that invalidates the prediction.

    A mode entered in a turn rolls out first, and holds the course after that.
    """
    entry = twin.onboard.entry
    if twin.mode not in HEADING_HOLD_MODES or entry is None or entry.locked:
        return
    lock_t, history = entry.t + COURSE_LOCK_S, twin.telemetry.history
    (t_p, positions), (t_v, velocities) = (history.rows_since(name, lock_t) for name in ("position", "velocity"))
    if not len(t_p) or not len(t_v):
        return
    position, v = positions[0], velocities[0]
    locked = (float(position[0]), float(position[1]), entry.position[2])  # the height is that of the mode change
    twin.onboard.enter_mode(
        msgspec.structs.replace(entry, position=locked, course=atan2(v[1], v[0]), locked=True),
    )
    invalidate_prediction(twin, None, lock_t)


def update_target(twin: "Twin") -> None:
    """Store the newest guidance target of the present mode.

    The first one tells where the aircraft flies since the mode change; one that moved is a new route from now on.
    """
    t, targets = twin.telemetry.history.rows("target")
    if twin.mode not in TARGET_MODES or twin.telemetry.origin is None or not len(t):
        return
    t_target, target = float(t[-1]), targets[-1].astype(float)
    if twin.onboard.entry is None:  # the first status arrived in this mode
        twin.onboard.enter_mode(mode_entry(twin, t_target))
        invalidate_prediction(twin, None, t_target)
    elif not t_target > twin.onboard.entry.t:
        return
    previous, new = twin.onboard.target, (float(target[0]), float(target[1]), float(target[2]))
    if previous is None:
        if not _is_of_mode_before(t, targets, twin.onboard.entry):
            twin.onboard.set_target(new)
            discard_prediction(twin)
    elif _has_moved(previous, new):
        twin.onboard.set_target(new)
        invalidate_prediction(twin, Event.TARGET if twin.mode == "GUIDED" else None, t_target)


def _is_of_mode_before(t: np.ndarray, targets: np.ndarray, entry: ModeEntry | None) -> bool:
    """Return whether the only target since the mode change repeats that of the mode before.

    It may have been sent before the change, whose time is known to the period of the commands.
    """
    if entry is None or not 1 < int(np.searchsorted(t, entry.t, side="right")) == len(t) - 1:
        return False
    *older, new = ((float(x[0]), float(x[1]), float(x[2])) for x in targets[-3:])
    return not any(_has_moved(one, new) for one in older)


def update_home(twin: "Twin", previous: Origin | None, t: float) -> None:
    """Make a prediction due whose route depends on home, which became known or moved at `t` [s since 1970].

    A home that becomes known was there before: the route is flown since the mode change. One that moves is a new route.
    """
    if twin.mode != "RTL" or twin.home is None:
        return
    if previous is None:
        twin.prediction.expire()
    elif _has_moved(previous, twin.home):
        invalidate_prediction(twin, None, t)


def _has_moved(previous: tuple[float, float, float], new: tuple[float, float, float]) -> bool:
    distance = np.linalg.norm(_ned(Origin(*(int(x) for x in previous)), new))
    return bool(distance > _TARGET_MOVED_M)
