"""Configuration of a multirotor's autopilot: route, limits received or identified, speed in force."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import isfinite

import numpy as np

from fleet.autopilots import copter, copter_legs, px4_multirotor
from fleet.autopilots.copter import Limits
from fleet.contract import Item, Mission
from fleet.frames import Origin
from fleet.mission import SPEED, route_items
from fleet.mission_jumps import JUMPS
from twin_worker.prediction.multirotor import copter_rollout
from twin_worker.prediction.multirotor.route import MAX_LEGS, numbered_from_one, segments_from_mission, stop_position
from twin_worker.telemetry.track import STEP, Track

CIRCLE_RATE = "CIRCLE_RATE"
_TRANSITION_ACCEL = 4.0  # acceleration of a quadplane in transition [m/s2]
_WAYPOINT, _TURNS, _LAST_NAV = 16, 18, 95  # MAV_CMD


@dataclass(frozen=True)
class MultirotorConfig:
    """Route and parameters of a multirotor's autopilot.

    Attributes:
        items: mission, item 0 is home
        seq_offset: offset added to every item number, so that item 0 is home
        params: parameters
        limit: limits from the parameters
        absent: limits without a received parameter
        changed_t: last change of route, mode or parameters [s since 1970]
        origin: of the twin's frame
        plans_legs: flies jerk-limited legs as ArduCopter does
        smooths_velocity: flies a jerk-limited velocity as PX4 does; with neither, the general law of `copter`
        speed: commanded before the current item, for all but a return; 0 if none [m/s]
        speed_before: the same before the item flown before
        jumps_taken: jumps taken so far at each jump, as for `unroll_route`
        max_legs: legs of the route
    """

    items: tuple[Item, ...]
    seq_offset: int
    params: dict[str, float]
    limit: Limits
    absent: tuple[str, ...]
    changed_t: float
    origin: Origin
    plans_legs: bool = False
    smooths_velocity: bool = False
    speed: float = 0.0
    speed_before: float = 0.0
    jumps_taken: Mapping[int, int] = field(default_factory=dict)
    max_legs: int = MAX_LEGS

    @property
    def law(self) -> str:
        """Return the name of the law."""
        return copter_legs.LAW if self.plans_legs else px4_multirotor.LAW if self.smooths_velocity else copter.LAW

    @property
    def has_law(self) -> bool:
        """Return whether it flies a law with gains and stops of its own that follows its limits."""
        return self.plans_legs or self.smooths_velocity

    def segments(self, track: Track, seq: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
        """Return the route from the current item on, for ArduCopter from the leg before it; and the mission's problems.

        Args:
            track: newest flight
            seq: reported mission item of each row
        """
        item = int(seq[-1]) + self.seq_offset
        route, problems = self._segments_from(item, track, self.speed)
        if not self.plans_legs or not len(route):
            return route, problems
        before = self._previous(item, seq)
        if before is None:
            return route, problems
        if before.command == _WAYPOINT and not before.param1 > 0 and before.seq < item:
            longer, more = self._segments_from(before.seq, track, self.speed_before)
            k = np.flatnonzero(longer[:, copter.SEQ] == item)
            return (longer, more) if len(k) and k[0] <= 1 else (route, problems)
        changed = int(np.flatnonzero(seq != seq[-1])[-1]) if (seq != seq[-1]).any() else None
        if before.command == _TURNS and changed is not None:
            par = copter_rollout.parameters(self.limit, self.params, (0.0, 0.0, 0.0, 0.0))
            route[0, copter.A_N : copter.A_N + 3] = copter_rollout.stopping_point(
                track.p[changed], track.v[changed], par
            )
        elif (start := stop_position(self.items, before.seq, self.origin)) is not None:
            route[0, copter.A_N : copter.A_N + 3] = start
        return route, problems

    def _segments_from(self, item: int, track: Track, speed: float) -> tuple[np.ndarray, tuple[str, ...]]:
        p, arcs = track.p[-1], self.plans_legs
        options = {"arcs": arcs, "speed": speed, "jumps_taken": self.jumps_taken, "max_legs": self.max_legs}
        return segments_from_mission(self.items, item, self.origin, p, self.params, **options)  # type: ignore[arg-type]

    def _previous(self, item: int, seq: np.ndarray) -> Item | None:
        """Return the navigation item before the current one: the one reported before, else the one listed before."""
        other = np.flatnonzero(np.isfinite(seq) & (seq != seq[-1]))
        number = int(seq[other[-1]]) + self.seq_offset if len(other) else item
        listed = [i for i in self.items if 0 < i.seq < item and 0 < i.command < _LAST_NAV]
        reported = [i for i in self.items if i.seq == number and 0 < i.command < _LAST_NAV]
        return reported[0] if reported and number != item else (listed[-1] if listed else None)


def multirotor_config(
    mission: Mission | None, params: dict[str, float], autopilot: str, since: float, **options
) -> MultirotorConfig:
    """Return the configuration of a multirotor's autopilot.

    Args:
        mission, params: as received
        autopilot: as `Status.autopilot`
        since: last change of mission or parameters [s since 1970]
        options: `origin` of the twin's frame, `flown` track, `prefix` of the parameters, `reported` mission items in
            the order of their reports, (n,), `identified` of `MultirotorModel`, `jumps_taken` by reported item number
    """
    origin, track, prefix = options["origin"], options["flown"], options.get("prefix", "")
    items = route_items(mission)
    seq_offset = int(autopilot == "px4" and bool(items))
    plans_legs, smooths_velocity = (autopilot == name and not prefix for name in ("ardupilot", "px4"))
    limit, absent = copter.limits(params, prefix, px4=smooths_velocity)
    if plans_legs or smooths_velocity:
        limit, params = with_identified(limit, params, absent, options.get("identified", {}))
    elif "speed" in absent and track is not None:
        limit = limit._replace(speed=_cruise_speed(track, limit.speed))
    items = numbered_from_one(items, origin) if seq_offset else items
    reported = options.get("reported", np.empty(0)) + seq_offset
    other = np.flatnonzero(reported != reported[-1:])
    earlier = reported[: int(other[-1]) + 1 if len(other) else 0]
    speed, speed_before = speed_in_force(items, reported), speed_in_force(items, earlier)
    law = plans_legs, smooths_velocity
    jumps = {number + seq_offset: count for number, count in options.get("jumps_taken", {}).items()}
    return MultirotorConfig(items, seq_offset, params, limit, absent, since, origin, *law, speed, speed_before, jumps)


def with_identified(
    limit: Limits, params: dict[str, float], absent: Sequence[str], identified: Mapping[str, float]
) -> tuple[Limits, dict[str, float]]:
    """Replace limits and parameters that were not received by those identified from flight."""
    known = {name: value for name, value in identified.items() if name in absent}
    if "acc" in known and limit.acc_corner == 2.0 * limit.acc:
        known["acc_corner"] = 2.0 * known["acc"]
    rate = {CIRCLE_RATE: identified[CIRCLE_RATE]} if CIRCLE_RATE in identified and CIRCLE_RATE not in params else {}
    return limit._replace(**known), params | rate


def speed_in_force(items: Sequence[Item], reported: np.ndarray) -> float:
    """Return the ground speed of the last DO_CHANGE_SPEED that was executed [m/s]; 0 if none.

    It outlasts a jump to an earlier item, before which the mission has no such command.

    Args:
        items: mission, item 0 is home
        reported: current items in the order of their reports, (n,)
    """
    changes = reported[np.flatnonzero(np.diff(reported, prepend=np.nan))].tolist()
    ordered, speed = sorted(items, key=lambda item: item.seq), 0.0
    for before, after in pairwise(changes):
        for item in ordered:
            if item.seq <= before or (after > before and item.seq >= after):
                continue
            if item.command in JUMPS and after < before:
                break
            if item.command == SPEED and item.param1 in (0, 1) and 0 < item.param2 < copter.MAX_LIMIT:
                speed = item.param2
    return speed


def _cruise_speed(track: Track, default: float) -> float:
    """Return the cruise speed from flight, the 90 % quantile of the ground speed."""
    level = np.hypot(*track.v[track.ok, :2].T)
    moving = level[level > 1.5]
    return float(np.quantile(moving, 0.9)) if len(moving) > 5.0 / STEP else default


def with_wing_limits(config: MultirotorConfig) -> MultirotorConfig:
    """Set the limits of a quadplane to fixed-wing flight between take-off and landing."""
    airspeeds = [config.params[name] for name in ("AIRSPEED_CRUISE", "TRIM_ARSPD_CM") if name in config.params]
    speed = next((v * (0.01 if v > 300 else 1.0) for v in airspeeds if isfinite(v) and v > 0), config.limit.speed)
    radius = config.params.get("WP_RADIUS", 60.0)
    limit = config.limit._replace(
        speed=min(max(speed, 3.0), 60.0), acc=_TRANSITION_ACCEL, acc_corner=6.0, radius=radius if radius > 1 else 60.0
    )
    return replace(config, limit=limit)
