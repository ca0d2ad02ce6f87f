"""Kinematic model of hovering aircraft: follow the route at the limits of the autopilot, with an identified lag.

The parameters are identified from flight, see `multirotor.fit`.
Source: ArduCopter and PX4 limits as in `fleet.autopilots.copter`.
"""

from dataclasses import dataclass, field
from math import isfinite, sqrt, tan

import numpy as np

from fleet.autopilots import copter, copter_legs
from fleet.autopilots.copter import Limits
from fleet.contract import Mission
from fleet.frames import G
from fleet.mission import join_remarks
from twin_worker.numerics.interpolation import zero_order_hold
from twin_worker.prediction.multirotor import copter_rollout, px4_rollout
from twin_worker.prediction.multirotor.config import MultirotorConfig
from twin_worker.prediction.multirotor.route import home_position, limit_speeds, return_segments, stopping_segment
from twin_worker.telemetry.track import STEP, Track

HOLD_MODES = ("LOITER", "POSHOLD", "BRAKE", "AUTO.LOITER", "QLOITER", "HOLD", "POSCTL")
RETURN_MODES = ("RTL", "AUTO.RTL", "SMART_RTL")
_ZETA = 0.9
_ITEM_MAX_AGE_S = 15.0  # maximum age of a reported item [s]
_STATIONARY_SPEED = 0.8  # stationary below this speed [m/s]


@dataclass(frozen=True)
class MultirotorModel:
    """Identified multirotor model.

    Attributes:
        wn: natural frequency of the lag [rad/s]
        speed_fraction: flown over allowed speed [-]
        accel_fraction: flown over allowed acceleration [-]
        stop_delay_s: delay at each stop in addition to the wait of the mission [s]
        identified: limits of ArduCopter or PX4 that were not received, as of `Limits`, and CIRCLE_RATE
        drag: linear and quadratic drag over mass [1/s, 1/m]
        drag_std: their standard deviations; those of the prior before the first fit [1/s, 1/m]
        wind: NED, the direction it blows to, (2,) [m/s]
        mean_error: mean error over 10 s of past flight [m]; nan before the first fit
        median_error: the same, median over the rollouts [m]
        errors: start [s since 1970] and mean error [m] of the rollouts of the last minute, where nothing is fitted
        n_starts: number of rollouts in that mean
        n_comparisons: number of fits so far
    """

    wn: float = 2.0
    speed_fraction: float = 1.0
    accel_fraction: float = 1.0
    stop_delay_s: float = 0.5
    identified: dict[str, float] = field(default_factory=dict)
    drag: tuple[float, float] = (0.25, 0.01)
    drag_std: tuple[float, float] = (0.15, 0.01)
    wind: tuple[float, float] = (0.0, 0.0)
    mean_error: float = float("nan")
    median_error: float = float("nan")
    errors: tuple[tuple[float, float], ...] = ()
    n_starts: int = 0
    n_comparisons: int = 0

    def __str__(self) -> str:
        if not self.n_starts:
            return "not yet compared with flight"
        return (
            f"lag {self.wn:.1f} rad/s, {self.speed_fraction:.0%} of the speed limit, mean error "
            f"{self.mean_error:.1f} m over 10 s"
        )


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
    def speed_fraction(self) -> float:
        """Return the flown over the commanded speed [-]; ArduCopter and PX4 fly what is commanded."""
        return 1.0 if self.config.has_law else self.model.speed_fraction

    @property
    def limit(self) -> Limits:
        """Return the limits scaled by the identified fractions."""
        limit, accel_fraction = self.config.limit, 1.0 if self.config.has_law else self.model.accel_fraction
        return limit._replace(
            speed=limit.speed * self.speed_fraction,
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
        """Return the airspeed at the largest tilt, k1 v + k2 v^2 = g tan(tilt) [m/s]; nan before the first fit."""
        if self.model.drag_std == MultirotorModel.drag_std:
            return float("nan")
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
    segments[stops, copter.HOLD] += 0.0 if twin.config.has_law else twin.model.stop_delay_s
    segments[:, copter.SPEED] *= np.where(commanded[:, copter.SPEED] > 0, twin.speed_fraction, 1.0)
    if segments.shape[1] == copter_legs.N_COLUMNS:
        segments = copter_rollout.prepare(segments, commanded, twin.config.items, twin.config.params, twin.limit)
        par = copter_rollout.parameters(twin.limit, twin.config.params, twin.airframe)
        return copter_rollout.fly(track, segments, (seq, since), par, ahead)
    if twin.config.smooths_velocity:
        config, cruise = twin.config, (twin.limit.speed, twin.speed_fraction)
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
