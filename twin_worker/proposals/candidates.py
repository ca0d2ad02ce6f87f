"""Candidate changes of the plan of one aircraft, and the items, item number or mode that each of them uploads."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from math import ceil, hypot
from typing import NamedTuple

import msgspec
import numpy as np

from fleet import mission_legs as m
from fleet.autopilots import copter
from fleet.contract import AlertKind, Change, Item, Prediction
from fleet.frames import Origin, to_geodetic, to_ned
from fleet.mission import SPEED
from fleet.mission_jumps import JUMP, LAND_START
from fleet.terrain.areas import Area
from twin_worker.alerts.feasibility import read_limits
from twin_worker.alerts.geofence import MIN_HEIGHT_ROTORS_M, MIN_HEIGHT_WINGS_M
from twin_worker.proposals.detour import way_around
from twin_worker.proposals.mission_edits import insert, is_circle, is_positional, move_within, remove, without_jumps
from twin_worker.proposals.speeds import tried_speeds
from twin_worker.twin.state.routes import ROUTE_MODES
from twin_worker.twin.state.state import Twin
from twin_worker.twin.steps.alerts import geofence, reach_s
from twin_worker.twin.steps.kinematic_prediction import is_hovering
from twin_worker.whatif import active_seq

HOLD_MODE, RETURN_MODE, LAND_MODE = "LOITER", "RTL", "LAND"
"""Modes of a hold, a return and a landing, as in `Status.mode`, of ArduPilot and PX4."""
MODES = {"hold": HOLD_MODE, "return": RETURN_MODE, "land": LAND_MODE}
"""Mode of each `Change.mode`."""
OFFSETS = (-3.0, -2.0, -1.5, 1.5, 2.0, 3.0)
"""Altitude offsets that are tried against a conflict, in vertical separations [-]."""
_DELAYS_S = (20.0, 40.0)  # circling or waiting times that are tried [s]
DECISION_S = 20.0
"""Time from a proposal to the start of its change: a person reads, decides and confirms, the gateway uploads [s]."""
_MARGIN_S = 5.0  # an inserted item lies at least so far behind the start of the change [s]
_PASSING_M = 100.0  # an item is passed where the path comes nearer and goes away again [m]
_DEFAULT_CLIMB = 2.0  # climb and sink rate without received limits [m/s]
_TURN_M = 60.0  # distance that is added around a no-fly area: corners are cut or overshot [m]
_SKIPPED = 2  # items nearest to the event of which each is left out
_AHEAD_ITEMS = 8  # navigation items ahead that are looked at
_LOITER_TIME, _WAYPOINT, _LAND, _VTOL_LAND = 19, 16, 21, 85  # MAV_CMD
_NO_OFFSET = (m.LAND, m.TAKEOFF)  # legs whose altitude is not changed
_PASSED = (m.WAYPOINT, m.LOITER_TURNS, m.LOITER_TIME)  # legs after which the mission continues; it may omit them


class Kind(StrEnum):
    """Kinds of change."""

    SPEED = "speed"
    ALTITUDE = "altitude"
    DELAY = "delay"
    SKIP = "skip"
    SHORTEN = "shorten"
    SHRINK = "shrink"
    DETOUR = "detour"
    HOLD = "hold"
    RETURN = "return"
    LAND = "land"


INTERRUPTING = (Kind.HOLD, Kind.RETURN, Kind.LAND)
"""Kinds after which the mission is not continued."""


class Candidate(NamedTuple):
    """One change: kind, and its value.

    The value is the airspeed [m/s], the altitude offset [m], the waiting time [s], the item that is left out, the
    number of last waypoints that are left out, the distance from home within which all items ahead are moved [m], or
    the distance to a no-fly area, positive to pass it on the right [m].
    """

    uav: int
    kind: Kind
    value: float = 0.0


class Deficit(NamedTuple):
    """By how much the present plan violates a limit, with its uncertainty [m]."""

    height: float = 0.0  # climb that is missing; negative: descent
    radius: float = np.inf  # largest distance from home at which items may lie
    around: float = np.nan  # distance to keep from a no-fly area


@dataclass(frozen=True)
class Plan:
    """Present plan of one aircraft.

    Attributes:
        twin: a copy, which is not changed
        prediction: of the present plan, made now
        seq: current mission item; -1: it follows no mission
        items: mission items, by number
    """

    twin: Twin
    prediction: Prediction
    seq: int
    items: tuple[Item, ...]

    @classmethod
    def of(cls, twin: Twin, prediction: Prediction) -> "Plan":
        """Return the plan of a twin with its newest prediction."""
        mission = twin.onboard.mission
        on_route = twin.mode in ROUTE_MODES and mission is not None and mission.complete
        items = tuple(sorted(mission.items, key=lambda item: item.seq)) if mission is not None and on_route else ()
        seq = active_seq(twin) if items else -1
        return cls(twin, prediction, seq if any(item.seq == seq for item in items) else -1, items)

    @property
    def uav(self) -> int:
        """Return the aircraft."""
        return self.twin.config.uav

    @property
    def ahead(self) -> list[Item]:
        """Return the navigation items with a position from the current one on."""
        return [item for item in self.items if item.seq >= self.seq >= 0 and is_positional(item)]

    @property
    def remaining(self) -> list[Item]:
        """Return the same with those that jumps ahead lead back to."""
        jumps = [item.param1 for item in self.items if item.seq >= self.seq >= 0 and item.command == JUMP]
        first = min([float(self.seq), *(target for target in jumps if target >= self.twin.first_item)])
        return [item for item in self.items if item.seq >= first >= 0 and is_positional(item)]

    def position(self, item: Item) -> np.ndarray:
        """Return the position of an item on the horizontal plane of the prediction's frame, (2,) [m]."""
        lat, lon = np.array([item.lat_e7], float), np.array([item.lon_e7], float)
        return to_ned(self.prediction.ned_origin(), lat, lon, np.zeros(1))[0, :2]

    def at(self, seconds: float) -> np.ndarray:
        """Return the predicted position `seconds` ahead, NED, (3,) [m]."""
        ahead = self.prediction.ahead.numpy()
        return np.array([np.interp(seconds, ahead, column) for column in self.prediction.path.numpy().T])

    def passes(self, item: Item, seconds: float) -> bool:
        """Return whether the predicted path passes an item before `seconds` ahead; a circle, whether it leaves it."""
        ahead, path = self.prediction.ahead.numpy(), self.prediction.path.numpy()
        distance = np.hypot(*(path[ahead <= seconds, :2] - self.position(item)).T)
        nearest, far = int(distance.argmin()), 2 * _PASSING_M if is_circle(item) else 0.0
        return bool(distance[nearest] < _PASSING_M and nearest < len(distance) - 1 and distance[-1] > far)

    def is_circling(self, seconds: float) -> bool:
        """Return whether the aircraft flies a circle of its mission `seconds` ahead, or is about to.

        A multirotor waits at LOITER_TIME: an upload begins the wait anew, which no other item depends on.
        """
        seq = self.seq_after(Change(uav=self.uav), seconds)
        waits = _LOITER_TIME if is_hovering(self.twin) else None
        circles = [item for item in self.items if item.seq == seq and is_circle(item) and item.command != waits]
        return any(np.hypot(*(self.at(seconds)[:2] - self.position(item))) < 2 * _PASSING_M for item in circles)

    def seq_after(self, change: Change, seconds: float) -> int:
        """Return the item of a changed mission that is flown to `seconds` ahead, after the present plan until then."""
        items = self.items if change.items is None else change.items
        ahead = [item for item in items if item.seq >= (self.seq if change.seq is None else change.seq)]
        positional = [item for item in ahead if is_positional(item)]
        following = [item.seq for item in positional if not self.passes(item, seconds)]
        return min(following, default=self.seq)

    def reaches_current(self, seconds: float) -> bool:
        """Return whether the current item is passed within `seconds` at the present speed."""
        current = next((item for item in self.ahead if item.seq == self.seq), None)
        if current is None:
            return True
        speed = hypot(*(self.at(1.0) - self.at(0.0))[:2])
        return bool(hypot(*(self.position(current) - self.at(0.0)[:2])) < speed * seconds)

    @property
    def min_height_m(self) -> float:
        """Return the smallest height above home at which items may lie [m]."""
        return MIN_HEIGHT_ROTORS_M if is_hovering(self.twin) else MIN_HEIGHT_WINGS_M


