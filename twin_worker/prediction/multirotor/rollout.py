"""Kinematic model of hovering aircraft: follow the route at the limits of the autopilot, with an identified lag.

The parameters are identified from flight, see `multirotor.fit`.
Source: ArduCopter and PX4 limits as in `fleet.autopilots.copter`.
"""

from dataclasses import dataclass, replace
from math import isfinite

import numpy as np

from fleet.autopilots import copter
from fleet.autopilots.copter import Limits
from fleet.contract import Item, Mission
from fleet.frames import Origin
from fleet.mission import few
from twin_worker.prediction.closed_loop import held
from twin_worker.prediction.multirotor.route import home_again, lay, numbered_from_one, paced, stop_from
from twin_worker.telemetry.track import STEP, Track

HOLD_MODES = ("LOITER", "POSHOLD", "BRAKE", "AUTO.LOITER", "QLOITER", "HOLD", "POSCTL")
RETURN_MODES = ("RTL", "AUTO.RTL", "SMART_RTL")
_ZETA = 0.9
_TRANSITION = 4.0  # acceleration of a quadplane in transition [m/s2]
_TOLD_S = 15.0  # maximum age of a reported item [s]
_STILL = 0.8  # stationary below this speed [m/s]


@dataclass(frozen=True)
class Rotor:
    """Identified multirotor model.

    Attributes:
        wn: natural frequency of the lag [rad/s]
        speed_fraction: flown over allowed speed [-]
        accel_fraction: flown over allowed acceleration [-]
        stop_delay_s: delay at each stop in addition to the wait of the mission [s]
        max_tilt_airspeed: airspeed at the largest tilt; nan if unknown [m/s]
        wind: NED, the direction it blows to, (2,) [m/s]
        mean_error: mean error over 10 s of past flight [m]; nan before the first fit
        n_starts: number of rollouts in that mean
        n_comparisons: number of fits so far
    """

    wn: float = 2.0
    share: float = 1.0
    push: float = 1.0
    pause: float = 0.5
    v_air: float = float("nan")
    wind: tuple[float, float] = (0.0, 0.0)
    miss: float = float("nan")
    starts: int = 0
    turn: int = 0

    def __str__(self) -> str:
        if not self.starts:
            return "not yet compared with flight"
        return f"lag {self.wn:.1f} rad/s, {self.share:.0%} of the speed limit, mean error {self.miss:.1f} m over 10 s"


@dataclass(frozen=True)
class Onboard:
    """Route and parameters of a multirotor's autopilot.

    Attributes:
        items: mission, item 0 is home
        seq_offset: offset added to every item number, so that item 0 is home
        params: parameters
        limit: limits from the parameters
        absent: limits without a received parameter
        changed_t: last change of route, mode or parameters [s since 1970]
    """

    items: tuple[Item, ...]
    shift: int
    params: dict[str, float]
    limit: Limits
    absent: tuple[str, ...]
    since: float
    origin: Origin


def onboard(mission: Mission | None, params: dict[str, float], autopilot: str, since: float, **more) -> Onboard:
    """Return the configuration of a multirotor's autopilot.

    Args:
        mission, params: as received
        autopilot: as `Status.autopilot`
        since: last change of mission or parameters [s since 1970]
        options: `origin` of the twin's frame, `flown` track, `prefix` of the parameters
    """
    origin, flown, prefix = more["origin"], more["flown"], more.get("prefix", "")
    items = mission.items if mission else ()
    shift = int(autopilot == "px4" and bool(items))
    limit, absent = copter.limits(params, prefix)
    if "speed" in absent and flown is not None:
        limit = limit._replace(speed=_usual_speed(flown, limit.speed))
    items = numbered_from_one(items, origin) if shift else items
    return Onboard(items, shift, params, limit, absent, since, origin)


def _usual_speed(flown: Track, otherwise: float) -> float:
    """Return the cruise speed from flight, the 90 % quantile of the ground speed."""
    level = np.hypot(*flown.v[flown.ok, :2].T)
    moving = level[level > 1.5]
    return float(np.quantile(moving, 0.9)) if len(moving) > 5.0 / STEP else otherwise


