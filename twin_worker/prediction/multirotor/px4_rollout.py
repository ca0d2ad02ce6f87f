"""Rollout of a PX4 multirotor's route: its trajectory starts with the motion of the aircraft.

After the begin of an item, the trajectory is that of a simulated flight from there on, at the aircraft.
"""

from collections.abc import Mapping, Sequence
from math import hypot, isfinite

import numpy as np

from fleet.autopilots import copter, px4_multirotor
from fleet.autopilots.copter import Limits
from fleet.contract import Item
from twin_worker.prediction.multirotor.copter_rollout import gains, present_motion
from twin_worker.telemetry.track import STEP, Track

_GAINS = (
    (0.95, ("MPC_XY_P",)),
    (1.8, ("MPC_XY_VEL_P_ACC",)),
    (1.0, ("MPC_Z_P",)),
    (4.0, ("MPC_Z_VEL_P_ACC",)),
    (0.4, ("MPC_XY_VEL_I_ACC",)),
    (0.2, ("MPC_XY_VEL_D_ACC",)),
    (0.0, ()),  # the jerk is constant
    (1.0, ()),  # no position is shaped
)
_DEFAULTS = {
    "NAV_ACC_RAD": 10.0,
    "NAV_MC_ALT_RAD": 0.8,
    "MPC_ACC_HOR": 3.0,
    "MPC_ACC_UP_MAX": 4.0,
    "MPC_ACC_DOWN_MAX": 3.0,
    "MPC_Z_V_AUTO_UP": 3.0,
    "MPC_Z_V_AUTO_DN": 1.5,
    "MPC_XY_ERR_MAX": 2.0,
    "MPC_XY_TRAJ_P": 0.5,
    "MPC_TKO_SPEED": 1.5,
    "MPC_TKO_RAMP_T": 3.0,
    "MPC_LAND_ALT1": 10.0,
    "MPC_LAND_ALT2": 5.0,
    "MPC_LAND_SPEED": 0.7,
}
_TAKEOFF, _RETURN = 22, 20  # MAV_CMD
_MAX_REPLAY, _MAX_OFFSET_M = 80, 3.0  # rows after the begin of an item; deviation after them
_LEVEL_M = 0.3  # shorter horizontal legs are vertical [m]


def parameters(limit: Limits, params: Mapping[str, float], airframe: Sequence[float], ground: float) -> np.ndarray:
    """Return the parameters of the trajectory, (px4_multirotor.N_PAR,).

    Args:
        limit, params: limits and autopilot parameters
        airframe: drag and wind as of `copter_rollout.parameters`
        ground: its height, NED [m]
    """
    known = {name: value for name, value in params.items() if name in _DEFAULTS and isfinite(value) and value > 0}
    values = _DEFAULTS | known
    own = [values[name] for name in _DEFAULTS]
    own[0], own[2] = limit.radius, limit.acc  # with what was identified from flight
    return np.array([*gains(_GAINS, limit, params, (0.0, *airframe)), *own, ground])


def prepare(
    segments: np.ndarray, commanded: np.ndarray, items: Sequence[Item], cruise: tuple[float, float]
) -> np.ndarray:
    """Return the segments with speed and phase as PX4 flies them, (n, px4_multirotor.N_COLUMNS).

    Args:
        segments, commanded: with and without limits, (n, copter.N_SEGMENT)
        items: mission
        cruise: default horizontal speed [m/s], and the factor of commanded ones [-]
    """
    speed, factor = cruise
    out = np.column_stack([segments, np.full(len(segments), px4_multirotor.LEG)])
    out[:, copter.SPEED] = np.where(commanded[:, copter.SPEED] > 0, factor * commanded[:, copter.SPEED], speed)
    vertical = np.hypot(*(out[:, copter.B_N : copter.B_N + 2] - out[:, copter.A_N : copter.A_N + 2]).T) < _LEVEL_M
    down = out[:, copter.B_N + 2] - out[:, copter.A_N + 2]
    takeoff, returns = ([i.seq for i in items if i.command == command] for command in (_TAKEOFF, _RETURN))
    out[np.isin(out[:, copter.SEQ], takeoff), px4_multirotor.PHASE] = px4_multirotor.TAKEOFF
    begins = np.isin(out[:, copter.SEQ], returns) & (np.diff(out[:, copter.SEQ], prepend=np.nan) != 0)
    out[begins & vertical & (down <= 0), px4_multirotor.PHASE] = px4_multirotor.CLIMB_IN_PLACE
    landing = commanded[:, copter.SPEED] < 0
    out[landing, px4_multirotor.PHASE] = px4_multirotor.LANDING
    for k in np.flatnonzero(landing[1:] & vertical[:-1] & (down[:-1] > 0)):  # one descent, slowed down by height
        out[k + 1, copter.A_N : copter.A_N + 3] = out[k, copter.A_N : copter.A_N + 3]
    keep = np.ones(len(out), bool)
    keep[:-1] = ~(landing[1:] & vertical[:-1] & (down[:-1] > 0))
    return out[keep]