def candidates(
    plan: Plan, kind: AlertKind, separation_m: float, event: Origin | None, deficit: Deficit
) -> list[Candidate]:
    """Return the changes to try against an event.

    Args:
        plan: present plan
        kind: of the event
        separation_m: vertical separation minimum [m]
        event: where it happens; None: no single position
        deficit: what is missing to the limits of the aircraft
    """
    is_limit = kind in (AlertKind.GROUND, AlertKind.GEOFENCE)  # another speed would only postpone them
    tried = [Candidate(plan.uav, Kind.SPEED, speed) for speed in ([] if is_limit else tried_speeds(plan.twin))]
    if plan.seq >= 0:
        tried += [Candidate(plan.uav, Kind.ALTITUDE, offset) for offset in _offsets(plan, kind, separation_m, deficit)]
        if kind is AlertKind.CONFLICT:
            tried += [Candidate(plan.uav, Kind.DELAY, seconds) for seconds in _DELAYS_S]
        if kind is AlertKind.BATTERY:
            tried += [Candidate(plan.uav, Kind.SHORTEN, float(n)) for n in _shortenings(plan)]
        tried += [Candidate(plan.uav, Kind.SKIP, float(seq)) for seq in _skipped(plan, kind, event)]
        if np.isfinite(deficit.radius):
            radii = (deficit.radius, deficit.radius - 30.0)
            tried += [Candidate(plan.uav, Kind.SHRINK, radius) for radius in radii if radius > 0.0]
        if np.isfinite(deficit.around):
            distances = (0.5 * deficit.around, deficit.around, deficit.around + _TURN_M)
            tried += [Candidate(plan.uav, Kind.DETOUR, side * distance) for distance in distances for side in (1, -1)]
    modes = {Kind.HOLD: HOLD_MODE, Kind.RETURN: RETURN_MODE, Kind.LAND: LAND_MODE}
    if kind is AlertKind.BATTERY:
        del modes[Kind.HOLD]  # a hover uses energy and reaches nothing
    return tried + [Candidate(plan.uav, interruption) for interruption, mode in modes.items() if plan.twin.mode != mode]