def fly_route(
    track: Track, seq: np.ndarray, board: Onboard, rotor: Rotor, ahead: np.ndarray
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
    at = int(seq[-1]) + board.shift
    laid, wrong = lay(board.items, at, board.origin, track.p[-1], board.params)
    if not len(laid):
        return None, few(("the mission has nothing to fly", *wrong))
    return fly_segments(track, laid, at, Way(board, rotor), ahead), few(wrong)


def fly_home(track: Track, board: Onboard, rotor: Rotor, ahead: np.ndarray) -> np.ndarray | None:
    """Predict a return to launch from the end of the track; None if home is unknown."""
    laid = home_again(board.items, board.origin, track.p[-1], board.params)
    return fly_segments(track, laid, -1, Way(board, rotor), ahead) if len(laid) else None


def hold_still(track: Track, board: Onboard, rotor: Rotor, ahead: np.ndarray) -> np.ndarray:
    """Predict a stop and hold."""
    p, v = track.p[-1], track.v[-3:].mean(axis=0)
    if np.linalg.norm(v) < 0.5:
        p = track.p[-15:].mean(axis=0)
    return fly_segments(track, stop_from(p, v, board.limit), -1, Way(board, rotor), ahead)


@dataclass(frozen=True)
class Way:
    """Autopilot configuration and multirotor model."""

    board: Onboard
    rotor: Rotor

    @property
    def limit(self) -> Limits:
        """Return the limits scaled by the identified fractions."""
        limit, share, push = self.board.limit, self.rotor.share, self.rotor.push
        return limit._replace(speed=limit.speed * share, acc=limit.acc * push, acc_corner=limit.acc_corner * push)

    @property
    def par(self) -> np.ndarray:
        """Return the parameters of the kernel."""
        return np.array([self.board.limit.jerk, self.rotor.wn, _ZETA, self.rotor.v_air, *self.rotor.wind])


def fly_segments(track: Track, laid: np.ndarray, seq: int, way: Way, ahead: np.ndarray) -> np.ndarray:
    """Simulate route segments from the end of the track with current item `seq`; return the path, (k, 3) [m]."""
    segments = paced(laid, way.limit)
    stops = (segments[:, copter.HOLD] > 0) & np.isfinite(segments[:, copter.HOLD])
    segments[stops, copter.HOLD] += way.rotor.pause
    segments[:, copter.SPEED] *= np.where(laid[:, copter.SPEED] > 0, way.rotor.share, 1.0)
    p, v = track.p[-1].copy(), track.v[-3:].mean(axis=0)
    ref = _begin(track, segments, seq, way.rotor.wn)
    out = np.empty((int(ahead[-1] / STEP) + 2, 3))
    copter.follow(ref, segments, p, v, way.par, STEP, out)
    return np.column_stack([np.interp(ahead, STEP * np.arange(len(out)), column) for column in out.T])


def _begin(track: Track, segments: np.ndarray, seq: int, wn: float) -> np.ndarray:
    """Return the reference state on the nearest segment of the current item, at the speed of the aircraft."""
    p, v = track.p[-1], track.v[-3:].mean(axis=0)
    a, b = segments[:, copter.A_N : copter.A_N + 3], segments[:, copter.B_N : copter.B_N + 3]
    way = b - a
    length = np.linalg.norm(way, axis=1)
    t = way / np.maximum(length, 1e-6)[:, None]
    s = np.clip(np.sum((p - a) * t, axis=1), 0.0, length)
    off = np.linalg.norm(a + t * s[:, None] - p, axis=1)
    off[segments[:, copter.SEQ] != seq] += 1e6
    k = int(np.argmin(off))
    if off[k] % 1e6 > 2.0 and length[k] > 2.0:  # off the line: fly directly to its end
        segments[k, copter.A_N : copter.A_N + 3] = p
        way = b[k] - p
        length[k], s[k] = float(np.linalg.norm(way)), 0.0
        t[k] = way / max(length[k], 1e-6)
    ref = np.zeros(copter.N_FOLLOW)
    recent = track.v[-min(11, len(track)) :]
    push = (recent[-1] - recent[0]) / max(STEP * (len(recent) - 1), STEP)
    ref[copter.AT], ref[copter.S_DOT] = k, max(v @ t[k], 0.0)
    ref[copter.S_DDOT] = np.clip(push @ t[k], -segments[k, copter.ACC], segments[k, copter.ACC])
    ref[copter.S] = min(s[k] + max(ref[copter.S_DDOT], 0.0) / wn**2, length[k])
    ref[copter.WAITED] = _waited(track, b[k])
    if segments[k, copter.HOLD] > 0 and ref[copter.WAITED] > 0:
        ref[copter.S], ref[copter.S_DOT], ref[copter.S_DDOT] = length[k], 0.0, 0.0
    return ref


def _waited(track: Track, b: np.ndarray) -> float:
    """Return how long the aircraft has been stationary at `b` [s]."""
    moving = (np.linalg.norm(track.v, axis=1) > _STILL) | (np.linalg.norm(track.p - b, axis=1) > 3.0)
    last = np.flatnonzero(moving)
    return STEP * (len(track) - 1 - (int(last[-1]) if len(last) else -1))


def items_in_force(t: np.ndarray, leg: tuple[np.ndarray, np.ndarray], mission: Mission | None) -> np.ndarray:
    """Return the current mission item at times `t`, (n,): reported, else from the mission; nan if unknown."""
    seq = held(*leg, t, _TOLD_S)[:, 0]
    if mission is not None and mission.seq >= 0:
        seq = np.where(np.isfinite(seq), seq, float(mission.seq))
    return seq


def item_in_force(now: float, leg: tuple[np.ndarray, np.ndarray], mission: Mission | None) -> float:
    """Return the current mission item at one time, as `items_in_force`."""
    t, seq = leg
    k = int(t.searchsorted(now, side="right")) - 1
    if k >= 0 and not now - t[k] > _TOLD_S:
        return float(seq[k, 0])
    return float(mission.seq) if mission is not None and mission.seq >= 0 else float("nan")


def said(board: Onboard, rotor: Rotor) -> str:
    """Describe the model and its missing limits."""
    absent = f"; {len(board.absent)} limits not received ({', '.join(board.absent[:3])} …)" if board.absent else ""
    return f"route flown by a kinematic twin: {rotor}{absent}"


def with_wings(board: Onboard) -> Onboard:
    """Set the limits of a quadplane to fixed-wing flight between take-off and landing."""
    given = [board.params[name] for name in ("AIRSPEED_CRUISE", "TRIM_ARSPD_CM") if name in board.params]
    speed = next((v * (0.01 if v > 300 else 1.0) for v in given if isfinite(v) and v > 0), board.limit.speed)
    radius = board.params.get("WP_RADIUS", 60.0)
    limit = board.limit._replace(
        speed=min(max(speed, 3.0), 60.0), acc=_TRANSITION, acc_corner=6.0, radius=radius if radius > 1 else 60.0
    )
    return replace(board, limit=limit)
