"""Kinematic model of hovering aircraft: follow the route at the limits of the autopilot, with an identified lag.

The parameters are identified from flight, see `multirotor.fit`.
Source: ArduCopter and PX4 limits as in `fleet.autopilots.copter`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import isfinite, sqrt, tan

import numpy as np

from fleet.autopilots import copter, copter_legs, px4_multirotor
from fleet.autopilots.copter import Limits
from fleet.contract import Item, Mission
from fleet.frames import G, Origin
from fleet.mission import SPEED, join_remarks, route_items
from fleet.mission_jumps import JUMPS
from twin_worker.numerics.interpolation import zero_order_hold
from twin_worker.prediction.multirotor import copter_rollout, px4_rollout
from twin_worker.prediction.multirotor.route import (
    home_position,
    limit_speeds,
    numbered_from_one,
    return_segments,
    segments_from_mission,
    stop_position,
    stopping_segment,
)
from twin_worker.telemetry.track import STEP, Track

HOLD_MODES = ("LOITER", "POSHOLD", "BRAKE", "AUTO.LOITER", "QLOITER", "HOLD", "POSCTL")
RETURN_MODES = ("RTL", "AUTO.RTL", "SMART_RTL")
_ZETA = 0.9
_TRANSITION_ACCEL = 4.0  # acceleration of a quadplane in transition [m/s2]
_ITEM_MAX_AGE_S = 15.0  # maximum age of a reported item [s]
_STATIONARY_SPEED = 0.8  # stationary below this speed [m/s]
_WAYPOINT, _TURNS, _LAST_NAV = 16, 18, 95  # MAV_CMD


@dataclass(frozen=True)
class MultirotorModel:
    """Identified multirotor model.

    Attributes:
        wn: natural frequency of the lag [rad/s]
        speed_fraction: flown over allowed speed [-]
        accel_fraction: flown over allowed acceleration [-]
        stop_delay_s: delay at each stop in addition to the wait of the mission [s]
        drag: linear and quadratic drag over mass [1/s, 1/m]
        drag_std: their standard deviations; those of the prior before the first fit [1/s, 1/m]
        wind: NED, the direction it blows to, (2,) [m/s]
        mean_error: mean error over 10 s of past flight [m]; nan before the first fit
        n_starts: number of rollouts in that mean
        n_comparisons: number of fits so far
    """

    wn: float = 2.0
    speed_fraction: float = 1.0
    accel_fraction: float = 1.0
    stop_delay_s: float = 0.5
    drag: tuple[float, float] = (0.25, 0.01)
    drag_std: tuple[float, float] = (0.15, 0.01)
    wind: tuple[float, float] = (0.0, 0.0)
    mean_error: float = float("nan")
    n_starts: int = 0
    n_comparisons: int = 0

    def __str__(self) -> str:
        if not self.n_starts:
            return "not yet compared with flight"
        return (
            f"lag {self.wn:.1f} rad/s, {self.speed_fraction:.0%} of the speed limit, mean error "
            f"{self.mean_error:.1f} m over 10 s"
        )


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

    @property
    def law(self) -> str:
        """Return the name of the law."""
        return copter_legs.LAW if self.plans_legs else px4_multirotor.LAW if self.smooths_velocity else copter.LAW

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
        return segments_from_mission(self.items, item, self.origin, p, self.params, arcs=arcs, speed=speed)

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
            the order of their reports, (n,)
    """
    origin, track, prefix = options["origin"], options["flown"], options.get("prefix", "")
    items = route_items(mission)
    seq_offset = int(autopilot == "px4" and bool(items))
    limit, absent = copter.limits(params, prefix)
    if "speed" in absent and track is not None:
        limit = limit._replace(speed=_cruise_speed(track, limit.speed))
    items = numbered_from_one(items, origin) if seq_offset else items
    reported = options.get("reported", np.empty(0)) + seq_offset
    other = np.flatnonzero(reported != reported[-1:])
    earlier = reported[: int(other[-1]) + 1 if len(other) else 0]
    speed, speed_before = speed_in_force(items, reported), speed_in_force(items, earlier)
    plans_legs, smooths_velocity = (autopilot == name and not prefix for name in ("ardupilot", "px4"))
    law = plans_legs, smooths_velocity
    return MultirotorConfig(items, seq_offset, params, limit, absent, since, origin, *law, speed, speed_before)


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