def to_change(plan: Plan, candidate: Candidate) -> Change | None:
    """Return what is sent to the aircraft for a candidate; None if the plan no longer admits it."""
    if candidate.kind is Kind.SPEED:
        return _speed_change(plan, round(candidate.value, 1))
    if candidate.kind in (Kind.HOLD, Kind.RETURN):
        return Change(uav=plan.uav, mode=candidate.kind.value)
    if candidate.kind is Kind.LAND:
        return _landing(plan)
    if plan.seq < 0:
        return None
    if candidate.kind is Kind.SKIP:
        return _skip(plan, int(candidate.value))
    items = {
        Kind.ALTITUDE: _with_offset,
        Kind.DELAY: _with_wait,
        Kind.SHRINK: _within,
        Kind.DETOUR: _around,
        Kind.SHORTEN: _without_last,
    }[candidate.kind](plan, candidate.value)
    return None if items is None else Change(uav=plan.uav, items=items, seq=plan.seq)


# --- speed -----------------------------------------------------------------------------------------------------------


def _speed_change(plan: Plan, speed: float) -> Change:
    """Command a speed, also in place of the speeds that the mission commands later [m/s]."""
    items = tuple(
        msgspec.structs.replace(item, param2=speed) if item.command == SPEED and item.seq > plan.seq else item
        for item in plan.items
    )
    if plan.seq < 0 or items == plan.items:
        return Change(uav=plan.uav, speed=speed)
    return Change(uav=plan.uav, speed=speed, items=items, seq=plan.seq)