def fly(track: Track, segments: np.ndarray, item: tuple[int, float], par: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Simulate the flight from the end of the track; arguments as of `copter_rollout.fly`, segments of `prepare`."""
    seq, since = item
    own = np.flatnonzero(segments[:, copter.SEQ] == seq)
    own = own[np.cumprod(np.diff(own, prepend=own[:1] - 1) == 1).astype(bool)]  # not those after a jump back
    xva, out = present_motion(track, par), np.empty((int(ahead[-1] / STEP) + 2, 3))
    rows = round(since / STEP) if isfinite(since) and len(own) else _MAX_REPLAY
    state = _begin(track, segments, own, since, par)
    if 0 < rows < min(_MAX_REPLAY, len(track) - 1):
        earlier = _begin(track.part(0, len(track) - rows), segments, own, 0.0, par)
        motion = present_motion(track.part(0, len(track) - rows), par)
        px4_multirotor.follow(earlier, segments.copy(), motion, par, STEP, np.empty((rows, 3)))
        if np.linalg.norm(motion[0] - xva[0]) < _MAX_OFFSET_M and segments[int(earlier[0]), copter.SEQ] == seq:
            earlier[px4_multirotor.TRAJECTORY : px4_multirotor.TRAJECTORY + 3] += xva[0] - motion[0]
            state, xva[3] = earlier, motion[3]
    px4_multirotor.follow(state, segments, xva, par, STEP, out)
    return np.column_stack([np.interp(ahead, STEP * np.arange(len(out)), column) for column in out.T])


def _begin(track: Track, segments: np.ndarray, own: np.ndarray, since: float, par: np.ndarray) -> np.ndarray:
    """Return the state at the end of a track, (px4_multirotor.N_STATE,), on one of the current item's segments."""
    k = own[int(np.argmin(_offset(track.p[-1], segments[own])))] if len(own) else 0
    state = np.zeros(px4_multirotor.N_STATE)
    state[px4_multirotor.SEGMENT], state[px4_multirotor.TURN_SPEED] = k, hypot(*track.v[-1, :2])
    a, b = segments[k, copter.A_N : copter.A_N + 3], segments[k, copter.B_N : copter.B_N + 3]
    if np.linalg.norm(b - a) < 0.1 and isfinite(since):
        state[px4_multirotor.WAIT] = since
    elif segments[k, copter.HOLD] > 0:
        state[px4_multirotor.WAIT] = _accepted_s(track, b, par)
    px4_multirotor.begin_trajectory(state, present_motion(track, par), par)
    return state


def _offset(p: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """Return the distance of a position from each segment [m]."""
    a, b = segments[:, copter.A_N : copter.A_N + 3], segments[:, copter.B_N : copter.B_N + 3]
    length2 = np.maximum(np.sum((b - a) ** 2, axis=1), 1e-6)
    share = np.clip(np.sum((p - a) * (b - a), axis=1) / length2, 0.0, 1.0)
    return np.linalg.norm(a + share[:, None] * (b - a) - p, axis=1)


def _accepted_s(track: Track, b: np.ndarray, par: np.ndarray) -> float:
    """Return how long the aircraft has been within the acceptance radius of a point [s]."""
    offset = track.p - b
    there = np.hypot(offset[:, 0], offset[:, 1]) < par[px4_multirotor.ACCEPT]
    there &= np.abs(offset[:, 2]) < par[px4_multirotor.ACCEPT_Z]
    away = np.flatnonzero(~there)
    return STEP * max(len(track) - 1.5 - (int(away[-1]) if len(away) else -1), 0.0)