def fly_route(
    track: Track, seq: np.ndarray, config: MultirotorConfig, model: MultirotorModel, ahead: np.ndarray
) -> tuple[np.ndarray | None, str]:
    """Predict the mission from the end of the track; return path or None, and the problems of the mission.

    Args:
        track: newest flight
        seq: current mission item of each row, nan if unknown
        config, model: configuration of the autopilot, and the identified model
        ahead: requested look-ahead times, (k,) [s]
    """
    if not isfinite(seq[-1]):
        return None, "the current mission item is not reported (MISSION_CURRENT)"
    item_seq = int(seq[-1]) + config.seq_offset
    segments, problems = config.segments(track, seq)
    if not len(segments):
        return None, join_remarks(("the mission has nothing to fly", *problems))
    twin = MultirotorTwin(config, model)
    return fly_segments(track, segments, item_seq, twin, ahead, since=time_on_item(seq)), join_remarks(problems)


def time_on_item(seq: np.ndarray) -> float:
    """Return how long the current item has been reported [s]; nan if from the first row on."""
    other = np.flatnonzero(seq != seq[-1])
    return STEP * (len(seq) - 1 - int(other[-1])) if len(other) else float("nan")


def fly_home(track: Track, config: MultirotorConfig, model: MultirotorModel, ahead: np.ndarray) -> np.ndarray | None:
    """Predict a return to launch from the end of the track; None if home is unknown."""
    segments = return_segments(config.items, config.origin, track.p[-1], config.params, arcs=config.plans_legs)
    return fly_segments(track, segments, -1, MultirotorTwin(config, model), ahead) if len(segments) else None


def stop_and_hold(track: Track, config: MultirotorConfig, model: MultirotorModel, ahead: np.ndarray) -> np.ndarray:
    """Predict a stop and hold."""
    p, v = track.p[-1], track.v[-3:].mean(axis=0)
    if np.linalg.norm(v) < 0.5:
        p = track.p[-15:].mean(axis=0)
    return fly_segments(track, stopping_segment(p, v, config.limit), -1, MultirotorTwin(config, model), ahead)


@dataclass(frozen=True)
class MultirotorTwin:
    """Autopilot configuration and multirotor model."""

    config: MultirotorConfig
    model: MultirotorModel

    @property
    def limit(self) -> Limits:
        """Return the limits scaled by the identified fractions."""
        limit, speed_fraction, accel_fraction = self.config.limit, self.model.speed_fraction, self.model.accel_fraction
        return limit._replace(
            speed=limit.speed * speed_fraction,
            acc=limit.acc * accel_fraction,
            acc_corner=limit.acc_corner * accel_fraction,
        )

    @property
    def airframe(self) -> tuple[float, float, float, float]:
        """Return linear and quadratic drag over mass, and the wind north and east [1/s, 1/m, m/s, m/s]."""
        return (*self.model.drag, *self.model.wind)

    @property
    def par(self) -> np.ndarray:
        """Return the parameters of the general law."""
        return np.array([self.config.limit.jerk, self.model.wn, _ZETA, self.max_tilt_airspeed, *self.model.wind])

    @property
    def max_tilt_airspeed(self) -> float:
        """Return the airspeed at the largest tilt, k1 v + k2 v^2 = g tan(tilt) [m/s]."""
        linear, quadratic = self.model.drag
        return 2 * (a := G * tan(min(self.limit.tilt, 1.2))) / (linear + sqrt(linear**2 + 4 * quadratic * a))


def fly_segments(
    track: Track,
    commanded: np.ndarray,
    seq: int,
    twin: MultirotorTwin,
    ahead: np.ndarray,
    *,
    since: float = float("nan"),
) -> np.ndarray:
    """Simulate route segments from the end of the track with current item `seq`; return the path, (k, 3) [m].

    `since` is the time since this item was first reported [s].
    """
    segments = limit_speeds(commanded, twin.limit)
    stops = (segments[:, copter.HOLD] > 0) & np.isfinite(segments[:, copter.HOLD])
    stops_by_law = twin.config.plans_legs or twin.config.smooths_velocity
    segments[stops, copter.HOLD] += 0.0 if stops_by_law else twin.model.stop_delay_s
    segments[:, copter.SPEED] *= np.where(commanded[:, copter.SPEED] > 0, twin.model.speed_fraction, 1.0)
    if segments.shape[1] == copter_legs.N_COLUMNS:
        segments = copter_rollout.prepare(segments, commanded, twin.config.items, twin.config.params, twin.limit)
        par = copter_rollout.parameters(twin.limit, twin.config.params, twin.airframe)
        return copter_rollout.fly(track, segments, (seq, since), par, ahead)
    if twin.config.smooths_velocity:
        config, cruise = twin.config, (twin.limit.speed, twin.model.speed_fraction)
        segments = px4_rollout.prepare(segments, commanded, config.items, cruise)
        ground = float(home_position(config.items, config.origin)[2])
        par = px4_rollout.parameters(twin.limit, config.params, twin.airframe, ground)
        return px4_rollout.fly(track, segments, (seq, since), par, ahead)
    p, v = track.p[-1].copy(), track.v[-3:].mean(axis=0)
    ref = _initial_reference(track, segments, seq, twin.model.wn)
    out = np.empty((int(ahead[-1] / STEP) + 2, 3))
    copter.follow(ref, segments, p, v, twin.par, STEP, out)
    return np.column_stack([np.interp(ahead, STEP * np.arange(len(out)), column) for column in out.T])