# --- altitude --------------------------------------------------------------------------------------------------------


def _offsets(plan: Plan, kind: AlertKind, separation_m: float, deficit: Deficit) -> Iterator[float]:
    """Yield the altitude offsets to try [m]."""
    if deficit.height:
        step = ceil(abs(deficit.height) / 5.0) * 5.0
        yield from (float(np.copysign(offset, deficit.height)) for offset in (step, step + separation_m))
    elif kind is AlertKind.CONFLICT:
        yield from (factor * separation_m for factor in OFFSETS)


def _with_offset(plan: Plan, offset: float) -> tuple[Item, ...] | None:
    """Return the mission with the altitudes of all remaining items changed by `offset` [m].

    Autopilots change the altitude in proportion along a leg. A waypoint on the present leg makes it change sooner.
    """
    changed = {item.seq for item in plan.remaining if m.KINDS[item.command] not in _NO_OFFSET}
    lowered = [item for item in plan.remaining if item.seq in changed and item.frame in m.RELATIVE]
    if not changed or (offset < 0 and any(item.alt_m + offset < plan.min_height_m for item in lowered)):
        return None
    items = [
        msgspec.structs.replace(item, alt_m=item.alt_m + offset) if item.seq in changed else item for item in plan.items
    ]
    rate = _climb_rate(plan.twin, offset)
    seconds = DECISION_S + _MARGIN_S + abs(offset) / rate
    if plan.reaches_current(seconds + _MARGIN_S):
        return tuple(items)
    return insert(items, _item_on_path(plan, seconds, offset))


def _climb_rate(twin: Twin, offset: float) -> float:
    """Return the rate at which the altitude can change by `offset` [m/s]."""
    if is_hovering(twin):
        limits = copter.limits(twin.received_params, twin.vehicle_class.rotor_prefix)[0]
        return float(limits.up if offset > 0 else limits.down)
    limit = read_limits(twin.received_params, 0.0)
    rate = limit.climb if offset > 0 else limit.sink
    return rate if np.isfinite(rate) and rate > 0 else _DEFAULT_CLIMB


def _item_on_path(plan: Plan, seconds: float, offset: float = 0.0, **fields: float) -> Item:
    """Return an item in place of the current one, on the predicted path `seconds` ahead, `offset` above it [m]."""
    lat, lon, alt = to_geodetic(plan.prediction.ned_origin(), plan.at(seconds) - [0.0, 0.0, offset])
    item = Item(
        seq=plan.seq, command=_WAYPOINT, frame=0, lat_e7=int(lat), lon_e7=int(lon), alt_m=round(float(alt) * 1e-3, 2)
    )
    return msgspec.structs.replace(item, **fields)


# --- items -----------------------------------------------------------------------------------------------------------


def _with_wait(plan: Plan, seconds: float) -> tuple[Item, ...] | None:
    """Return the mission with a circle, of a multirotor a stop, on the present leg."""
    ahead_s = DECISION_S + _MARGIN_S
    if plan.reaches_current(ahead_s):
        return None
    command = _WAYPOINT if is_hovering(plan.twin) else _LOITER_TIME
    return insert(plan.items, _item_on_path(plan, ahead_s, command=command, param1=seconds))


def _skipped(plan: Plan, kind: AlertKind, event: Origin | None) -> list[int]:
    """Return the items of which each is left out: the current one, or those nearest to the event."""
    ahead = plan.ahead[:_AHEAD_ITEMS]
    if kind is AlertKind.CONFLICT or event is None:
        return [item.seq for item in ahead[:1]]
    here = to_ned(plan.prediction.ned_origin(), *(np.array([float(x)]) for x in event))[0, :2]
    nearest = sorted(ahead, key=lambda item: hypot(*(plan.position(item) - here)))
    return [item.seq for item in nearest[:_SKIPPED]]