def _initial_reference(track: Track, segments: np.ndarray, seq: int, wn: float) -> np.ndarray:
    """Return the reference state on the nearest segment of the current item, at the speed of the aircraft."""
    p, v = track.p[-1], track.v[-3:].mean(axis=0)
    a, b = segments[:, copter.A_N : copter.A_N + 3], segments[:, copter.B_N : copter.B_N + 3]
    displacement = b - a
    length = np.linalg.norm(displacement, axis=1)
    t = displacement / np.maximum(length, 1e-6)[:, None]
    s = np.clip(np.sum((p - a) * t, axis=1), 0.0, length)
    distance = np.linalg.norm(a + t * s[:, None] - p, axis=1)
    distance[segments[:, copter.SEQ] != seq] += 1e6
    k = int(np.argmin(distance))
    if distance[k] % 1e6 > 2.0 and length[k] > 2.0:  # off the line: fly directly to its end
        segments[k, copter.A_N : copter.A_N + 3] = p
        displacement = b[k] - p
        length[k], s[k] = float(np.linalg.norm(displacement)), 0.0
        t[k] = displacement / max(length[k], 1e-6)
    ref = np.zeros(copter.N_FOLLOW)
    recent = track.v[-min(11, len(track)) :]
    acceleration = (recent[-1] - recent[0]) / max(STEP * (len(recent) - 1), STEP)
    ref[copter.SEGMENT], ref[copter.S_DOT] = k, max(v @ t[k], 0.0)
    ref[copter.S_DDOT] = np.clip(acceleration @ t[k], -segments[k, copter.ACC], segments[k, copter.ACC])
    ref[copter.S] = min(s[k] + max(ref[copter.S_DDOT], 0.0) / wn**2, length[k])
    ref[copter.WAIT_TIME] = _waiting_time(track, b[k])
    if segments[k, copter.HOLD] > 0 and ref[copter.WAIT_TIME] > 0:
        ref[copter.S], ref[copter.S_DOT], ref[copter.S_DDOT] = length[k], 0.0, 0.0
    return ref


def _waiting_time(track: Track, b: np.ndarray) -> float:
    """Return how long the aircraft has been stationary at `b` [s]."""
    moving = (np.linalg.norm(track.v, axis=1) > _STATIONARY_SPEED) | (np.linalg.norm(track.p - b, axis=1) > 3.0)
    moving_rows = np.flatnonzero(moving)
    return STEP * (len(track) - 1 - (int(moving_rows[-1]) if len(moving_rows) else -1))


def items_in_force(t: np.ndarray, leg: tuple[np.ndarray, np.ndarray], mission: Mission | None) -> np.ndarray:
    """Return the current mission item at times `t`, (n,): reported, else from the mission; nan if unknown."""
    seq = zero_order_hold(*leg, t, _ITEM_MAX_AGE_S)[:, 0]
    if mission is not None and mission.seq >= 0:
        seq = np.where(np.isfinite(seq), seq, float(mission.seq))
    return seq


def item_in_force(query_t: float, leg: tuple[np.ndarray, np.ndarray], mission: Mission | None) -> float:
    """Return the current mission item at one time, as `items_in_force`."""
    t, seq = leg
    k = int(t.searchsorted(query_t, side="right")) - 1
    if k >= 0 and not query_t - t[k] > _ITEM_MAX_AGE_S:
        return float(seq[k, 0])
    return float(mission.seq) if mission is not None and mission.seq >= 0 else float("nan")


def describe(config: MultirotorConfig, model: MultirotorModel) -> str:
    """Describe the model and its missing limits."""
    absent = f"; {len(config.absent)} limits not received ({', '.join(config.absent[:3])} …)" if config.absent else ""
    return f"route flown by a kinematic twin: {model}{absent}"


def with_wing_limits(config: MultirotorConfig) -> MultirotorConfig:
    """Set the limits of a quadplane to fixed-wing flight between take-off and landing."""
    airspeeds = [config.params[name] for name in ("AIRSPEED_CRUISE", "TRIM_ARSPD_CM") if name in config.params]
    speed = next((v * (0.01 if v > 300 else 1.0) for v in airspeeds if isfinite(v) and v > 0), config.limit.speed)
    radius = config.params.get("WP_RADIUS", 60.0)
    limit = config.limit._replace(
        speed=min(max(speed, 3.0), 60.0), acc=_TRANSITION_ACCEL, acc_corner=6.0, radius=radius if radius > 1 else 60.0
    )
    return replace(config, limit=limit)