def _skip(plan: Plan, seq: int) -> Change | None:
    """Leave out one item: fly to the next one, or upload the mission without it."""
    following = [item for item in plan.ahead if item.seq > seq]
    if seq < plan.seq or not following or not any(item.seq == seq for item in plan.items):
        return None
    if seq == plan.seq:
        return Change(uav=plan.uav, seq=following[0].seq)
    return Change(uav=plan.uav, items=remove(plan.items, seq), seq=plan.seq)


def _last_waypoints(items: tuple[Item, ...], seq: int) -> list[Item]:
    """Return the waypoints behind item `seq` that may be left out."""
    return [one for one in items if one.seq > seq and is_positional(one) and m.KINDS[one.command] in _PASSED]


def _shortenings(plan: Plan) -> list[int]:
    """Return the numbers of last waypoints of which each is tried to be left out: 1, 2, 4, …, all; 0: repetitions."""
    items = without_jumps(plan.items)
    n = len(_last_waypoints(items, plan.seq))
    return sorted({*(2**k for k in range(n.bit_length())), n, 0} - ({0} if len(items) == len(plan.items) else set()))


def _without_last(plan: Plan, number: float) -> tuple[Item, ...] | None:
    """Return the mission without repetitions and its last waypoints; what follows them, such as a return, remains."""
    items = without_jumps(plan.items)
    left_out = _last_waypoints(items, plan.seq)
    for item in reversed(left_out[len(left_out) - int(number) :]):
        items = remove(items, item.seq)
    return items if items != plan.items else None


def _within(plan: Plan, radius: float) -> tuple[Item, ...] | None:
    """Return the mission with all remaining items within `radius` of home [m]."""
    home = plan.twin.home
    if home is None:
        return None
    moved: Mapping[int, Item] = {item.seq: move_within(item, home, radius) for item in plan.remaining}
    items = tuple(moved.get(item.seq, item) for item in plan.items)
    return items if items != plan.items else None


def entered_area(plan: Plan) -> Area | None:
    """Return the no-fly area that the present plan enters most deeply within the look-ahead of the alerts, if any."""
    near = plan.prediction.ahead.numpy() <= reach_s(plan.twin, plan.prediction)
    origin, path = plan.prediction.ned_origin(), plan.prediction.path.numpy()[near].astype(float)
    return max(geofence(plan.twin).exclusions, key=lambda area: float(area.depth(path, origin).max()), default=None)


def _around(plan: Plan, distance: float) -> tuple[Item, ...] | None:
    """Return the mission around a no-fly area, at a distance; positive: on the right [m]."""
    area, seconds = entered_area(plan), DECISION_S + _MARGIN_S
    first = plan.seq_after(Change(uav=plan.uav), seconds)
    ahead, origin = [item for item in plan.ahead if item.seq >= first], plan.prediction.ned_origin()
    if area is None or not ahead:
        return None
    route = np.array([plan.at(seconds)[:2], *(plan.position(item) for item in ahead)])
    detour = way_around(route, area.outline(origin), abs(distance), right=distance > 0.0)
    if detour is None:
        return None
    following, items = ahead[detour.last - 1], plan.items
    level = following if m.KINDS[following.command] not in _NO_OFFSET else ahead[max(detour.last - 2, 0)]
    for item in reversed(ahead[detour.first : detour.last - 1]):
        items = remove(items, item.seq)
    seq = following.seq - (detour.last - 1 - detour.first)
    for corner in reversed(detour.corners):
        lat, lon, _ = to_geodetic(origin, np.array([*corner, 0.0]))
        items = insert(
            items,
            Item(seq=seq, command=_WAYPOINT, frame=level.frame, lat_e7=int(lat), lon_e7=int(lon), alt_m=level.alt_m),
        )
    return items


def _landing(plan: Plan) -> Change | None:
    """Return the landing: of a multirotor by mode, of a fixed wing the landing sequence of its mission."""
    if plan.twin.vehicle_class.is_rotorcraft:
        return Change(uav=plan.uav, mode=Kind.LAND.value)
    starts = [item.seq for item in plan.items if item.command in (LAND_START, _LAND, _VTOL_LAND)]
    return Change(uav=plan.uav, seq=min(starts)) if starts and plan.seq >= 0 and plan.seq < min(starts) else None
